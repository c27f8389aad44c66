"""torchgco: constrained trajectory optimisation, many problems at once.

    problem  = Problem(dynamics, cost, constraints, x0, N)
    solution = torchgco.solve(problem)

What a solve does, folder by folder: `problem` checks the parts and binds them to a batch; `tracing` records their
functions, and `native` compiles them. `kernels` is what solvers compute with: this C, or PyTorch (`ilqr`, `eager`)
where it can't serve. `solvers` holds the local solvers: AL-iLQR (with the `lagrangian`) and an interior point. Where
obstacles catch a trajectory, `search` runs the table of passes that `presets.gco` lists, along paths from the
`roadmap` and from samples of the `guidance`, and keeps the best. `judging` measures the result by code of its own.

`torchgco.compose` needs Hydra and is imported lazily: importing torchgco loads neither Hydra nor matplotlib.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from torchgco import kernels as kernels
from torchgco import presets as presets
from torchgco import sensitivity
from torchgco.api import compare as compare
from torchgco.api import plot as plot
from torchgco.api import show as show
from torchgco.api import solve as solve
from torchgco.base.errors import ContactWarning as ContactWarning
from torchgco.base.errors import GuidanceWarning as GuidanceWarning
from torchgco.base.errors import HorizonWarning as HorizonWarning
from torchgco.base.errors import InputError as InputError
from torchgco.base.errors import ScaleWarning as ScaleWarning
from torchgco.base.errors import StartWarning as StartWarning
from torchgco.base.errors import TraceWarning as TraceWarning
from torchgco.base.status import Status as Status
from torchgco.base.version import VERSION
from torchgco.baselines import Hold as Hold
from torchgco.baselines import IteratedMPPI as IteratedMPPI
from torchgco.compiled import MPC as MPC
from torchgco.compiled import Answer as Answer
from torchgco.compiled import Compiled as Compiled
from torchgco.compiled import MPPIController as MPPIController
from torchgco.compiled import compile as compile
from torchgco.constraints import Cone as Cone
from torchgco.constraints import Constraint as Constraint
from torchgco.constraints import ControlBounds as ControlBounds
from torchgco.constraints import FunctionConstraint as FunctionConstraint
from torchgco.constraints import Gates as Gates
from torchgco.constraints import NormBounds as NormBounds
from torchgco.constraints import RateBounds as RateBounds
from torchgco.constraints import Separation as Separation
from torchgco.constraints import StateBounds as StateBounds
from torchgco.costs import Cost as Cost
from torchgco.costs import FunctionCost as FunctionCost
from torchgco.costs import QuadraticCost as QuadraticCost
from torchgco.dynamics import Airframe as Airframe
from torchgco.dynamics import Bicycle as Bicycle
from torchgco.dynamics import Dynamics as Dynamics
from torchgco.dynamics import FunctionDynamics as FunctionDynamics
from torchgco.dynamics import Planar as Planar
from torchgco.dynamics import QuadrotorPlanning as QuadrotorPlanning
from torchgco.dynamics import QuadrotorPlant as QuadrotorPlant
from torchgco.dynamics import QuadrotorThrusts as QuadrotorThrusts
from torchgco.dynamics import RotorTracking as RotorTracking
from torchgco.dynamics import Unicycle as Unicycle
from torchgco.guidance import GCO as GCO
from torchgco.guidance import MPPI as MPPI
from torchgco.judging.certificate import Certificate as Certificate
from torchgco.judging.certificate import certify as certify
from torchgco.judging.judge import judge as judge
from torchgco.maps import DistanceField as DistanceField
from torchgco.maps import Field as Field
from torchgco.maps import OccupancyGrid as OccupancyGrid
from torchgco.maps import PointCloud as PointCloud
from torchgco.missions.constraints import FirstStepRates as FirstStepRates
from torchgco.obstacles import Body as Body
from torchgco.obstacles import Boxes as Boxes
from torchgco.obstacles import Capsules as Capsules
from torchgco.obstacles import OscillatingBoxes as OscillatingBoxes
from torchgco.obstacles import Spheres as Spheres
from torchgco.problem.free_time import FreeTime as FreeTime
from torchgco.problem.goal import Goal as Goal
from torchgco.problem.problem import Problem as Problem
from torchgco.roadmap import Roadmap as Roadmap
from torchgco.scenarios import Layouts as Layouts
from torchgco.search import MultiStart as MultiStart
from torchgco.search import PathProposals as PathProposals
from torchgco.search import Restarts as Restarts
from torchgco.solution import Solution as Solution
from torchgco.solvers import ILQR as ILQR
from torchgco.solvers import AugmentedLagrangian as AugmentedLagrangian
from torchgco.solvers import InteriorPoint as InteriorPoint
from torchgco.solvers import LineSearch as LineSearch
from torchgco.solvers import Polish as Polish
from torchgco.solvers import plan_batch as plan_batch

if TYPE_CHECKING:
    from torchgco.base.html import HtmlPage as HtmlPage
    from torchgco.experiments.config.build import compose as compose

# In the order of the API reference.
__all__ = [  # noqa: RUF022
    # the problem
    "Problem", "Goal", "FreeTime", "Dynamics", "FunctionDynamics", "Planar", "Unicycle", "Bicycle",
    "QuadrotorPlanning", "QuadrotorPlant", "QuadrotorThrusts",
    "RotorTracking", "Airframe", "Cost", "QuadraticCost", "Constraint", "Spheres", "Body", "Boxes", "Capsules",
    "OscillatingBoxes", "ControlBounds", "StateBounds", "RateBounds", "NormBounds", "Cone", "Gates", "Separation",
    "FirstStepRates", "FunctionConstraint", "FunctionCost",
    # maps
    "Field", "DistanceField", "OccupancyGrid", "PointCloud",
    # solving it
    "solve", "MPC", "compile", "Compiled", "Answer", "compare", "Solution", "plot", "show", "Status", "presets",
    "plan_batch", "Restarts", "MultiStart", "AugmentedLagrangian", "ILQR", "InteriorPoint", "LineSearch", "Polish",
    "Roadmap", "PathProposals", "GCO", "MPPI", "MPPIController", "IteratedMPPI", "Hold",
    # checking the result
    "judge", "certify", "Certificate",
    # layouts, configurations, errors
    "Layouts", "compose", "InputError", "GuidanceWarning", "ContactWarning", "HorizonWarning", "ScaleWarning",
    "StartWarning", "TraceWarning",
]  # fmt: skip

__version__ = VERSION


def _shown(self: Solution, problem: Problem) -> HtmlPage:
    """`torchgco.show(problem, self)`."""
    return show(problem, self)


def _predicted(self: Solution, changed: Problem, problem: Problem | None = None) -> Solution:
    return sensitivity.predicted(self, changed, problem)


_predicted.__doc__ = sensitivity.predicted.__doc__
Solution.show, Solution.predict = _shown, _predicted

# On some processors the library behind PyTorch's matrix products (MKL) picks a kernel by a matrix's address in memory,
# and so by its place in the batch: a problem's bits would depend on the other problems. Read at MKL's first use.
os.environ.setdefault("MKL_CBWR", "AUTO")


def __getattr__(name: str) -> Any:
    if name == "compose":
        from torchgco.experiments.config.build import compose

        return compose
    raise AttributeError(f"module 'torchgco' has no attribute {name!r}")
