"""Boxes: their rows by hand, where their slopes lead, and the checks of their input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import boxed_batch, planar_batch, random_trajectory
from torchgco import Boxes, InputError, Problem, Spheres
from torchgco.obstacles.base import ABSENT, Solids, marked
from torchgco.obstacles.box_geometry import Cuboids
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.roadmap.geometry import Inflated


def boxes_of(problem: Problem) -> BoundBoxes:
    (found,) = (c for c in problem.constraints if isinstance(c, BoundBoxes))
    return found


def turned(d: int, M: int = 6, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, half sides and rotations of M boxes."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(M, 4))
    rotations = turns[:, 0] if d == 2 else turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    return rng.uniform(-1, 1, (M, d)), rng.uniform(0.1, 0.6, (M, d)), rotations


def test_parts_of_a_batch_have_the_bits_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, U = boxed_batch(3, B=7, N=5)
    X, _ = random_trajectory(problem, spread=1.0)
    boxes, p = boxes_of(problem), X[..., problem.position]

    def distances(rows: slice) -> list[Tensor]:
        some, x, u, at = boxes.take(rows), X[rows], U[rows], p[rows]
        return [some.value(x, u), some.worst(x, u), some.segment_clearance(at[:, :-1], at[:, 1:])]

    everything = slice(None)
    whole = distances(everything)
    for size in (1, 3, 7):  # problems at once, or parts of one
        monkeypatch.setattr("torchgco.obstacles.boxes.BOX_GAPS_AT_ONCE", size * 6 * boxes.absent.shape[1])
        for part, expected in zip(distances(everything), whole, strict=True):
            assert torch.equal(part, expected)
    assert [d.shape[0] for d in distances(slice(0, 0))] == [0, 0, 0]


@pytest.mark.parametrize("d", [2, 3])
def test_rows_and_violations(d: int) -> None:
    problem, U = boxed_batch(d, B=3, N=12)
    X, _ = random_trajectory(problem, spread=0.3 * (4.0 if d == 3 else 1.0))
    boxes = boxes_of(problem)
    for i in range(int((~boxes.absent[0]).sum())):  # a knot within every box of the first problem
        X[0, 1 + i, problem.dynamics.position] = boxes.centers[0, i] + 0.3 * boxes.half_sizes[0, i]
    value = boxes.value(X, U)
    assert bool((value[0] > 0).any()) and bool((value[1][:, -1] == -1.0).all())
    size = torch.where(boxes.absent, 0.5, boxes.depths)
    depth = (value / (2 * size.unsqueeze(1))).clamp(min=0.0)
    torch.testing.assert_close(boxes.violation(X, U), depth)
    for k in (1, 5):
        torch.testing.assert_close(boxes.at(X[:, k : k + 1], k), value[:, k - 1 : k])


def test_every_point_inside_has_a_gradient_that_leads_out() -> None:
    """At the centre, on the medial axis and on the surface, where the distance itself has no gradient."""
    plain, U = planar_batch(B=1, N=4)
    problem = Problem(plain.dynamics, plain.cost, [Boxes([[0.0, 0.0]], [[0.3, 0.1]], 0.05)], plain.x0, 4)
    X = plain.x0.unsqueeze(1).repeat(1, 5, 1)
    X[0, 1:, :2] = torch.tensor([[0.0, 0.0], [0.15, 0.0], [0.3, 0.05], [-0.29, 0.0]], dtype=torch.float64)
    H = torch.zeros(1, 5, 9, 9, dtype=torch.float64)
    boxes_of(problem).accumulate(X, U, torch.ones(1, 4, 1, dtype=X.dtype), torch.zeros(1, 4, 1, dtype=X.dtype), H)
    slope = -H[0, 1:, :2, 6] / (2 * 0.15)
    torch.testing.assert_close(slope, slope.new_tensor([[0.0, 1.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]))


def test_a_rotation_by_zero_is_no_rotation() -> None:
    centers, half, _ = turned(2)
    plain, U = planar_batch(B=2, N=4)
    X, _ = random_trajectory(plain)
    rows = []
    for rotations in (None, np.zeros(6), np.full(6, np.pi)):
        problem = Problem(plain.dynamics, plain.cost, [Boxes(centers, half, 0.1, rotations)], plain.x0, 4)
        rows.append(problem.constraints[0].value(X, U))
    assert torch.equal(rows[0], rows[1])
    torch.testing.assert_close(rows[0], rows[2])


def test_a_start_within_touching_distance_is_refused() -> None:
    plain, _ = planar_batch(B=3, N=4)
    x0 = plain.x0.clone()
    x0[:, 0] = torch.tensor([-1.0, -0.156, -0.158], dtype=torch.float64)  # contact at 0.1 + 0.95 * 0.06 = 0.157
    problem = Problem(plain.dynamics, plain.cost, [Boxes([[0.0, 0.0]], [[0.1, 0.1]], 0.06)], x0, 4)
    assert problem.start_is_clear.tolist() == [True, False, True]


def test_of_an_absent_obstacle_only_the_mark_is_left() -> None:
    plain, _ = planar_batch(B=1, N=4)
    absent = [np.nan, np.nan]
    spheres = Spheres([absent, [3.0, 0.0]], [np.nan, 0.1], 0.05)
    parts = [spheres, Boxes([absent, [3.0, 3.0]], [absent, [0.2, 0.1]], 0.05)]
    for part in Problem(plain.dynamics, plain.cost, parts, plain.x0, 4).obstacles:
        solids = part.inflated()
        assert solids is not None and solids.absent.tolist() == [[True, False]]
        numbers = [value[0, 0] for name, value in vars(solids).items() if name not in ("absent", "axes")]
        assert not any(bool(value.any()) for value in numbers) and solids.sizes[0, 0] == 0
        assert marked(solids.radii, solids.absent).tolist() == [[ABSENT, float(solids.radii[0, 1])]]


def test_the_region_of_a_start_a_goal_and_boxes() -> None:
    zero = torch.zeros(1, 2, dtype=torch.float64)
    boxes = Cuboids(
        torch.zeros(1, 2, 2, dtype=torch.float64), zero, torch.tensor([[False, True]]),
        torch.eye(2, dtype=torch.float64).expand(1, 2, 2, 2),
        torch.tensor([[[1.0, 2.0], [9.0, 9.0]]], dtype=torch.float64),
    )  # fmt: skip
    none = Solids(zero.unsqueeze(1), zero[:, :1], torch.tensor([[True]]))
    low, high = Inflated(none, boxes).region(torch.tensor([[-4.0, 0.0]], dtype=torch.float64), zero)
    assert low.tolist() == [[-4.0, -3.0]] and high.tolist() == [[1.5, 3.0]]


BAD = {
    "shape": (dict(centers=[[0.0, 0.0, 0.0]]), "boxes.centers: expected 2-D points, .* got 3-D"),
    "sides": (dict(half_sizes=[[0.1, 0.1]] * 2), r"boxes.half_sizes: expected shape \(2, 1, 2\), got \(2, 2, 2\)"),
    "side of length 0": (
        dict(half_sizes=[[0.1, 0.0]]),
        "boxes.half_sizes: expected finite half sides above 0 m",
    ),
    "mixed": (dict(half_sizes=[[0.1, np.nan]]), "boxes.half_sizes: expected NaN exactly where the centre is NaN"),
    "infinite": (dict(centers=[[np.inf, 0.0]]), "boxes.centers: expected finite points, or rows of NaN"),
    "vehicle": (dict(vehicle_radius=-1.0), "boxes.vehicle_radius: expected a number of at least 0 m"),
    "turn": (
        dict(rotations=[[1.0, 0, 0, 0]]),
        "boxes.rotations: expected shape \\(2, 1\\)",
    ),
    "missing rotation": (
        dict(rotations=[np.nan]),
        "boxes.rotations: expected finite numbers for every obstacle that is there",
    ),
    "text": (dict(centers="here"), "boxes.centers: expected numbers"),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed_boxes_are_named(case: str) -> None:
    changes, message = BAD[case]
    plain, _ = planar_batch(B=2, N=4)
    given = dict(centers=[[0.5, 0.5]], half_sizes=[[0.1, 0.1]], vehicle_radius=0.05) | changes
    with pytest.raises(InputError, match=message):
        Problem(plain.dynamics, plain.cost, [Boxes(**given)], plain.x0, 4)


def test_a_quaternion_without_unit_length_is_named() -> None:
    plain, _ = boxed_batch(3, B=1, N=3)
    for turn in ([0.0, 0, 0, 0], [1.0, 1.0, 0, 0]):
        box = Boxes([[3.0, 1, 0]], [[0.1] * 3], 0.1, [turn])
        with pytest.raises(InputError, match=r"boxes.rotations: expected unit quaternions \[w, x, y, z\]"):
            Problem(plain.dynamics, plain.cost, [box], plain.x0, 3)


def test_scales_of_both_kinds_agree() -> None:
    """A box as thick as a disc has rows with the same slope at its surface."""
    plain, U = planar_batch(B=1, N=1)
    X = plain.x0.unsqueeze(1).repeat(1, 2, 1)
    X[0, 1, :2] = torch.tensor([0.15, 0.0], dtype=torch.float64)
    slopes = []
    for part in (Spheres([[0.0, 0.0]], [0.1], 0.05), Boxes([[0.0, 0.0]], [[0.1, 0.1]], 0.05)):
        (obstacles,) = Problem(plain.dynamics, plain.cost, [part], plain.x0, 1).constraints
        H = torch.zeros(1, 2, 9, 9, dtype=torch.float64)
        obstacles.accumulate(X, U, torch.ones(1, 1, 1, dtype=X.dtype), torch.zeros(1, 1, 1, dtype=X.dtype), H)
        slopes.append(float(H[0, 1, 0, 6]))
    assert slopes == pytest.approx([-0.3, -0.3])
