"""torchgco: constrained trajectory optimisation, many problems at once.

    problem  = Problem(dynamics, cost, constraints, x0, N)
    solution = torchgco.solve(problem)

What a solve does, folder by folder: `problem` checks the parts and binds them to a batch; `tracing` records their
functions, and `native` compiles them. `kernels` is what solvers compute with: this C, or PyTorch (`ilqr`, `eager`)
where it can't serve. `solvers` holds the local solvers: AL-iLQR (with the `lagrangian`) and an interior point. Where
obstacles catch a trajectory, `search` runs the table of passes that `presets.gco` lists, along paths from the
`roadmap` and from samples of the `guidance`, and keeps the best. `judging` measures the result by code of its own.

`torchgco.compose` needs Hydra, `torchgco.read` and `read_dataset` pandas, and all are imported lazily: importing
torchgco loads neither Hydra nor matplotlib.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from torchgco import kernels as kernels
from torchgco import presets, sensitivity
from torchgco.api import compare, solve
from torchgco.base.errors import (
    ContactWarning,
    DeviceWarning,
    GuidanceWarning,
    HorizonWarning,
    InputError,
    RefusalWarning,
    ScaleWarning,
    StartWarning,
    StepWarning,
    TraceWarning,
)
from torchgco.base.status import Status
from torchgco.base.version import VERSION
from torchgco.baselines import Hold, IteratedMPPI
from torchgco.compiled import MPC, Answer, Compiled, FleetMPC, MPPIController, PhasesAnswer, PhasesMPC, compile
from torchgco.constraints import (
    BetweenKnots,
    Cone,
    Constraint,
    ControlBounds,
    FunctionConstraint,
    Gates,
    Integral,
    Link,
    NormBounds,
    RateBounds,
    Separation,
    StateBounds,
)
from torchgco.costs import Cost, FunctionCost, QuadraticCost
from torchgco.dynamics import (
    Airframe,
    Bicycle,
    Dynamics,
    FunctionDynamics,
    Planar,
    QuadrotorPlanning,
    QuadrotorPlant,
    QuadrotorThrusts,
    RotorTracking,
    Unicycle,
)
from torchgco.export import LoadedController, export_c, load_c
from torchgco.fleets import Fleet, FleetSolution
from torchgco.guesses import Guess
from torchgco.guidance import GCO, MPPI
from torchgco.judging.certificate import Certificate
from torchgco.maps import DistanceField, Field, OccupancyGrid, PointCloud
from torchgco.missions.planning_problem import FirstStepRates
from torchgco.obstacles import Body, Boxes, Capsules, Ellipsoids, Moved, OscillatingBoxes, Spheres
from torchgco.phases import Jump, Phases, PhasesSolution
from torchgco.phases.judging import certify, judge
from torchgco.pictures import animate, plot, show
from torchgco.problem.free_time import FreeTime
from torchgco.problem.goal import Goal
from torchgco.problem.problem import Problem
from torchgco.roadmap import Roadmap
from torchgco.scenarios import Layouts
from torchgco.search import MultiStart, PathProposals, Restarts
from torchgco.solution import Solution
from torchgco.solvers import ILQR, AugmentedLagrangian, InteriorPoint, LineSearch, plan_batch
from torchgco.tightened import tightened

if TYPE_CHECKING:
    from torchgco.base.html import HtmlPage as HtmlPage
    from torchgco.experiments.config.build import compose as compose
    from torchgco.experiments.dataset.rows import read_dataset as read_dataset
    from torchgco.experiments.results.merge import read as read

# In the order of the API reference.
__all__ = [  # noqa: RUF022
    # the problem
    "Problem", "Goal", "FreeTime", "Dynamics", "FunctionDynamics", "Planar", "Unicycle", "Bicycle",
    "QuadrotorPlanning", "QuadrotorPlant", "QuadrotorThrusts",
    "RotorTracking", "Airframe", "Cost", "QuadraticCost", "Constraint", "Spheres", "Body", "Boxes", "Capsules",
    "Ellipsoids", "OscillatingBoxes", "Moved", "ControlBounds", "StateBounds", "RateBounds", "NormBounds", "Cone",
    "Gates", "Separation", "Link", "Integral", "BetweenKnots", "FirstStepRates", "FunctionConstraint", "FunctionCost",
    # maps
    "Field", "DistanceField", "OccupancyGrid", "PointCloud",
    # solving it
    "solve", "Guess", "tightened", "MPC", "compile", "Compiled", "Answer", "export_c", "load_c",
    "LoadedController", "compare", "Solution", "plot", "animate", "show", "Status", "presets",
    "Fleet", "FleetSolution", "FleetMPC", "Phases", "Jump", "PhasesSolution", "PhasesMPC", "PhasesAnswer",
    "plan_batch", "Restarts", "MultiStart", "AugmentedLagrangian", "ILQR", "InteriorPoint", "LineSearch",
    "Roadmap", "PathProposals", "GCO", "MPPI", "MPPIController", "IteratedMPPI", "Hold",
    # checking the result
    "judge", "certify", "Certificate",
    # layouts, configurations, studies, errors
    "Layouts", "compose", "read", "read_dataset", "InputError", "GuidanceWarning", "ContactWarning", "HorizonWarning",
    "RefusalWarning", "ScaleWarning", "StartWarning", "StepWarning", "TraceWarning",
    "DeviceWarning",
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
    if name == "read":
        from torchgco.experiments.results.merge import read

        return read
    if name == "read_dataset":
        from torchgco.experiments.dataset.rows import read_dataset

        return read_dataset
    raise AttributeError(f"module 'torchgco' has no attribute {name!r}")
