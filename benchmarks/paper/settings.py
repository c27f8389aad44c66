"""What the figures of paper.md are made with: the problems and the mission that the paper's tables describe."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from benchmarks.paper.runs import FOREST, FOREST_LAYOUT, PAPERS_LOOP
from torchgco import compose
from torchgco.constraints import ControlBounds
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.dynamics import Airframe
from torchgco.experiments.config.build import Setup
from torchgco.lagrangian.lagrangian import Multipliers
from torchgco.missions.planning_problem import airframe_of
from torchgco.missions.plant import hovering
from torchgco.missions.tracker import RATES, THRUST, Reference
from torchgco.problem.problem import Problem


class Ours:
    """The objects behind the figures: the quadrotor's problem and mission, and the planar problem."""

    @cached_property
    def flight(self) -> Setup:
        return compose([*FOREST, *PAPERS_LOOP, "solver=gco_paper", "device.threads=1"])

    @cached_property
    def plane(self) -> Setup:
        return compose(["experiment=planar_trap_paper", "solver=gco_paper", "device.threads=1"])

    @cached_property
    def space_problem(self) -> Problem:
        return problem(self.flight, FOREST_LAYOUT)

    @cached_property
    def plane_problem(self) -> Problem:
        return problem(self.plane, 0)

    @cached_property
    def tracking_problem(self) -> Problem:
        """Of a first call of the tracker."""
        mission = self.flight.mission
        assert mission is not None
        airframe = airframe_of(self.space_problem.dynamics)
        x = hovering(airframe, self.space_problem.x0[:, :3])
        return mission.tracker.track(x, Reference(x.new_zeros(1, 2, 14), 0.05, airframe), 0.0).problem


def problem(setup: Setup, layout: int) -> Problem:
    return setup.task(setup.scenario.draw([layout], setup.seed)).problem


def guess(setup: Setup, layout: int) -> Tensor:
    """The controls that a first solve starts from, one stage of them: all are alike."""
    U0 = setup.task(setup.scenario.draw([layout], setup.seed)).U0
    assert torch.equal(U0, U0[:, :1].expand_as(U0))
    return U0[:, 0]


def cost(problem: Problem) -> BoundQuadratic:
    cost = problem.cost
    assert isinstance(cost, BoundQuadratic) and cost.diagonal
    assert all(part is None for part in (cost.q, cost.r, cost.qf, cost.H))
    return cost


def bounds(problem: Problem) -> ControlBounds:
    return next(part for part in problem.constraints if isinstance(part, ControlBounds))


def saturation(ours: Ours) -> list[float]:
    held = ours.plane.solver.guidance.sampler._bounds(ours.plane_problem)
    assert held is not None
    return [*held[0].flatten().tolist(), *held[1].flatten().tolist()]


def reference(part: str) -> str:
    """What the tracker follows at the knots of a plan with different values everywhere."""
    X = torch.arange(42, dtype=torch.float64).view(1, 3, 14)
    rates, acceleration = Reference(X, 0.05, Airframe()).at(0.0, 0.05, 3)
    followed, planned = (rates, X[..., RATES]) if part == "w" else (acceleration, X[..., THRUST])
    return "optimal states in path planning" if torch.allclose(followed, planned) else "others"


def first_multiplier(setup: Setup, problem: Problem) -> float | str:
    """That every solve, or every plan of a mission, starts from."""
    if setup.mission is not None and setup.mission.planner.multipliers != "reset":
        return "the former plan's"
    return max(float(part.abs().max()) for part in Multipliers.zero(problem, 1.0).lam)
