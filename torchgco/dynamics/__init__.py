"""Models of vehicles and the integrators that turn their vector fields into steps.

`base.Dynamics` is what a model must say: sizes, a time step, and `field` or `step`. Models of vehicles follow it,
those in the plane in `planar`; `rollout` steps through a horizon, `names` call states and controls. It imports
`base`. Begin with `base.py`.
"""

from torchgco.dynamics.base import Dynamics as Dynamics
from torchgco.dynamics.base import FunctionDynamics as FunctionDynamics
from torchgco.dynamics.planar import Bicycle as Bicycle
from torchgco.dynamics.planar import Planar as Planar
from torchgco.dynamics.planar import PointMass as PointMass
from torchgco.dynamics.planar import Unicycle as Unicycle
from torchgco.dynamics.quadrotor import Airframe as Airframe
from torchgco.dynamics.quadrotor import QuadrotorPlanning as QuadrotorPlanning
from torchgco.dynamics.quadrotor import QuadrotorPlant as QuadrotorPlant
from torchgco.dynamics.quadrotor import QuadrotorThrusts as QuadrotorThrusts
from torchgco.dynamics.quadrotor import RotorTracking as RotorTracking
