"""Forces in balance, vehicles that come apart by them, and planes that share the room, against slow maths."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import nnls
from torch import Tensor

import torchgco
from benchmarks.families.fleet_scenes import quadrotors
from tests.fleets.scenes import DISC, D, disc, swaps
from torchgco import Fleet, FunctionDynamics, Problem, QuadraticCost
from torchgco.fleets.among import SOLVER, Among
from torchgco.fleets.coming_apart import ComingApart
from torchgco.fleets.forces import Pulled, balanced, balancing_forces, between_two, responses, under
from torchgco.fleets.guesses import SIDES, aside
from torchgco.fleets.shared_room import SharedRoom
from torchgco.fleets.solve import alone
from torchgco.fleets.verdict import judge_fleet
from torchgco.problem.known import Known


def test_forces_that_only_push_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    for rows, size in ((1, 3), (6, 9), (40, 60), (40, 25)):
        A, b = rng.normal(size=(size, rows)), rng.normal(size=size)
        M, q = torch.from_numpy(A.T @ A), torch.from_numpy(A.T @ b)
        l = balanced(M, q)
        assert float(l.min()) >= 0 and float((M @ l - q).min()) > -1e-4
        least, _ = nnls(A, b)
        assert np.linalg.norm(A @ (l.numpy() - least)) < 1e-3 * max(1.0, np.linalg.norm(A @ least))
    none = balanced(torch.eye(3, dtype=D), -torch.ones(3, dtype=D))
    assert float(none.max()) < 1e-6


def test_the_normal_between_two_is_that_of_their_nearest_places() -> None:
    """Two that pass each other within a stage, in front of and behind it, and two at one place."""
    t = torch.linspace(-1.0, 1.0, 5, dtype=D)
    first = torch.stack((t * 2.0, torch.zeros_like(t)), dim=-1)
    second = torch.stack((-t * 2.0 + 0.6, torch.full_like(t, 0.1)), dim=-1)
    normals, gaps = between_two(torch.stack((first, second))[None])
    torch.testing.assert_close(normals[0, 0, 1], -normals[0, 1, 0])
    torch.testing.assert_close(gaps[0, 0, 1], gaps[0, 1, 0])
    k = int((first - second).norm(dim=-1).argmin())
    torch.testing.assert_close(normals[0, 0, 1, k], torch.tensor([0.0, -1.0], dtype=D))
    assert float(gaps[0, 0, 1, k]) > 0.099
    same, _ = between_two(first.expand(1, 2, 5, 2))
    torch.testing.assert_close(same.norm(dim=-1)[0, 0, 1], torch.ones(5, dtype=D))
    torch.testing.assert_close(same[0, 0, 1], -same[0, 1, 0])


def test_pulls_are_added_to_the_cost_and_compiled() -> None:
    rng, (problem,) = np.random.default_rng(1), [disc([[0, 0], [1, 1]], [[4, 0], [3, 2]])]
    pull, weight = torch.from_numpy(rng.normal(size=(2, 51, 2))), torch.tensor([[0.3], [0.7]], dtype=D)
    cost = Pulled(problem.cost, pull, weight, slice(0, 2))
    X, U = (torch.from_numpy(rng.normal(size=(2, k, n))) for k, n in ((51, 4), (50, 2)))
    p = X[..., :2]
    slow = problem.cost.total(X, U) + (0.5 * weight.unsqueeze(-1) * p * p - pull * p).sum((1, 2))
    torch.testing.assert_close(cost.total(X, U), slow)
    samples = X[:, :7]
    torch.testing.assert_close(cost.stage(samples, U[:, :7], 3)[:, 2], cost.stage(samples[:, 2], U[:, 2], 3))
    pulled = problem._with({"cost": cost}, known=Known())
    found = SOLVER.solve(pulled, 0 * U)
    assert set(found.statuses) == {torchgco.Status.CONVERGED}
    torch.testing.assert_close(found.cost, cost.total(found.X, found.U))
    assert isinstance(problem.cost, QuadraticCost) or found.account is not None


def car(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [p, heading, speed]."""
    heading, speed = x[..., 2:3], x[..., 3:]
    return torch.cat((speed * heading.cos(), speed * heading.sin(), u), dim=-1)


CAR = FunctionDynamics(car, 4, 2, 0.1, "rk4", position=slice(0, 2))


@pytest.mark.parametrize("model", [DISC, CAR])
def test_responses_are_how_far_a_force_moves_a_solution(model: FunctionDynamics) -> None:
    """Against solves under small forces beside large ones, which add to the curvature where dynamics aren't linear."""
    problem, exact = disc([[0, 0]], [[2, 0.5]], N=20, model=model), torchgco.InteriorPoint(tolerance=1e-10)
    none, free = torch.zeros(1, dtype=D), torch.zeros(1, 21, 2, dtype=D)
    large = free.clone()
    large[0, 8:14, 1] = 1.0

    def solved(force: Tensor) -> torchgco.Solution:
        return exact.solve(under(problem, force, none, free), torch.zeros(1, 20, 2, dtype=D))

    found = solved(large)
    R, springs = responses(problem, found, large, none + 1.0)
    R = R[0]
    assert springs.tolist() == [0.0]
    torch.testing.assert_close(R, R.T, rtol=1e-5, atol=1e-7)
    for k, axis in ((5, 0), (12, 1), (20, 0)):
        small = large.clone()
        small[0, k, axis] += 1e-4
        moved = (solved(small).X - found.X)[0, 1:, :2].flatten() / 1e-4
        torch.testing.assert_close(moved, R[:, 2 * (k - 1) + axis], rtol=1e-2, atol=1e-4)


def test_what_springs_have_held_responds_with_these() -> None:
    """A force that grows faster with the distance than the cost holds has no minimum, but one beside springs."""
    flat, one = QuadraticCost([0.0] * 4, [0.1, 0.1], [0.0] * 4), torch.ones(1, dtype=D)
    free = torch.zeros(1, 21, 2, dtype=D)
    problem = under(Problem(DISC, flat, [], torch.zeros(1, 4, dtype=D), 20), free, -40.0 * one, free)
    for spring, strict in ((100.0, True), (1.0, False)):
        found = SOLVER.solve(under(problem, free, 100.0 * one, free), torch.zeros(1, 20, 2, dtype=D))
        R, springs = responses(problem, found, free, spring * one)
        assert springs.tolist() == [spring] and bool(torch.isfinite(R).all()) == strict


def test_two_that_meet_head_on_give_way_by_the_same() -> None:
    """Alike vehicles, mirrored: forces and ways are mirrored, too, and the gap is as large as it has to be."""
    fleet = Fleet([disc([-2.0, 0.01], [2.0, 0.01]), disc([2.0, -0.01], [-2.0, -0.01])], apart=0.4)
    first = alone(fleet, torchgco.solve, 0, torch.arange(1), "gco")
    p = fleet.places(first.X)
    normals, gaps = between_two(p)
    none = torch.zeros(1, dtype=D)
    R = torch.cat([responses(one, torchgco.solve(one), 0.0 * p[:, 0], none)[0] for one in fleet.members])
    needed = fleet.distances.unsqueeze(-1).expand(2, 2, 51)
    moved, forces = balancing_forces(normals[0], gaps[0], needed, torch.zeros_like(p[0]), R, 1.0)
    torch.testing.assert_close(moved[0], -moved[1], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(forces[0], -forces[1], rtol=1e-4, atol=1e-6)
    after = ((p[0] + moved)[0] - (p[0] + moved)[1]) * normals[0, 0, 1]
    assert float(after.sum(-1)[1:].min()) > 0.4 - 1e-3


def test_vehicles_come_apart_and_share_the_room() -> None:
    """What is shared is sound, costs no more than what came apart, and doesn't depend on other fleets."""
    fleet, rows = Fleet(swaps(6, 2), apart=0.4), torch.arange(2)
    first = alone(fleet, torchgco.solve, 0, rows, "gco")
    forms = [Among(problem, Known()) for problem, _ in fleet.forms]
    apart = ComingApart(fleet, forms, rows, aside(fleet, forms, rows, first, SIDES[0])).run()
    p = fleet.places(apart.X)
    gaps = torch.stack([(p[:, i] - p[:, j]).norm(dim=-1).amin(-1) for i in range(6) for j in range(i)])
    assert float(gaps.min()) > 0.39
    shared = SharedRoom(fleet, forms, rows, apart).run()
    verdict, before = judge_fleet(fleet, shared.U), judge_fleet(fleet, apart.U)
    assert bool(verdict.reached.all()) and bool((verdict.cost < 1.002 * before.cost).all())
    assert bool((verdict.cost < 1.08 * judge_fleet(fleet, first.U).cost).all())
    second = torch.tensor([1])
    one = Fleet([member.take(second) for member in fleet.members], 0.4)
    known = [Among(problem, Known()) for problem, _ in one.forms]
    zero = torch.zeros_like(second)
    guess = aside(one, known, zero, first.take(second), SIDES[0])
    again = SharedRoom(one, known, zero, ComingApart(one, known, zero, guess).run()).run()
    assert all(torch.equal(mine[0], yours[1]) for mine, yours in zip(again.U, shared.U, strict=True))


@pytest.mark.slow
def test_quadrotors_come_apart_though_their_dynamics_are_not_linear() -> None:
    """Guesses for 16 of them leave pairs 0.25 m too close; forces between them make that up."""
    fleet, one = quadrotors(16, 2, 1618).take([1]), torch.tensor([0])
    first = alone(fleet, torchgco.solve, 0, one, "gco")
    forms = [Among(problem, Known()) for problem, _ in fleet.forms]
    apart = ComingApart(fleet, forms, one, aside(fleet, forms, one, first, SIDES[0]))
    p = fleet.places(apart.run().X)
    gaps = torch.stack([(p[:, i] - p[:, j]).norm(dim=-1).amin(-1) for i in range(16) for j in range(i)])
    assert bool(apart.near.all()) and float(gaps.min()) > 0.98 * 0.8
