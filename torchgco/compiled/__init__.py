"""A problem compiled once and solved again and again: `compile`, and the numbers that calls may change.

`compiled.Compiled` keeps a problem packed for C, `numbers` names what may be written there, `mpc.MPC` is a receding
horizon over it, `fleet_mpc.FleetMPC` one of several vehicles, `holding` what it returns where no plan is found. It
imports all rooms but `experiments`. Begin with `compiled.py`.
"""

from torchgco.compiled.answer import Answer as Answer
from torchgco.compiled.compiled import Compiled as Compiled
from torchgco.compiled.compiled import compile as compile
from torchgco.compiled.fleet_mpc import FleetMPC as FleetMPC
from torchgco.compiled.mpc import MPC as MPC
from torchgco.compiled.mpc import MPPIController as MPPIController
from torchgco.receding.plan import Instant as Instant
from torchgco.receding.plan import Plan as Plan
