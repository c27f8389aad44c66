"""A problem compiled once and solved again and again: `compile`, and the numbers that calls may change.

`compiled.Compiled` keeps a problem packed for C, `phases.CompiledPhases` phases; `compiling.compile` makes both, and
`numbers` names what may be written there. `mpc.MPC` is a receding horizon over a problem, `phases_mpc.PhasesMPC` a
shrinking one over phases, `fleet_mpc.FleetMPC` one of several vehicles, `holding` what it returns where no plan is
found. It imports all rooms but `experiments`. Begin with `compiled.py`.
"""

from torchgco.compiled.answer import Answer as Answer
from torchgco.compiled.compiled import Compiled as Compiled
from torchgco.compiled.compiling import compile as compile
from torchgco.compiled.fleet_mpc import FleetMPC as FleetMPC
from torchgco.compiled.mpc import MPC as MPC
from torchgco.compiled.mpc import MPPIController as MPPIController
from torchgco.compiled.phases import CompiledPhases as CompiledPhases
from torchgco.compiled.phases import PhasesAnswer as PhasesAnswer
from torchgco.compiled.phases_mpc import PhasesMPC as PhasesMPC
from torchgco.receding.plan import Instant as Instant
from torchgco.receding.plan import Plan as Plan
