"""The judge and the certificate among boxes, sharp and rounded, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.problems import boxed_batch, random_trajectory
from tests.reference import boxes as brute_force
from tests.slow import mostly
from torchgco import Boxes, Problem, certify, judge
from torchgco.dynamics.rollout import open_loop
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.measured import closest

SAMPLES = 601


def boxed_problem(d: int, N: int = 8, rounded: bool = False) -> tuple[Problem, BoundBoxes, tuple[np.ndarray, ...]]:
    """Two problems with different rotated boxes, the boxes, and their centres, half sizes, rotations and radii.

    rounded  the first of the three is a capsule, the second a box, the third a sphere
    """
    rng = np.random.default_rng(5)
    plain, _ = boxed_batch(d, B=2, N=N)
    start = plain.x0[0, :d].numpy()
    centers, half = start + rng.uniform(-1, 1, (2, 3, d)), rng.uniform(0.05, 0.3, (2, 3, d))
    turns = rng.normal(size=(2, 3, 4))
    rotations = turns[..., 0] if d == 2 else turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    radii = rng.uniform(0.05, 0.2, (2, 3)) if rounded else np.zeros((2, 3))
    if rounded:
        half[:, 0, 1:], half[:, 2] = 0, 0
    problem = Problem(plain.dynamics, plain.cost, [Boxes(centers, half, 0.1, rotations, radii)], plain.x0, N)
    boxes = problem.constraints[0]
    assert isinstance(boxes, BoundBoxes)
    return problem, boxes, (centers, half, rotations, radii)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("rounded", mostly([False, True], False))
@pytest.mark.parametrize("d", [2, 3])
def test_clearances_against_sampled_segments(d: int, rounded: bool) -> None:
    problem, boxes, parts = boxed_problem(d, rounded=rounded)
    X, _ = random_trajectory(problem, spread=0.5)
    X[:, 3] = X[:, 2]  # a segment of no length
    X[:, 5, :d] = 2 * boxes.centers[:, 0] - X[:, 4, :d]  # and one right through a box
    at_knots, between = boxes.clearances(X)
    for b in range(2):
        single = boxes.take(torch.tensor([b]))
        near, a = single.measured(X[b : b + 1])[1][0], X[b, :, :d]
        boxes_of = [part[0] for part in (single.axes, single.centers, single.half_sizes)]
        each = [
            closest(*(part.expand(8, *part.shape[1:]) for part in box), a[:-1], a.diff(dim=0))
            for box in zip(*(part.split(1) for part in boxes_of), strict=True)
        ]
        chords = torch.stack(each, dim=-1) - single.inflated_radii
        assert (near <= chords + 1e-12).all() and (near < chords - 1e-3).any()
        torch.testing.assert_close(near.amin(), chords.amin(), rtol=0, atol=1e-12)
        p, knots, nearest = X[b, :, :d].numpy(), np.inf, np.inf
        for i in range(3):
            box = tuple(part[b, i] for part in parts)
            touch = 0.05 * (parts[-1][b, i] + 0.1)  # bodies touch so far beneath the full surface
            knots = min([knots, *(brute_force.distance(q, *box) + touch for q in p)])
            for k in range(problem.N):
                distance = brute_force.segment_distance(p[k], p[k + 1], *box, samples=SAMPLES)
                step = np.linalg.norm(p[k + 1] - p[k]) / (SAMPLES - 1)
                assert distance - step - 1e-12 <= float(chords[k, i]) + 0.1 <= distance + 1e-12
                nearest = min(nearest, distance + touch)
        assert float(at_knots[b]) == pytest.approx(knots - 0.1, abs=1e-12)
        assert nearest - 0.1 - 0.01 <= float(between[b]) <= nearest - 0.1 + 1e-12
        assert float(between[b]) < 0


def test_a_path_through_a_wall_is_seen_between_knots_alone() -> None:
    plain, _ = boxed_batch(2, B=1, N=1)
    wall = Boxes([[0.0, 0.0]], [[0.01, 5.0]], 0.06)
    problem = Problem(plain.dynamics, plain.cost, [wall], plain.x0, 1)
    (boxes,) = problem.constraints
    X = plain.x0.unsqueeze(1).repeat(1, 2, 1)
    X[0, 1, 0] = 1.0
    at_knots, between = boxes.clearances(X)
    assert float(at_knots) == pytest.approx(0.99 - 0.057) and float(between) == pytest.approx(-0.01 - 0.057)


@pytest.mark.parametrize("rounded", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_a_verdict_and_a_certificate_among_boxes_and_spheres(d: int, rounded: bool) -> None:
    problem, U = boxed_batch(d, B=3, N=10, rounded=rounded)
    X = open_loop(problem.dynamics, problem.x0, U)
    verdict, certificate = judge(problem, U), certify(problem, X, U)
    assert bool(torch.isfinite(verdict.clearance).all()) and bool((verdict.clearance <= verdict.clearance_knots).all())
    touch = 0.05 * problem.constraints[0].vehicle_radius
    assert bool((certificate.clearance <= verdict.clearance - touch + 1e-9).all())
    gone = U.clone()
    gone[1] = torch.nan
    assert judge(problem, gone).feasible.tolist()[1] is False
    alone = judge(problem.take(torch.tensor([2])), U[2:])
    assert float(alone.clearance) == float(verdict.clearance[2])


def test_absent_boxes_give_infinite_clearance() -> None:
    plain, U = boxed_batch(2, B=1, N=4)
    absent = Boxes([[np.nan, np.nan]], [[np.nan, np.nan]], 0.06)
    problem = Problem(plain.dynamics, plain.cost, [absent], plain.x0, 4)
    assert float(judge(problem, U).clearance) == float("inf")
    X = open_loop(problem.dynamics, problem.x0, U)
    assert float(certify(problem, X, U).clearance) == float("inf")
