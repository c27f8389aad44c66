"""Solves for the figures of paper.md, with the state that guidance got after every inner solve and its answer."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.lib.recorded import Told
from benchmarks.paper.drawing import inside
from torchgco import compose
from torchgco.base.draws import DrawKey
from torchgco.guidance import GCO, MPPI
from torchgco.kernels import open_loop
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.problem.problem import Problem
from torchgco.search import PathProposals
from torchgco.search.proposals import propose
from torchgco.solution import Solution
from torchgco.solvers.contracts import Advice

HORIZON = 10.0  # of the planar problem, s
# Table 3's start as our copy of the paper prints it; with a lost minus sign it would be (-1, 1, 0).
FOREST = ("scenario=forest", "scenario.start=[1,1,0]", "scenario.num_obstacles=12")
FOREST_LAYOUT = 26  # under seed 0; chosen, as the first solve of al_ilqr ends inside spheres
PAPERS_LOOP = ("mission=paper", "plant=rotors")


@dataclass(frozen=True)
class Sampling:
    """One call of MPPI for one problem."""

    sampler: MPPI
    problem: Problem
    U: Tensor  # (1, N, m): the mean of the draws
    key: DrawKey
    plan: Tensor  # (N+1, n): the weighted mean, rolled out

    def controls(self, count: int) -> Tensor:
        """Controls (count, N, m) of the first samples of round 1: the draws of this call, made again."""
        return self.sampler.first_samples(self.problem, self.U, self.key, count)[:, 0].contiguous()

    def samples(self, count: int) -> np.ndarray:
        """Positions (count, N+1, d) of the first samples, m."""
        many = self.problem.take(torch.zeros(count, dtype=torch.int64))
        return open_loop(many, self.controls(count))[..., self.problem.position].numpy()


@dataclass(frozen=True)
class Step:
    """One outer iteration of one problem, lengths in metres."""

    outer: int
    path: np.ndarray  # (N+1, d): the iterate
    centers: np.ndarray  # (N+1, d) and
    radii: np.ndarray  # (N+1,) of the guide regions; infinite where a knot isn't guided
    sampling: Sampling | None  # None: the iterate isn't caught

    @property
    def guided(self) -> np.ndarray:
        """Which knots are guided, (N+1,) bool."""
        return np.isfinite(self.radii)


@dataclass
class Witness:
    """Guidance of a single problem that records its calls, and those of its sampler, and changes nothing."""

    guidance: GCO
    solves: list[list[Step]] = field(default_factory=list)  # of a mission: one solve per control step
    sampling: Sampling | None = None  # the call of MPPI in the present update

    def suited(self, problem: Problem) -> Any:
        return self

    def start(self, problem: Problem, X: Tensor) -> GuideRegion:
        self.solves.append([])
        return self.guidance.start(problem, X)

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        self.sampling = None
        sampler = Told.of(self.guidance.sampler, self._told)
        advice = replace(self.guidance, sampler=sampler).update(problem, X, U, penalty, key)
        assert advice.penalty is not None
        path, center, radius = (x[0].clone().numpy() for x in (X, advice.penalty.center, advice.penalty.radius))
        self.solves[-1].append(Step(int(key.outer[0]), path[:, problem.position], center, radius, self.sampling))
        return advice

    def _told(self, problem: Problem, U: Tensor, key: DrawKey, X: Tensor) -> None:
        self.sampling = Sampling(self.guidance.sampler, problem, U.clone(), key, X[0].clone())


@dataclass(frozen=True)
class Solve:
    """One solve of one problem."""

    name: str  # of the solver
    problem: Problem
    centers: np.ndarray  # (M, d), m
    radii: np.ndarray  # (M,), m
    margin: float  # the vehicle's radius, m
    goal_radius: float  # m
    dt: float  # time between two knots, s
    solution: Solution
    steps: list[Step]  # empty for a solver without the paper's guidance
    proposal: np.ndarray | None = None  # (N+1, d), m: the solver continued from it

    @property
    def positions(self) -> np.ndarray:
        """The returned trajectory (N+1, d), m."""
        return self.solution.X[0, :, self.problem.position].numpy()

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (d,) of start and goal, m."""
        assert self.problem.goal is not None
        return self.problem.x0[0, self.problem.position].numpy(), self.problem.goal.position[0].numpy()

    def infeasible(self, positions: np.ndarray) -> np.ndarray:
        """Knots (N+1,) more than a millimetre inside an obstacle that is inflated by the vehicle's radius."""
        return inside(positions, self.centers, self.radii + self.margin)

    @property
    def largest(self) -> float:
        """The largest c of all rows, m^2 for spheres: the violation in the paper's own units."""
        X, U = self.solution.X, self.solution.U
        return max(0.0, *(float(rows.value(X, U).max()) for rows in self.problem.constraints))


def planar(name: str, draws: int = 0, stages: int = 1000) -> Solve:
    """The paper's planar problem by a preset; `draws` numbers the random draws under seed 0."""
    size = (f"scenario.stages={stages}", f"scenario.dt={HORIZON / stages}")
    return _solve(name, ("experiment=planar_trap_paper", *size), 0, draws)


def quadrotor(name: str) -> Solve:
    """The first plan of a flight through a forest, by a preset."""
    return _solve(name, FOREST, FOREST_LAYOUT, FOREST_LAYOUT)


def _solve(name: str, overrides: tuple[str, ...], number: int, draws: int) -> Solve:
    setup = compose([*overrides, f"solver={name}", "device.threads=1"])
    layout = setup.scenario.draw([number], setup.seed)
    task = setup.task(layout)
    solver, witness = setup.solver, None
    first_round = [one for one in getattr(solver, "passes", ())[:5] if isinstance(one, PathProposals)]
    if hasattr(solver, "local"):
        solver = replace(solver, local=replace(solver.local, record=True))
    else:
        witness = None if solver.guidance is None else Witness(solver.guidance)
        solver = replace(solver, record=True, guidance=witness)
    solution = solver.solve(task.problem, task.U0, seed=setup.seed, ids=torch.tensor([draws]))
    proposal = None
    if first_round and bool((solution.guided > 0).all()):
        U = propose(first_round, task.problem).U  # once more: a proposal makes no random draws
        proposal = open_loop(task.problem, U)[0, :, task.problem.position].numpy()
    assert layout.vehicle_radius is not None and layout.dt is not None and task.goal_radius is not None
    scene = (layout.centers[0], layout.radii[0], layout.vehicle_radius, float(task.goal_radius), layout.dt)
    return Solve(name, task.problem, *scene, solution, [] if witness is None else witness.solves[0], proposal)
