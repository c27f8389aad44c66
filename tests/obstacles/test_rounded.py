"""Rounded boxes and capsules against slow NumPy, spheres and autodiff, and the checks of their input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import boxed_batch, planar_batch, quadrotor_batch, random_trajectory
from tests.reference import boxes as brute_force
from tests.slow import mostly
from torchgco import Boxes, Capsules, Constraint, InputError, Problem, Spheres
from torchgco.obstacles import CONTACT_FACTOR
from torchgco.obstacles.boxes import BoundBoxes

VEHICLE = 0.1  # m


def bound(part: Constraint, d: int, B: int = 1, N: int = 4) -> tuple[BoundBoxes, Problem]:
    plain, _ = (planar_batch if d == 2 else quadrotor_batch)(B=B, N=N)
    problem = Problem(plain.dynamics, plain.cost, [part], plain.x0, N)
    (boxes,) = problem.constraints
    assert isinstance(boxes, BoundBoxes)
    return boxes, problem


def rounded(d: int, M: int = 8, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Centres, half sides, rotations and radii: boxes, plates, capsules and a sphere, rounded and turned."""
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(M, 4))
    rotations = turns[:, 0] if d == 2 else turns / np.linalg.norm(turns, axis=-1, keepdims=True)
    half, radii = rng.uniform(0.1, 0.6, (M, d)), rng.uniform(0.05, 0.3, M)
    half[1, 0], half[2, 1], half[3, :-1], half[4, 1:], half[5] = 0, 0, 0, 0, 0
    radii[7] = 0.0  # a sharp one among them
    return rng.uniform(-1, 1, (M, d)), half, rotations, radii


def ends_of(d: int, M: int = 6, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Starts, ends and radii of capsules: oblique, along each sense of the axes, and one without length."""
    rng = np.random.default_rng(seed)
    starts, along = rng.uniform(-1, 1, (M, d)), rng.uniform(-1, 1, (M, d))
    along[0], along[1], along[2], along[3] = 0, 0.8 * np.eye(d)[-1], -0.8 * np.eye(d)[-1], -0.5 * np.eye(d)[0]
    return starts, starts + along, rng.uniform(0.1, 0.3, M)


def points(d: int, count: int, seed: int = 1) -> Tensor:
    return torch.as_tensor(np.random.default_rng(seed).uniform(-2, 2, (1, count, d)))


def distances(boxes: BoundBoxes, p: Tensor) -> np.ndarray:
    return boxes.signed_distance(p, torch.zeros(p.shape[1], dtype=p.dtype))[0].numpy()


def one_by_one(boxes: BoundBoxes, a: Tensor, b: Tensor) -> Tensor:
    """Distances (E, M) of segments a to b (1, E, d), each as if there were no other box and no other segment."""
    segments, columns = range(a.shape[1]), []
    for i in range(boxes.absent.shape[1]):
        others = torch.arange(boxes.absent.shape[1]) != i
        box = replace(boxes, absent=boxes.absent | others)
        columns.append([float(box.segment_clearance(a[:, e : e + 1], b[:, e : e + 1])[0, 0, i]) for e in segments])
    return torch.tensor(columns, dtype=a.dtype).T


def check_bounds(boxes: BoundBoxes, found: Tensor, alone: Tensor) -> None:
    """Of all together, distances within a margin of the smallest are exact, the others at most as large."""
    near = alone <= alone.min() + boxes.margins.amax()
    torch.testing.assert_close(found[near], alone[near], rtol=0, atol=1e-12)
    assert bool((found <= alone + 1e-12).all()) and bool((found[~near] > alone.min()).all()) and bool(near.any())


@pytest.mark.parametrize("d", [2, 3])
def test_distances_of_rounded_boxes_by_hand(d: int) -> None:
    centers, half, rotations, radii = rounded(d)
    boxes, _ = bound(Boxes(centers, half, VEHICLE, rotations, radii), d)
    # The last points lie within the boxes, at the centre first: on the axis of a capsule.
    p = torch.cat((points(d, 40), torch.as_tensor(centers)[None], torch.as_tensor(centers)[None] + 0.01), dim=1)
    found = distances(boxes, p)
    for k in range(p.shape[1]):
        for i in range(len(centers)):
            by_hand = brute_force.distance(p[0, k].numpy(), centers[i], half[i], rotations[i], radii[i])
            assert found[k, i] == pytest.approx(by_hand - VEHICLE, abs=1e-12)
    inner = radii + VEHICLE + half.min(axis=1)
    assert boxes.depths[0].numpy() == pytest.approx(inner)
    assert (found[40 : 40 + len(centers)].diagonal() == pytest.approx(-inner)) and found.max() > 1


@pytest.mark.parametrize("d", [2, 3])
def test_distances_of_capsules_by_sampling(d: int) -> None:
    starts, ends, radii = ends_of(d)
    boxes, _ = bound(Capsules(starts, ends, radii, VEHICLE), d)
    p = torch.cat((points(d, 30), torch.as_tensor(0.3 * starts + 0.7 * ends)[None]), dim=1)
    found = distances(boxes, p)
    for k in range(p.shape[1]):
        for i in range(len(starts)):
            by_hand = brute_force.distance_from_capsule(p[0, k].numpy(), starts[i], ends[i], radii[i])
            assert found[k, i] == pytest.approx(by_hand - VEHICLE, abs=1e-4)


@pytest.mark.parametrize("d", [2, 3])
def test_segments_against_dense_samples(d: int) -> None:
    centers, half, rotations, radii = rounded(d)
    boxes, _ = bound(Boxes(centers, half, VEHICLE, rotations, radii), d)
    a, b = points(d, 10, seed=2), points(d, 10, seed=3)
    b[:, 0] = a[:, 0]  # a segment of no length
    a[:, 1:6], b[:, 1:6] = torch.as_tensor(centers[:5]) - 0.2, torch.as_tensor(centers[:5]) + 0.2  # through the middles
    alone = one_by_one(boxes, a, b)
    check_bounds(boxes, boxes.segment_clearance(a, b)[0], alone)
    found = alone.numpy() + VEHICLE
    for e in range(10):
        for i in range(len(centers)):
            ends, box = (a[0, e].numpy(), b[0, e].numpy()), (centers[i], half[i], rotations[i], radii[i])
            sampled = brute_force.segment_distance(*ends, *box, samples=101)
            step = float((b[0, e] - a[0, e]).norm()) / 100
            assert sampled - step - 1e-12 <= found[e, i] <= sampled + 1e-12


@pytest.mark.parametrize("d", [2, 3])
def test_rows_and_derivatives_are_autodiffs(d: int) -> None:
    centers, half, rotations, radii = rounded(d)
    plain, U = boxed_batch(d, B=2, N=12)
    at = plain.dynamics.position
    assert at is not None
    offset = plain.x0[0, at].numpy()
    part = Boxes(centers + offset, half, VEHICLE, rotations, radii)
    problem = Problem(plain.dynamics, plain.cost, [part], plain.x0, 12)
    (boxes,) = problem.constraints
    X, _ = random_trajectory(problem, spread=0.5)
    value = boxes.value(X, U)
    assert bool((value > 0).any())
    generator = torch.Generator().manual_seed(4)
    g, h = (torch.rand(value.shape, generator=generator, dtype=torch.float64) for _ in range(2))
    s = problem.n + 1 + problem.m
    H = torch.zeros(2, 13, s, s, dtype=torch.float64)
    boxes.accumulate(X, U, g, h, H)
    for b in range(2):
        one = boxes.take(torch.tensor([b]))
        slopes = torch.autograd.functional.jacobian(lambda x, one=one: one.value(x, U[:1])[0], X[b : b + 1])
        for k in range(1, 13):
            J = slopes[k - 1, :, 0, k]
            torch.testing.assert_close(H[b, k, : problem.n, problem.n], J.T @ g[b, k - 1])
            torch.testing.assert_close(H[b, k, : problem.n, : problem.n], J.T @ torch.diag(h[b, k - 1]) @ J)


@pytest.mark.parametrize("d", mostly([2, 3], 3))
def test_a_capsule_without_length_is_as_far_as_a_sphere(d: int) -> None:
    centers, radii = np.random.default_rng(7).uniform(-1, 1, (5, d)), np.linspace(0.1, 0.4, 5)
    plain, _ = (planar_batch if d == 2 else quadrotor_batch)(B=1, N=4)
    parts = [Capsules(centers, centers, radii, VEHICLE), Boxes(centers, np.zeros((5, d)), VEHICLE, None, radii)]
    parts.append(Spheres(centers, radii, VEHICLE))
    capsules, boxes, spheres = Problem(plain.dynamics, plain.cost, parts, plain.x0, 4).constraints
    p, t = points(d, 50), torch.zeros(50, dtype=torch.float64)
    for kind in (capsules, boxes):
        torch.testing.assert_close(kind.signed_distance(p, t), spheres.signed_distance(p, t))
        torch.testing.assert_close(kind.margins, spheres.margins)
        a, b = p[:, :25], p[:, 25:]
        torch.testing.assert_close(one_by_one(kind, a, b), spheres.segment_clearance(a, b)[0])


@pytest.mark.parametrize("d", [2, 3])
def test_the_slope_on_a_capsules_axis_leads_out(d: int) -> None:
    starts, ends, radii = ends_of(d)
    starts, ends, radii = starts[3:], ends[3:], radii[3:]
    plain, _ = (planar_batch if d == 2 else quadrotor_batch)(B=1, N=3)
    problem = Problem(plain.dynamics, plain.cost, [Capsules(starts, ends, radii, VEHICLE)], plain.x0, 3)
    (capsules,) = problem.constraints
    at, X = problem.position, plain.x0.unsqueeze(1).repeat(1, 4, 1)
    X[0, 1:, at] = torch.as_tensor(0.4 * starts + 0.6 * ends)
    for i in range(3):
        s = problem.n + 1 + problem.m
        H, g = torch.zeros(1, 4, s, s, dtype=X.dtype), torch.zeros(1, 3, 3, dtype=X.dtype)
        g[..., i] = 1.0
        capsules.accumulate(X, X.new_zeros(1, 3, problem.m), g, 0 * g, H)
        slope = -H[0, 1 + i, at, problem.n].numpy() / (2 * (radii[i] + VEHICLE))
        assert np.linalg.norm(slope) == pytest.approx(1.0)
        assert abs(slope @ (ends[i] - starts[i])) < 1e-12


def test_bodies_touch_as_spheres_do() -> None:
    """A post in the plane, seen from its side: contact at 0.95 (r + r_veh), also of grown posts."""
    plain, _ = planar_batch(B=3, N=4)
    x0 = plain.x0.clone()
    x0[:, :2] = torch.tensor([[0.2, 0.3], [0.0, 0.15], [0.0, 0.14]], dtype=x0.dtype)  # contact at 0.1425
    post = Capsules([[-0.2, 0.0]], [[0.2, 0.0]], [0.1], 0.05)
    problem = Problem(plain.dynamics, plain.cost, [post], x0, 4)
    assert problem.start_is_clear.tolist() == [True, True, False]
    (boxes,) = problem.constraints
    wide = boxes.grown(torch.tensor([0.0, 0.01, 0.02], dtype=x0.dtype))
    assert wide.margins.flatten().tolist() == pytest.approx([0.15, 0.16, 0.17])
    assert torch.equal(wide.depths, wide.margins)
    X = x0.unsqueeze(1).repeat(1, 5, 1)
    touch = boxes.chord_clearance(X)
    assert touch.tolist() == pytest.approx([0.3 - 0.1425, 0.0075, -0.0025]) and CONTACT_FACTOR == 0.95


@pytest.mark.parametrize("d", [2, 3])
def test_absent_capsules_are_never_violated(d: int) -> None:
    starts, ends, radii = (np.stack((part, part)) for part in ends_of(d))
    for part in (starts, ends, radii):
        part[1, -2:] = np.nan
    boxes, problem = bound(Capsules(starts, ends, radii, VEHICLE), d, B=2)
    assert boxes.absent[1].tolist() == [False] * 4 + [True] * 2 and boxes.margins[1, -1] == 0
    X, U = random_trajectory(problem)
    assert bool((boxes.value(X, U)[1, :, -2:] == -1).all()) and bool(torch.isfinite(boxes.axes).all())
    few = Capsules(*(part[1, :-2] for part in (starts, ends, radii)), VEHICLE)
    alone, _ = bound(few, d, B=2)
    assert torch.equal(alone.value(X, U)[1], boxes.value(X, U)[1, :, :4])


def test_radii_of_zero_change_nothing() -> None:
    centers, half, rotations, _ = rounded(3)
    half = half + 0.1
    (sharp, problem), (zero, _) = (bound(Boxes(centers, half, VEHICLE, rotations, r), 3) for r in (None, np.zeros(8)))
    X, U = random_trajectory(problem, spread=1.0)
    assert torch.equal(sharp.value(X, U), zero.value(X, U)) and torch.equal(sharp.margins, zero.margins)


BOX = dict(centers=[[0.5, 0.5]], half_sizes=[[0.1, 0.0]], vehicle_radius=0.05, radii=[0.1])
POST = dict(starts=[[0.5, 0.5]], ends=[[0.5, 0.9]], radii=[0.1], vehicle_radius=0.05)
NAN = np.nan
BAD = {
    "flat without a radius": (BOX | dict(radii=[0.0]), "boxes.half_sizes: expected finite half sides above 0 m"),
    "no radii at all": (BOX | dict(radii=None), "boxes.half_sizes: expected finite half sides above 0 m"),
    "negative side": (BOX | dict(half_sizes=[[0.1, -0.1]]), r"boxes.half_sizes: expected .* got \[0.1, -0.1\]"),
    "infinite side": (BOX | dict(half_sizes=[[0.1, np.inf]]), "boxes.half_sizes: expected finite half sides"),
    "number of radii": (BOX | dict(radii=[0.1, 0.1]), r"boxes.radii: expected shape \(2, 1\), got \(2, 2\)"),
    "negative radius": (BOX | dict(radii=[-0.1]), "boxes.radii: expected finite radii of at least 0 m, got -0.1"),
    "infinite radius": (BOX | dict(radii=[np.inf]), "boxes.radii: expected finite radii of at least 0 m, got inf"),
    "missing radius": (BOX | dict(radii=[NAN]), "boxes.radii: expected NaN exactly where the obstacle is absent"),
    "text": (POST | dict(starts="here"), "capsules.starts: expected numbers"),
    "another space": (POST | dict(starts=[[0.5, 0.5, 0.0]]), "capsules.starts: expected 2-D points, .* got 3-D"),
    "fewer ends": (POST | dict(ends=[]), r"capsules.ends: expected shape \(2, 1, 2\), got \(2, 0, 2\)"),
    "an absent end": (POST | dict(ends=[[NAN, NAN]]), "capsules.ends: expected NaN exactly where the start is NaN"),
    "half an end": (POST | dict(ends=[[0.1, NAN]]), r"capsules.ends: expected finite points, or rows of NaN"),
    "infinite start": (POST | dict(starts=[[np.inf, 0.0]]), "capsules.starts: expected finite points"),
    "no thickness": (POST | dict(radii=[0.0]), "capsules.radii: expected radii above 0 m, got 0.0"),
    "negative post": (POST | dict(radii=[-1.0]), "capsules.radii: expected finite radii of at least 0 m, got -1.0"),
    "absent radius": (POST | dict(radii=[NAN]), "capsules.radii: expected NaN exactly where the obstacle is absent"),
    "vehicle": (POST | dict(vehicle_radius=-1.0), "capsules.vehicle_radius: expected a number of at least 0 m"),
    "vehicles": (POST | dict(vehicle_radius=[0.1] * 3), "capsules.vehicle_radius: expected a number, or 2 of them"),
    "knots": (POST | dict(knots=[99]), "capsules.knots: "),
}


@pytest.mark.parametrize("case", BAD)
def test_malformed_input_is_named(case: str) -> None:
    given, message = BAD[case]
    plain, _ = planar_batch(B=2, N=4)
    part = Capsules(**given) if "starts" in given else Boxes(**given)
    with pytest.raises(InputError, match=message) as caught:
        Problem(plain.dynamics, plain.cost, [part], plain.x0, 4)
    assert "\n" not in str(caught.value)


def test_a_model_without_a_position_takes_no_capsules() -> None:
    plain, _ = planar_batch(B=2, N=4)
    blind = replace(plain.dynamics)
    object.__setattr__(blind, "position", None)
    with pytest.raises(InputError, match=r"capsules.starts: expected dynamics with a position: set"):
        Problem(blind, plain.cost, [Capsules(**POST)], plain.x0, 4)
