"""Obstacles along known motions: rows and distances against others', judge and certificate, solves among them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.obstacles.test_ellipsoids import among
from torchgco import (
    Body,
    Boxes,
    Capsules,
    FreeTime,
    InputError,
    Moved,
    OscillatingBoxes,
    Problem,
    Spheres,
    certify,
    judge,
)
from torchgco.kernels import kernels_of
from torchgco.kernels.in_c import NativeKernels
from torchgco.obstacles.moved import MovedBoxes, MovedSpheres
from torchgco.problem.times import bulge

D, DT = torch.float64, 0.1


def ways(d: int, B: int, M: int, N: int, seed: int = 0) -> np.ndarray:
    """Places (B, N+1, M, d) of wanderers near the straight way from start to goal."""
    rng = np.random.default_rng(seed)
    first = rng.uniform([0.9, -0.9, -0.9][:d], [3.1, 0.9, 0.9][:d], (B, 1, M, d))
    return first + np.cumsum(rng.normal(0.0, 0.04, (B, N + 1, M, d)), axis=1)


def part_of(problem: Problem) -> Any:
    part = problem.constraints[0]
    assert isinstance(part, MovedBoxes)
    return part


def random_states(part: Any, N: int, seed: int = 1) -> Tensor:
    B, d = part.path.shape[0], part.path.shape[3]
    p = torch.from_numpy(np.random.default_rng(seed).uniform(-0.5, 3.5, (B, N + 1, d)))
    return torch.cat((p, torch.zeros_like(p)), dim=-1)


def least_between(part: Any, X: Tensor, shares: int = 300) -> Tensor:
    """Distances (B, N, M) from full surfaces, smallest along straight ways of the vehicle and of the centres."""
    share = torch.linspace(0, 1, shares, dtype=D).view(1, 1, -1, 1, 1)
    p = X[..., part.position].unsqueeze(2)
    away = (p - part.path)[:, :-1].unsqueeze(2) * (1 - share) + (p - part.path)[:, 1:].unsqueeze(2) * share
    local = (part.boxes.axes[:, None, None] @ away.unsqueeze(-1)).squeeze(-1)
    over = local.abs() - part.boxes.half_sizes[:, None, None]
    outside = over.clamp(min=0).norm(dim=-1) + over.amax(-1).clamp(max=0)
    return outside.amin(2) - part.boxes.inflated_radii.unsqueeze(1)


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::torchgco.base.errors.ContactWarning")
@pytest.mark.parametrize("d", [2, 3])
def test_an_even_motion_is_that_of_spheres_with_velocities(d: int) -> None:
    """Rows, violations, distances, later ones and solves, in C and in PyTorch."""
    rng, N, B, M = np.random.default_rng(3), 30, 4, 3
    first, speed = ways(d, B, M, 0)[:, 0], rng.uniform(-0.3, 0.3, (B, M, d))
    radii = rng.uniform(0.1, 0.3, (B, M))
    path = first[:, None] + DT * np.arange(N + 1).reshape(1, -1, 1, 1) * speed[:, None]
    ours, theirs = (
        among(Moved(path, radii, 0.1), d=d, B=B, N=N),
        among(Spheres(first, radii, 0.1, speed), d=d, B=B, N=N),
    )
    one, other = part_of(ours), theirs.constraints[0]
    X, U = random_states(one, N), torch.zeros(B, N, d, dtype=D)
    for name in ("value", "violation"):
        torch.testing.assert_close(getattr(one, name)(X, U), getattr(other, name)(X, U), rtol=0, atol=1e-12)
    t = torch.tensor([0.0, 0.37, 1.0, 2.95], dtype=D)
    torch.testing.assert_close(one.signed_distance(X[:, :4, :d], t), other.signed_distance(X[:, :4, :d], t))  # type: ignore[attr-defined]
    torch.testing.assert_close(one.chord_clearance(X), other.chord_clearance(X))  # type: ignore[attr-defined]
    for mine, yours in zip(one.measured(X), other.measured(X), strict=True):  # type: ignore[attr-defined]
        near = yours < 0.5
        torch.testing.assert_close(mine[near], yours[near])
    now = torch.zeros(4, dtype=D)
    later = [part.later(0.45).signed_distance(X[:, :4, :d], now) for part in (one, other)]  # type: ignore[attr-defined]
    torch.testing.assert_close(*later)
    for solver in ("gco", "interior_point"):
        found, expected = (torchgco.solve(problem, solver=solver, verbose=False) for problem in (ours, theirs))
        assert found.statuses == expected.statuses
        torch.testing.assert_close(found.X, expected.X, rtol=0, atol=1e-5)


@pytest.mark.parametrize("kind", ["spheres", "boxes"])
def test_rows_in_c_and_slopes_agree_with_pytorch(kind: str) -> None:
    shape: dict[str, Any] = {"radii": 0.2} if kind == "spheres" else {"half_sizes": [[0.3, 0.1]] * 3, "radii": 0.05}
    problem = among(Moved(ways(2, 5, 3, 40), vehicle_radius=0.1, **shape), B=5)
    part = part_of(problem)
    assert part.kernel == ("spheres" if kind == "spheres" else "function")
    p = random_states(part, 40)[:, 1:, :2]
    t = DT * torch.arange(1, 41, dtype=D)
    rows = torch.func.jacrev(lambda q: part.rows(q, t).sum((0, 1)))(p).permute(1, 2, 0, 3)
    torch.testing.assert_close(part.slopes(p, t), rows, rtol=1e-9, atol=1e-9)
    X, U = random_states(part, 40), torch.zeros(5, 40, 2, dtype=D)
    kernels = kernels_of(problem)
    assert isinstance(kernels, NativeKernels)
    torch.testing.assert_close(kernels.violation(problem, X, U, True), part.worst(X, U), rtol=0, atol=1e-12)
    for b in range(5):  # of one problem alone, the same
        alone = problem.take(torch.tensor([b]))
        found = kernels_of(alone).violation(alone, X[[b]], U[[b]], True)
        assert torch.equal(found, kernels.violation(problem, X, U, True)[[b]])


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("boxes", [False, True])
def test_what_lies_between_knots_is_never_nearer_than_said(d: int, boxes: bool) -> None:
    rng = np.random.default_rng(2)
    more: dict[str, Any] = {"radii": rng.uniform(0.1, 0.4, (3, 4))}
    if boxes:
        turns = rng.normal(size=(3, 4, 4))
        more |= {"half_sizes": rng.uniform(0.1, 0.5, (3, 4, d))}
        more |= {"rotations": turns[..., 0] if d == 2 else turns / np.linalg.norm(turns, axis=-1, keepdims=True)}
    part = part_of(among(Moved(ways(d, 3, 4, 6), vehicle_radius=0.1, **more), d=d, B=3, N=6))
    X = random_states(part, 6)
    X[0, 3, :d] = 2 * part.path[0, 2, 0] - X[0, 2, :d]  # right through one
    least = least_between(part, X)
    touch = least + part.contact_depths.unsqueeze(1)
    step = float(X[..., :d].diff(dim=1).norm(dim=-1).amax()) / 299 + 0.01
    for found in (part.chord_clearance(X), part.clearances(X)[1]):
        assert bool((found <= touch.flatten(1).amin(-1) + 1e-9).all())
        assert bool((found >= touch.flatten(1).amin(-1) - step).all())
    assert bool((part.measured(X)[1] <= least + 1e-9).all())
    fine = part.in_pieces(4)  # a quarter of a step each: the same motion
    share = torch.arange(4, dtype=D).view(1, 1, -1, 1) / 4
    Y = torch.cat((torch.lerp(X[:, :-1, None], X[:, 1:, None], share).flatten(1, 2), X[:, -1:]), dim=1)
    torch.testing.assert_close(fine.clearances(Y)[1], part.clearances(X)[1], rtol=0, atol=1e-7)
    torch.testing.assert_close(fine.chord_clearance(Y), part.chord_clearance(X), rtol=0, atol=1e-7)


def test_those_at_rest_are_boxes_and_capsules() -> None:
    half, turn, N = np.array([[0.3, 0.1], [0.4, 0.0]]), [0.4, 1.0], 20
    centers = np.array([[2.0, 0.3], [1.0, -0.4]])
    path = np.broadcast_to(centers, (N + 1, 2, 2))
    moved = among(Moved(path, 0.05, 0.1, half, turn), N=N).constraints[0]
    boxes = among(Boxes(centers, half, 0.1, turn, 0.05), N=N).constraints[0]
    X, U = random_states(moved, N), torch.zeros(1, N, 2, dtype=D)
    for name in ("value", "violation"):
        torch.testing.assert_close(getattr(moved, name)(X, U), getattr(boxes, name)(X, U), rtol=0, atol=1e-12)
    along = 0.4 * np.array([np.cos(1.0), np.sin(1.0)])
    capsule = among(Capsules((centers[1] - along)[None], (centers[1] + along)[None], 0.05, 0.1), N=N).constraints[0]
    alone = moved.chosen(torch.tensor([[1]]))  # type: ignore[attr-defined]
    torch.testing.assert_close(alone.chord_clearance(X), capsule.chord_clearance(X))  # type: ignore[attr-defined]
    by = torch.tensor([0.2], dtype=D)
    torch.testing.assert_close(moved.grown(by).chord_clearance(X), boxes.grown(by).chord_clearance(X))  # type: ignore[attr-defined]


def crossing(N: int = 40, B: int = 1, **more: Any) -> Problem:
    """One that comes from the side and stops on the straight way, and one that leaves it."""
    k = np.arange(N + 1) / N
    comes = np.stack([2.0 + 0 * k, np.clip(1.5 - 3.0 * k, 0.0, None)], -1)
    leaves = np.stack([1.0 + 0 * k, -1.5 * k], -1)
    return among(Moved(np.stack([comes, leaves], 1), 0.3, 0.1), B=B, N=N, **more)


@pytest.mark.slow
def test_solves_are_judged_and_certified_and_keep_the_batch_contract() -> None:
    B = 6
    path = ways(2, B, 4, 40, seed=5)
    path[::2, :, 3] = np.nan
    problem = among(Moved(path, np.where(np.isnan(path[:, 0, :, 0]), np.nan, 0.2), 0.1), B=B)
    solution = torchgco.solve(problem, verbose=False)
    verdict = judge(problem, solution.U)
    assert bool(verdict.feasible.all())
    dense = least_between(part_of(problem), solution.X) + part_of(problem).contact_depths.unsqueeze(1)
    dense = dense.masked_fill(part_of(problem).absent.unsqueeze(1), torch.inf)
    assert bool((certify(problem, solution.X, solution.U).clearance <= dense.flatten(1).amin(-1) + 0.01).all())
    alone = torch.tensor([3])
    assert torch.equal(torchgco.solve(problem.take(alone), ids=alone, verbose=False).U[0], solution.U[3])


def test_one_that_crosses_at_high_speed_is_seen_between_the_knots() -> None:
    path = np.zeros((41, 1, 2))
    path[:, 0, 0], path[:, 0, 1] = 1.0, np.where(np.arange(41) < 11, -2.0, 2.0)  # through the way in one step
    problem = among(Moved(path, 0.2, 0.1))
    X = torch.zeros(1, 41, 4, dtype=D)
    X[..., 0] = 1.0
    assert float(part_of(problem).clearances(X)[0]) > 1.0 and float(part_of(problem).clearances(X)[1]) < 0


@pytest.mark.slow
def test_horizons_free_time_and_bodies() -> None:
    both = crossing(B=2, horizon=[30, 40])
    for solver in ("gco", "interior_point"):
        assert bool(judge(both, torchgco.solve(both, solver=solver, verbose=False).U).feasible.all())
    with pytest.raises(InputError, match=r"where the time is free, obstacles at rest, .* got MovedSpheres that move"):
        torchgco.solve(crossing(time=FreeTime(3.0, 5.0)))
    turned = lambda x: torch.diag_embed(torch.ones_like(x[..., :2]))
    body = Body([[0.0, 0.0], [0.2, 0.0]], [0.1, 0.1], turned)
    k = np.arange(41) / 40
    path = np.stack([2.0 + 0 * k, 1.5 - 3.0 * k], -1)[:, None]
    problem = among(Moved(path, 0.3, body))
    assert problem.constraints[0].kernel == "body"
    solution = torchgco.solve(problem, verbose=False)
    assert bool(judge(problem, solution.U).reached.all())


@pytest.mark.sampled(2)
@pytest.mark.parametrize("body", [False, True])
@pytest.mark.parametrize("boxes", [False, True])
def test_new_places_between_solves(boxes: bool, body: bool) -> None:
    turned = lambda x: torch.diag_embed(torch.ones_like(x[..., :2]))
    vehicle: Any = Body([[0.0, 0.0], [0.2, 0.0]], [0.1, 0.1], turned) if body else 0.1
    shape: dict[str, Any] = {"half_sizes": [[0.3, 0.2]]} if boxes else {"radii": 0.3}
    of = lambda path: among(Moved(path, vehicle_radius=vehicle, **shape))
    old, new = (start + ways(2, 1, 1, 40, seed)[0] * 0.5 for start, seed in (([1.0, 0.2], 1), ([1.2, -0.3], 2)))
    mpc = torchgco.compile(of(old), "interior_point")
    mpc()
    answer, fresh = mpc(places=new, warm=False), torchgco.compile(of(new), "interior_point")()
    assert answer.statuses == fresh.statuses and mpc.stale() is None
    torch.testing.assert_close(answer.X, fresh.X, rtol=0, atol=1e-6)
    with pytest.raises(InputError, match="places"):
        mpc(places=np.full_like(new, np.nan))


def test_single_knots_and_chords_beside_spheres_at_rest() -> None:
    """C measures chords of spheres alone, those of moved ones PyTorch does."""
    path = ways(2, 2, 2, 40)
    still = Spheres([[2.0, 0.1]], [0.2], 0.1)
    for knots in (None, [20]):
        problem = among(Moved(path, 0.2, 0.1, knots=knots), still, B=2)
        X, U = random_states(part_of(problem), 40), torch.zeros(2, 40, 2, dtype=D)
        expected = torch.minimum(*(part.chord_clearance(X) for part in problem.obstacles))
        torch.testing.assert_close(kernels_of(problem).chord_clearance(problem, X, None), expected)
        worst = torch.maximum(*(part.worst(X, U) for part in problem.obstacles))
        torch.testing.assert_close(kernels_of(problem).violation(problem, X, U, True), worst)


def test_paths_that_bend_among_swinging_boxes_are_judged_in_pieces() -> None:
    """Where the vehicle is, not where boxes are, tells by how much its path leaves its chords."""
    boxes = Boxes([[2.0, 3.0]], [[0.2, 0.2]], 0.1)
    swing = OscillatingBoxes(boxes, [[[0.0, 0.1]]], [[[0.0, 1.0]]], [[[0.0, 0.0]]])
    problem = among(swing)
    X, U = torch.zeros(1, 41, 4, dtype=D), torch.full((1, 40, 2), 4.0, dtype=D)
    found = bulge(replace(problem), X, U)
    torch.testing.assert_close(found, torch.full((1,), 4.0 * 2**0.5 * 0.05**2 / 2, dtype=D))


BAD = {
    "stages": ({"places": np.zeros((40, 1, 2))}, r"moved.places: expected shape \(41, M, 2\) or \(1, 41, M, 2\)"),
    "space": ({"places": np.zeros((41, 1, 3))}, r"moved.places: expected shape \(41, M, 2\)"),
    "batch": ({"places": np.zeros((3, 41, 1, 2))}, r"moved.places: expected shape"),
    "numbers": ({"places": "far"}, "moved.places"),
    "radius": ({"radii": -1.0}, "moved.radii: expected finite radii of at least 0 m"),
    "radii": ({"radii": [0.1, 0.2]}, "moved.radii"),
    "flat": ({"half_sizes": [[0.1, 0.0]], "radii": 0.0}, "moved.half_sizes: expected finite half sides above 0 m"),
    "turned": ({"rotations": [0.3]}, "moved.rotations: expected half_sizes of boxes"),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed_ones_are_named(case: str) -> None:
    changes, message = BAD[case]
    with pytest.raises(InputError, match=message):
        among(Moved(**({"places": np.zeros((41, 1, 2)), "radii": 0.1} | changes)))


def test_a_place_that_is_missing_is_named() -> None:
    path = np.zeros((41, 2, 2))
    path[7, 1] = np.nan
    with pytest.raises(InputError, match="obstacle 1 at knot 7 of problem 0"):
        among(Moved(path, 0.1))
    none = among(Moved(np.zeros((41, 0, 2)), 0.1))
    assert not none.obstacles[0].moving and not isinstance(none.obstacles[0], MovedSpheres)
