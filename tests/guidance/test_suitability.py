"""Guidance that a problem does not support: the solve continues without it, and one warning says why."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.search.rows import restarts
from tests.slow import mostly
from torchgco import (
    GCO,
    MPPI,
    ControlBounds,
    Cost,
    FunctionConstraint,
    FunctionDynamics,
    GuidanceWarning,
    InputError,
    IteratedMPPI,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    Status,
    kernels,
    presets,
)
from torchgco.guidance.gco import R_GUIDE, TRIAL_SAMPLES, _radius, suited_sampler
from torchgco.native.compiler import find_compiler
from torchgco.search import Follow, PathProposals


@pytest.fixture
def in_pytorch() -> Iterator[None]:
    """Use PyTorch's kernels, which call user functions with samples, also in single precision."""
    kernels.use_native(False)
    yield
    kernels.use_native(True)


def vehicle(d: int, kind: str = "plain") -> FunctionDynamics:
    """A double integrator in d dimensions; `kind` is the way the controls enter."""
    turn, gain = torch.eye(d, dtype=torch.float64), torch.ones(d, dtype=torch.float64)
    force = {"plain": lambda u: u, "product": lambda u: u @ turn, "promoted": lambda u: u * gain}[kind]
    return FunctionDynamics(lambda x, u: torch.cat((x[..., d:], force(u)), -1), 2 * d, d, 0.1, "euler", slice(0, d))


def make_problem(d: int, obstacles: Any, kind: str = "plain", dynamics: FunctionDynamics | None = None) -> Problem:
    """Two problems: obstacles block the first one's path; the second one's is free if d > 1."""
    x0 = torch.zeros(2, 2 * d, dtype=torch.float64)
    x0[1, 1 if d > 1 else 0] = 3.0
    cost = QuadraticCost(Q=[1.0] * 2 * d, R=[0.1] * d, Qf=[50.0] * 2 * d, x_ref=[2.0] + [0.0] * (2 * d - 1))
    bounds = ControlBounds([-5.0] * d, [5.0] * d)
    return Problem(vehicle(d, kind) if dynamics is None else dynamics, cost, [obstacles, bounds], x0, 40)


def spheres(d: int) -> Spheres:
    """Two overlapping spheres, across the path; for d = 1, along it."""
    centers = torch.zeros(2, d, dtype=torch.float64)
    centers[:, 0] = 1.0
    centers[:, min(1, d - 1)] += torch.tensor([0.2, -0.2], dtype=torch.float64)
    return Spheres(centers, [0.4, 0.4], 0.1)


BASE = presets.gco(make_problem(2, spheres(2))).local
assert isinstance(BASE.guidance, GCO)
SAMPLER = replace(BASE.guidance.sampler, samples=64, rounds=4)
LOCAL = replace(BASE, guidance=None, max_outer_iterations=6)
GUIDE = replace(BASE.guidance, sampler=SAMPLER)
SINGLE = restarts(LOCAL, PathProposals(), GUIDE, attempts=2)


def pillars(x: Tensor) -> Tensor:
    """The spheres of the plane as a function constraint."""
    centers = x.new_tensor([[1.0, 0.2], [1.0, -0.2]])
    return 0.25 - (x[..., None, :2] - centers).square().sum(-1)


def solved(problem: Problem, solver: Any = SINGLE) -> tuple[Solution, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", GuidanceWarning)
        solution = torchgco.solve(problem, solver=solver)
    return solution, [str(w.message) for w in caught if w.category is GuidanceWarning]


def alone(problem: Problem, b: int, solver: Any = SINGLE) -> Tensor:
    rows = torch.tensor([b])
    part = problem.take(rows)
    U0 = torch.zeros(1, problem.N, problem.m, dtype=torch.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GuidanceWarning)
        return solver.solve(part, U0, ids=rows).U[0]


CASES = {
    "a function for obstacles": (lambda: make_problem(2, FunctionConstraint(pillars, geometric=True)), None),
    "a product with float64": (lambda: make_problem(2, spheres(2), "product"), "samples are drawn in float64"),
    "promoted to float64": (lambda: make_problem(2, spheres(2), "promoted"), "samples are drawn in float64"),
    "a line": (lambda: make_problem(1, spheres(1)), "no path is sought around obstacles in 1-D"),
    "four dimensions": (lambda: make_problem(4, spheres(4)), "no path is sought around obstacles in 4-D"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", mostly(CASES, *set(CASES) - {"a product with float64"}))
def test_available_guidance_is_used(case: str, in_pytorch: None) -> None:
    """The caught problem is guided, the other is not; each is solved as if alone. Lost parts give one warning."""
    make, why = CASES[case]
    problem = make()
    solution, warned = solved(problem)
    # The free problem converges. The caught one starts from a sample with a stiff penalty and may need more iterations.
    assert int(solution.guided[0]) > 0 and solution.statuses[1] == Status.CONVERGED
    assert solution.statuses[0] in (Status.CONVERGED, Status.FEASIBLE) and bool((solution.violation <= 1e-3).all())
    assert all(torch.equal(solution.U[b], alone(problem, b)) for b in (0, 1))
    if why is None:
        assert warned == []
    else:
        assert len(warned) == 1 and warned[0].startswith("guided in part: ")
        assert re.search(why, warned[0])


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("kind", ["product", "promoted"])
def test_native_sampling_does_not_call_the_users_functions(kind: str) -> None:
    problem = make_problem(2, spheres(2), kind)
    solution, warned = solved(problem)
    assert warned == [] and int(solution.guided[0]) > 0
    assert all(torch.equal(solution.U[b], alone(problem, b)) for b in (0, 1))


def test_without_a_position_nothing_is_guided() -> None:
    problem = make_problem(2, FunctionConstraint(pillars, geometric=True))
    without_position = replace(problem, dynamics=replace(problem.dynamics, position=None))
    solution, warned = solved(without_position)
    assert warned == ["solved without guidance: the dynamics have no position"]
    assert solution.guided.tolist() == [0, 0]
    expected = torchgco.solve(without_position, solver=LOCAL)
    assert torch.equal(solution.U, expected.U)


@pytest.mark.parametrize("native", ["native", "eager"], indirect=True)
def test_the_sampler_alone_needs_no_position(native: bool) -> None:
    problem = make_problem(2, FunctionConstraint(pillars, geometric=True))
    without_position = replace(problem, dynamics=replace(problem.dynamics, position=None))
    (expected, _), (got, warned) = (solved(p, IteratedMPPI(SAMPLER, iterations=2)) for p in (problem, without_position))
    assert warned == [] and torch.equal(got.U, expected.U)


def test_without_obstacles_there_is_no_warning() -> None:
    problem = make_problem(2, FunctionConstraint(pillars), dynamics=replace(vehicle(2), position=None))
    solution, warned = solved(problem)
    assert warned == [] and solution.guided.tolist() == [0, 0]


class RefusesSamples(FunctionDynamics):
    """Accepts trajectories, but not several samples at once."""

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        if x.shape[1:-1] == (TRIAL_SAMPLES,):
            raise IndexError("no samples here")
        return super().step(x, u)

    def at(self, k: int) -> RefusesSamples:
        return self


@pytest.mark.slow
def test_dynamics_that_accept_no_samples_are_guided_by_paths_alone(in_pytorch: None) -> None:
    plain = vehicle(2)
    refusing = RefusesSamples(plain.function, 4, 2, 0.1, "euler", plain.position)
    problem, lost = make_problem(2, spheres(2), dynamics=refusing), "no trajectory can be sampled (no samples here)"
    solution, warned = solved(problem, restarts(LOCAL, PathProposals(), GUIDE, attempts=3))
    assert warned == [f"guided in part: {lost}"]
    assert int(solution.guided[0]) == 1 and solution.status.tolist() == [1, 1]
    solution, warned = solved(problem, restarts(LOCAL, None, GUIDE, attempts=2))
    assert warned == [f"solved without guidance: {lost}"]
    expected = torchgco.solve(make_problem(2, spheres(2)), solver=LOCAL)
    assert torch.equal(solution.U, expected.U) and solution.guided.tolist() == [0, 0]
    with pytest.raises(InputError, match="got no trajectory can be sampled"):
        torchgco.solve(problem, solver=IteratedMPPI(iterations=1))


@pytest.mark.parametrize("kind", ["product", "promoted"])
def test_the_sampler_alone_falls_back_to_the_problems_precision(kind: str, in_pytorch: None) -> None:
    problem, sampler = make_problem(2, spheres(2), kind), replace(SAMPLER, dtype="float32")
    solution, warned = solved(problem, IteratedMPPI(sampler, iterations=2))
    assert len(warned) == 1 and "samples are drawn in float64" in warned[0]
    expected = torchgco.solve(problem, solver=IteratedMPPI(replace(sampler, dtype="float64"), iterations=2))
    assert torch.equal(solution.U, expected.U)
    suited, why = suited_sampler(sampler, make_problem(2, spheres(2)))
    assert suited is sampler and why is None


class Aimless(Cost):
    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return 0.0 * x.square().sum(-1)


def test_the_radius_without_spheres_is_a_share_of_the_distance_to_the_goal() -> None:
    problem = make_problem(2, FunctionConstraint(pillars, geometric=True))
    X = problem.x0.unsqueeze(1).repeat(1, 41, 1)
    X[0, 7, :2] = torch.tensor([3.0, 4.0], dtype=torch.float64)
    far = torch.tensor([2.0, 13.0**0.5], dtype=torch.float64)
    torch.testing.assert_close(_radius(problem, X), R_GUIDE * far)
    assert _radius(make_problem(2, spheres(2)), X).tolist() == [0.1, 0.1]

    without_goal = Problem(problem.dynamics, Aimless(), problem.constraints, problem.x0, problem.N)
    torch.testing.assert_close(_radius(without_goal, X), X.new_tensor([R_GUIDE * 5.0, 0.0]))


@pytest.mark.parametrize(
    ("guidance", "field"),
    [
        (GCO(sampler=MPPI(covariance=[1.0, 1.0, 1.0])), "mppi.covariance"),
    ],
)
def test_options_that_do_not_fit_are_named_before_any_problem_is_caught(guidance: GCO, field: str) -> None:
    far = Spheres([[50.0, 50.0]], [0.1])
    with pytest.raises(InputError) as error:
        torchgco.solve(make_problem(2, far), solver=replace(SINGLE, local=replace(LOCAL, guidance=guidance)))
    assert error.value.field == field


def test_offsets_for_another_number_of_controls_are_left_out() -> None:
    """Presets hold offsets for two controls but serve every vehicle."""
    problem = make_problem(2, spheres(2))
    plain, more = (
        solved(problem, restarts(LOCAL, PathProposals(follow=(Follow(initial_offsets=offsets),)), GUIDE, attempts=2))
        for offsets in ((), ((1.0,),))
    )
    assert plain[1] == more[1] == [] and torch.equal(plain[0].U, more[0].U)


class Effort(Cost):
    """A cost that names no goal."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return 50.0 * (x[..., 0] - 2.0).square()


def test_obstacles_without_a_goal_get_a_hint() -> None:
    known = make_problem(2, spheres(2))
    blind = Problem(known.dynamics, Effort(), known.constraints, known.x0, 40)
    with pytest.warns(GuidanceWarning, match=r"no path is sought around obstacles without a goal: Problem"):
        torchgco.solve(blind, solver=SINGLE)
    with warnings.catch_warnings():
        warnings.simplefilter("error", GuidanceWarning)
        torchgco.solve(Problem(known.dynamics, Effort(), [], known.x0, 40), solver=SINGLE)
        goal = torchgco.Goal([2.0, 0.0], 0.3)
        torchgco.solve(Problem(known.dynamics, Effort(), known.constraints, known.x0, 40, goal), solver=SINGLE)
