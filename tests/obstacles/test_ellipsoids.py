"""Ellipsoids: rows, distances, the judge and the certificate against geometry and sampling, and solves among them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    Body,
    ControlBounds,
    Ellipsoids,
    FreeTime,
    FunctionDynamics,
    Goal,
    InputError,
    Problem,
    QuadraticCost,
    Spheres,
    certify,
    judge,
)
from torchgco.obstacles.ellipsoids import BoundEllipsoids

D = torch.float64


def drawn(d: int, B: int, M: int, seed: int = 0) -> dict[str, Any]:
    """Centres between start and goal, semi-axes and turns."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(B, M, 4))
    rotations = turns[..., 0] if d == 2 else turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    low, high = [0.9, -0.7, -0.7][:d], [3.1, 0.7, 0.7][:d]
    return {
        "centers": rng.uniform(low, high, (B, M, d)),
        "semi_axes": rng.uniform(0.12, 0.5, (B, M, d)),
        "vehicle_radius": 0.1,
        "rotations": rotations,
    }


def among(*parts: Any, d: int = 2, B: int = 1, N: int = 40, **more: Any) -> Problem:
    """A point mass that flies 4 m along the first axis."""
    field = lambda x, u: torch.cat((x[..., d:], u), -1)
    model = FunctionDynamics(field, 2 * d, d, 0.1, "rk4", position=slice(0, d))
    end = [4.0] + [0.0] * (2 * d - 1)
    cost = QuadraticCost([0.0] * d + [0.1] * d, [0.1] * d, [50.0] * 2 * d, end)
    limits = ControlBounds([-6.0] * d, [6.0] * d)
    return Problem(model, cost, [*parts, limits], torch.zeros(B, 2 * d, dtype=D), N, Goal(end[:d], 0.2), **more)


def bound(problem: Problem) -> BoundEllipsoids:
    part = problem.constraints[0]
    assert isinstance(part, BoundEllipsoids)
    return part


def states(part: BoundEllipsoids, p: Tensor) -> Tensor:
    return torch.cat((p, torch.zeros_like(p)), dim=-1)


def at_known_distances(part: BoundEllipsoids, d: int, gap: float, count: int) -> Tensor:
    """Points (B, count, d) that far from the grown surface of their problem's first ellipsoid."""
    n = torch.randn(part.absent.shape[0], count, d, dtype=D, generator=torch.Generator().manual_seed(0))
    n = n / n.norm(dim=-1, keepdim=True)
    a = part.semi_axes[:, :1]
    local = a.square() * n / (a * n).norm(dim=-1, keepdim=True) + (0.1 + gap) * n
    return local @ part.axes[:, 0] + part.centers[:, :1]


@pytest.mark.sampled(4)
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("gap", [-0.105, -0.1, -0.05, 0.0, 0.3, 20.0])  # the first is inside of the ellipsoid itself
def test_distances_and_rows_of_points_at_known_distances(d: int, gap: float) -> None:
    part = bound(among(Ellipsoids(**drawn(d, 4, 2)), d=d, B=4))
    p, now = at_known_distances(part, d, gap, 50), torch.zeros(1, dtype=D)
    for found in (part.signed_distance(p, now), part.measured(states(part, p))[0]):
        torch.testing.assert_close(found[..., 0], torch.full((4, 50), gap, dtype=D), rtol=0, atol=1e-9)
    c = part.rows(p, now)[..., 0]
    if gap == 0.0:
        torch.testing.assert_close(c, torch.zeros_like(c), rtol=0, atol=1e-9)
    assert gap == 0.0 or bool((c.sign() == -np.sign(gap)).all())


@pytest.mark.parametrize("d", [2, 3])
def test_slopes_agree_with_autodiff_and_equal_axes_are_spheres(d: int) -> None:
    given = drawn(d, 3, 4)
    part, now = bound(among(Ellipsoids(**given), d=d, B=3)), torch.zeros(1, dtype=D)
    p = torch.rand(3, 9, d, dtype=D, generator=torch.Generator().manual_seed(1)) * 4.0 - 0.5
    p[:, 0] = part.centers[:, 0]
    rows = torch.func.jacrev(lambda q: part.rows(q, now).sum((0, 1)))(p)  # (M, B, K, d)
    torch.testing.assert_close(part.slopes(p, now), rows.permute(1, 2, 0, 3), rtol=1e-6, atol=1e-9)
    size = given["semi_axes"].mean(-1)
    round_ones = {**given, "semi_axes": np.repeat(size[..., None], d, -1)}
    ball, sphere = (
        among(one, d=d, B=3).constraints[0] for one in (Ellipsoids(**round_ones), Spheres(given["centers"], size, 0.1))
    )
    X, U = states(part, p), torch.zeros(3, 8, d, dtype=D)
    for name in ("value", "violation"):
        of = [getattr(one, name)(X, U) for one in (ball.with_knots(slice(1, 9)), sphere.with_knots(slice(1, 9)))]  # type: ignore[attr-defined]
        torch.testing.assert_close(*of, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(ball.contact_depths, sphere.contact_depths)  # type: ignore[attr-defined]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_what_lies_between_knots_is_never_nearer_than_said(d: int, moving: bool) -> None:
    rng = np.random.default_rng(1)
    speeds = {"velocities": rng.uniform(-1, 1, (3, 4, d))} if moving else {}
    problem = among(Ellipsoids(**drawn(d, 3, 4), **speeds), d=d, B=3, N=6)
    part = bound(problem)
    p = torch.from_numpy(rng.uniform(-0.5, 3.5, (3, 7, d)))
    p[0, 3] = 2 * part.centers[0, 0] - p[0, 2]  # right through one at rest
    X, share = states(part, p), torch.linspace(0, 1, 400, dtype=D)
    fine = torch.lerp(p[:, :-1, None], p[:, 1:, None], share.view(1, 1, -1, 1))
    least = torch.stack([
        part.signed_distance(fine[:, k], (k + share) * part.dt).amin(1) for k in range(6)
    ], dim=1)  # fmt: skip
    touch = least + part.contact_depths.unsqueeze(1)
    step = p.diff(dim=1).norm(dim=-1).amax() / 399 + 0.01 * moving
    for found in (part.chord_clearance(X), part.clearances(X)[1]):
        assert bool((found <= touch.flatten(1).amin(-1) + 1e-9).all())
        assert bool((found >= touch.flatten(1).amin(-1) - step).all())
    assert bool((part.measured(X)[1] <= least + 1e-9).all())
    torch.testing.assert_close(part.chord_clearance(X), part.clearances(X)[1], rtol=0, atol=1e-6)
    if not moving:
        assert torch.equal(part.later(1.0).centers, part.centers)
    else:
        later = part.later(0.2).signed_distance(p, torch.zeros(1, dtype=D))
        torch.testing.assert_close(later, part.signed_distance(p, torch.full((1,), 0.2, dtype=D)))


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_ways_among_drawn_ones_are_found(d: int) -> None:
    given = drawn(d, 32, 4)
    for name in ("centers", "semi_axes"):
        given[name][1::2, -1] = np.nan
    problem = among(Ellipsoids(**given), d=d, B=32)
    solution = torchgco.solve(problem)
    verdict = judge(problem, solution.U)
    assert bool(verdict.reached.all()) and bool((verdict.clearance >= 0).all())
    alone = torch.tensor([5])
    again = torchgco.solve(problem.take(alone), ids=alone)
    assert torch.equal(again.U[0], solution.U[5])
    certified = certify(problem, solution.X, solution.U).clearance
    p, part, share = solution.X[..., :d], bound(problem), torch.linspace(0, 1, 50, dtype=D)
    fine = torch.lerp(p[:, :-1, None], p[:, 1:, None], share.view(1, 1, -1, 1)).flatten(1, 2)
    dense = (part.signed_distance(fine, torch.zeros(1, dtype=D)) + part.contact_depths.unsqueeze(1)).flatten(1).amin(-1)
    assert bool((certified <= dense + 0.01).all())  # paths leave their chords


@pytest.mark.slow
def test_moving_ones_horizons_and_free_time() -> None:
    crossing = Ellipsoids([[2.0, -1.6]], [[0.3, 0.6]], 0.1, [0.4], [[0.0, 0.8]])
    problem = among(crossing, horizon=[40])
    solution = torchgco.solve(problem)
    assert bound(problem).moving and bool(judge(problem, solution.U).reached.all())
    both = among(Ellipsoids([[2.0, 0.1]], [[0.3, 0.6]], 0.1), B=2, horizon=[30, 40])
    assert bool(judge(both, torchgco.solve(both).U).reached.all())
    with pytest.raises(InputError, match=r"obstacles at rest, or Spheres .* got Ellipsoids that move"):
        torchgco.solve(among(crossing, time=FreeTime(3.0, 5.0)))
    resting = among(Ellipsoids([[2.0, 0.1]], [[0.3, 0.6]], 0.1), time=FreeTime(3.0, 5.0))
    found = torchgco.solve(resting)
    assert bool(judge(resting, found.U, times=found.t).reached.all())


@pytest.mark.slow
def test_a_body_and_numbers_that_are_written() -> None:
    turned = lambda x: torch.diag_embed(torch.ones_like(x[..., :2]))
    given = {"centers": [[2.0, 0.2]], "semi_axes": [[0.3, 0.5]]}
    new: dict[str, Any] = {"centers": np.array([[2.1, -0.2]]), "semi_axes": np.array([[0.4, 0.3]])}
    for vehicle in (0.1, Body([[0.0, 0.0], [0.2, 0.0]], [0.1, 0.1], turned)):
        of = lambda numbers: among(Ellipsoids(**numbers, vehicle_radius=vehicle))  # noqa: B023
        mpc = torchgco.compile(of(given), "interior_point")
        mpc()
        answer, fresh = mpc(**new, warm=False), torchgco.compile(of(new), "interior_point")()
        assert answer.statuses == fresh.statuses and mpc.stale() is None
        torch.testing.assert_close(answer.X, fresh.X, rtol=0, atol=1e-6)
        assert bool(judge(of(new), answer.U).reached.all())


BAD = {
    "shape": ({"semi_axes": [[0.1, 0.1]] * 2}, r"ellipsoids.semi_axes: expected shape \(1, 1, 2\)"),
    "flat": ({"semi_axes": [[0.1, 0.0]]}, "ellipsoids.semi_axes: expected finite semi-axes above 0 m"),
    "mixed": ({"semi_axes": [[0.1, np.nan]]}, "ellipsoids.semi_axes: expected NaN exactly where the centre is NaN"),
    "turn": ({"rotations": [np.nan]}, "ellipsoids.rotations: expected finite numbers"),
    "speed": ({"velocities": [[np.inf, 0.0]]}, "ellipsoids.velocities: expected finite velocities"),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed_ones_are_named(case: str) -> None:
    changes, message = BAD[case]
    with pytest.raises(InputError, match=message):
        among(Ellipsoids(**({"centers": [[2.0, 0.0]], "semi_axes": [[0.1, 0.2]]} | changes)))
