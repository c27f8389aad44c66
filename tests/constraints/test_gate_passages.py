"""Squares and balls drawn all over the sphere: what is solved passes them all, as counted along its way by hand."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionDynamics,
    Gates,
    Goal,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    Status,
    judge,
)
from torchgco.constraints.gates import GateSquares
from torchgco.judging.gates import passes

D = torch.float64
N, HALF, TOLERANCE = 40, 0.3, 1e-3
SOLVED = Status.CONVERGED, Status.FEASIBLE


def drawn(B: int, d: int, G: int, seed: int, free: bool = False, among: bool = False, **more: Any) -> Problem:
    """Points that are drawn from 0 to 2 m along x in 3 s, through gates at drawn places, normals all over the sphere.

    Args:
        free: the time is.
        among: spheres lie beside the way.
    """
    rng, pad = np.random.default_rng(seed), [0.0] * (d - 2)
    along = (np.arange(G) + 0.5 + rng.uniform(-0.1, 0.1, (B, G))) / G * 2.0
    centers = np.concatenate((along[..., None], rng.uniform(-0.5, 0.5, (B, G, d - 1))), axis=-1)
    if more.pop("balls", False):
        gates = Gates(centers.tolist(), HALF, **more)
    else:
        gates = Gates(centers.tolist(), normals=rng.normal(size=(B, G, d)).tolist(), half_widths=HALF, **more)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., d:], u), -1), 2 * d, d, 0.075, "rk4", slice(0, d))
    parts: list[Any] = [gates, ControlBounds(-8.0, 8.0)]
    if among:
        parts.append(Spheres([[0.5, 1.3, *pad], [1.2, -1.4, *pad]], [0.3, 0.4], 0.1))
    goal, x0 = [2.0, 0.0, *pad], torch.zeros(B, 2 * d, dtype=D)
    if free:
        cost = QuadraticCost([0.0] * 2 * d, [0.1] * d, [0.0] * 2 * d)
        return Problem(model, cost, parts, x0, N, Goal(goal, 0.3, required=True), time=FreeTime(0.2, 5.0))
    cost = QuadraticCost([0.0] * 2 * d, [0.1] * d, [100.0] * 2 * d, x_ref=goal + [0.0] * d)
    return Problem(model, cost, parts, x0, N, Goal(goal, 0.3))


def sides_of(normal: np.ndarray) -> np.ndarray:
    """The directions of a square's sides, by hand."""
    if len(normal) == 2:
        return np.array([[-normal[1], normal[0]]])
    level = np.cross([0.0, 0.0, 1.0], normal)
    level /= np.linalg.norm(level)
    return np.stack((level, np.cross(normal, level)))


def inside(a: np.ndarray, b: np.ndarray, size: float) -> tuple[float, float] | None:
    """From where to where the line between two points is within a ball about 0, in shares of it; None: nowhere."""
    along = b - a
    if not along.any():
        return (0.0, 1.0) if np.linalg.norm(a) <= size else None
    ends = np.sort_complex(np.roots([along @ along, 2.0 * a @ along, a @ a - size**2]))
    if abs(ends[0].imag) > 0 or ends[1].real < 0 or ends[0].real > 1:
        return None
    return max(0.0, float(ends[0].real)), min(1.0, float(ends[1].real))


def passed_by_hand(p: np.ndarray, part: Any, b: int) -> int:
    """How many gates positions p (N+1, d) pass in their order: squares from a knot behind to the next one ahead."""
    since = 0.0
    for g in range(part.centers.shape[1]):
        away, size = p - part.centers[b, g].numpy(), float(part.sizes[b, g]) + TOLERANCE
        if not isinstance(part, GateSquares):
            ways = [(k, inside(a, c, size)) for k, (a, c) in enumerate(pairwise(away))]
            times = [max(since, k + way[0]) for k, way in ways if way is not None and k + way[1] >= since]
        else:
            n = part.axes[b, g, 0].numpy()
            s, sides, times, behind = away @ n, sides_of(n), [], False
            for k, at in enumerate(s):
                if at >= TOLERANCE and behind:
                    under = max(i for i in range(k) if s[i] <= 0)
                    share = s[under] / (s[under] - s[under + 1])
                    place = away[under] + share * (away[under + 1] - away[under])
                    if np.abs(sides @ place).max() <= size and under + share > since:
                        times.append(under + share)
                behind = at <= -TOLERANCE or (behind and at < TOLERANCE)
        if not times:
            return g
        since = times[0]
    return part.centers.shape[1]


def check(problem: Problem, found: Solution, least: float) -> None:
    """What is solved or feasible passes all gates, by hand and by the judge; as large a share as `least` is solved."""
    verdict = judge(problem, found.U, times=found.times)
    part, d = problem.constraints[0], problem.m
    G = part.centers.shape[1]
    counts = [passed_by_hand(found.X[b, :, :d].numpy(), part, b) for b in range(problem.B)]
    assert verdict.gates_passed.tolist() == counts
    solved = np.isin(found.status.numpy(), [int(s) for s in SOLVED])
    assert solved.mean() >= least
    assert (np.array(counts)[solved | verdict.feasible.numpy()] == G).all()


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("d", "G", "free", "among", "solver"), [
    (2, 1, False, False, "gco"),
    (3, 1, True, False, "interior_point"),
    (2, 2, False, True, "gco"),
    (3, 2, False, False, "interior_point"),
])  # fmt: skip
def test_what_is_solved_passes_squares_in_their_direction(d: int, G: int, free: bool, among: bool, solver: str) -> None:
    problem = drawn(6 if free else 24, d, G, 5, free, among)
    check(problem, torchgco.solve(problem, solver=solver, verbose=False), 0.75)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("balls", [True, False])
def test_the_judge_counts_along_all_knots_in_order(d: int, balls: bool) -> None:
    """Walks through the same place many times, at knots that lie in the plane or beside it by less than the tolerance,
    whatever knots the gates have; the last of which is the first one again."""
    B, G = 96, 3
    problem = drawn(B, d, G, 7, balls=balls, knots=[30, 34, 38])
    part, rng = problem.constraints[0], np.random.default_rng(8)
    for whole in (part.centers, part.sizes, *([] if balls else [part.axes])):
        whole[:, 2] = whole[:, 0]
    to = part.centers.numpy()[np.arange(B)[:, None], rng.integers(0, G, (B, N + 1))]
    p = torch.from_numpy(to + rng.normal(size=(B, N + 1, d)) * rng.choice([0.03, 0.3, 1.0], (B, N + 1, 1)))
    if not balls:
        flat = torch.from_numpy(rng.random((B, N + 1)) < 0.5)
        n = part.axes[:, 0, 0].unsqueeze(1)
        along = ((p - part.centers[:, :1]) * n).sum(-1, keepdim=True)
        p = torch.where(flat.unsqueeze(-1), p - (along - 6e-4 * torch.sign(along)) * n, p)
    for b, last in enumerate(rng.integers(1, N, B)):
        p[b, last:] = p[b, last]
    X = torch.cat((p, torch.zeros_like(p)), dim=-1)
    way = passes(part, X)
    assert way is not None
    counts = [passed_by_hand(p[b].numpy(), part, b) for b in range(B)]
    assert way.passed.sum(-1).tolist() == counts and set(counts) == {0, 1, 2, 3}
    for b in range(B):
        assert way.passed[b].tolist() == [True] * counts[b] + [False] * (G - counts[b])
        assert (way.when[b, : counts[b]].diff() >= 0).all() and (way.when[b, counts[b] :] == N + 1).all()
        alone = passes(part.take(torch.tensor([b])), X[b : b + 1])
        assert alone is not None
        for mine, all_ in zip(alone, way, strict=True):
            torch.testing.assert_close(mine[0], all_[b], rtol=0, atol=0, equal_nan=True)


def test_gates_are_passed_on_the_path_not_on_its_chords() -> None:
    """Points whose path is a parabola between few knots, and straight lines between these cross other places."""
    B, count = 32, 400
    whole, rng = drawn(B, 2, 1, 11), np.random.default_rng(12)
    normals = rng.normal(size=(B, 1, 2)).tolist()
    gates = Gates(whole.constraints[0].centers, normals=normals, half_widths=0.04, knots=[2])
    model = replace(whole.dynamics, dt=0.5)
    problem = Problem(model, whole.cost, [gates, ControlBounds(-8.0, 8.0)], whole.x0, 6, whole.goal)
    found = torchgco.solve(problem, solver="interior_point", verbose=False)
    part, p, v, a = problem.constraints[0], found.X[:, :-1, None, :2], found.X[:, :-1, None, 2:], found.U[:, :, None]
    t = torch.arange(count, dtype=D).view(-1, 1) * (0.5 / count)
    dense = torch.cat(((p + t * v + 0.5 * t.square() * a).flatten(1, 2), found.X[:, -1:, :2]), dim=1)
    counts = [passed_by_hand(dense[b].numpy(), part, b) for b in range(B)]
    chords = [passed_by_hand(found.X[b, :, :2].numpy(), part, b) for b in range(B)]
    assert judge(problem, found.U).gates_passed.tolist() == counts and sum(counts) < sum(chords)
    solved = np.isin(found.status.numpy(), [int(s) for s in SOLVED])
    assert solved.any() and (np.array(counts)[solved] == 1).all()
    missed = next(b for b in range(B) if counts[b] < chords[b])
    assert "gate 1 of 1 isn't passed" in " ".join(found.explain(missed).split())


def test_touching_a_plane_and_going_back_is_no_passage() -> None:
    """Two knots in the plane, from ahead to behind, a hair behind and a hair ahead: as solves once ended."""
    frame = drawn(1, 2, 1, 0).constraints[0]
    n, middle = frame.axes[0, 0, 0], frame.centers[0, 0]
    for hair in (0.0, 2e-9, 3.4e-4):
        s = torch.cat((torch.linspace(1.0, 0.1, 20), torch.tensor([-hair, hair]), torch.linspace(-0.1, -1.0, 19)))
        p = middle + s.to(D).view(-1, 1) * n
        for way, expected in ((p, 0), (p.flip(0), 1)):
            X = torch.cat((way, 0.0 * way), dim=-1).unsqueeze(0)
            found = passes(frame, X)
            assert found is not None and int(found.passed.sum()) == expected


@pytest.mark.slow
def test_a_gate_that_is_not_passed_is_named() -> None:
    """Of a point that stays at its start, and of every row."""
    for balls, told in ((False, "not crossed from behind to ahead"), (True, "from its middle, radius 0.3 m")):
        problem = drawn(1, 2, 2, 3, balls=balls)
        found = torchgco.solve(problem, verbose=False)
        assert "gate" not in str(found.explain(0)) and int(judge(problem, found.U).gates_passed) == 2
        found = replace(found, X=0.0 * found.X, U=0.0 * found.U)
        text = " ".join(found.explain(0).split())
        assert "gate 1 of 2 isn't passed: " in text and told in text
        (gates, _), k = problem.constraints, problem.constraints[0].places[0].tolist()
        rows = {(k[g], 0): ("radius" if balls else "plane", g) for g in (0, 1)}
        if not balls:
            rows |= {(k[g] + 1, 2): ("side", g) for g in (0, 1)}
            rows |= {(k[g] + shift, row): ("plane", g) for g in (0, 1) for shift, row in ((1, 0), (-1, 0), (2, 1))}
        assert len(rows) == (2 if balls else 10)
        for (knot, row), (what, g) in rows.items():
            assert gates.told(row, knot, problem.dynamics) == f"the {what} of gate {g + 1}"


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("along", "knots"), [
    ([1.0, 1.04], [19, 21]), ([1.0, 1.04], [19, 22]), ([1.0, 1.04], [19, 23]), ([0.02, 1.98], [1, N - 1]),
])  # fmt: skip
def test_at_neighbouring_knots_and_at_both_ends(along: list[float], knots: list[int]) -> None:
    """Of two problems, the second of which ends where its last gate does; and of a third, which has no start."""
    whole = drawn(3, 2, 2, 1)
    gates = Gates([[x, 0.0] for x in along], normals=[[1.0, 0.2]] * 2, half_widths=HALF, knots=knots)
    parts = [gates, ControlBounds(-40.0, 40.0)]
    horizon, x0 = [N, knots[1] + 1, N], whole.x0.clone()
    x0[2, 0] = torch.nan
    problem = Problem(whole.dynamics, whole.cost, parts, x0, N, whole.goal, horizon=horizon)
    for solver in ("gco", "interior_point"):
        found = torchgco.solve(problem, solver=solver, verbose=False)
        assert found.statuses == [Status.CONVERGED] * 2 + [Status.NON_FINITE]
        part = problem.constraints[0].bare
        assert [passed_by_hand(found.X[b, :, :2].numpy(), part, b) for b in range(2)] == [2, 2]
        assert judge(problem, found.U).gates_passed.tolist() == [2, 2, 0]


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["gco", "interior_point"])
@pytest.mark.parametrize("among", [False, True])
@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_all_over_the_sphere(d: int, free: bool, among: bool, solver: str) -> None:
    problem = drawn(256, d, 1, d, free, among)
    check(problem, torchgco.solve(problem, solver=solver, verbose=False), 0.95)
