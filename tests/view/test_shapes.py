"""What is drawn is where the obstacles are, and marks are where they are touched."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.view.scenes import DT, RADIUS, SOLVERS, N, problem, trajectories
from torchgco import (
    Boxes,
    Field,
    FunctionDynamics,
    Moved,
    OscillatingBoxes,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Unicycle,
)
from torchgco.dynamics import Dynamics
from torchgco.judging.contact import contacts
from torchgco.maps import DistanceField, OccupancyGrid, PointCloud
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.obstacles.shapes import RoundedBoxes
from torchgco.plotting.scene import world_of
from torchgco.view import document
from torchgco.view.document import flights_of, violated, whole
from torchgco.view.packing import Packing
from torchgco.view.shapes import Shapes, merged, once, shapes_of, turns
from torchgco.view.vehicles import Look, look_of


def distance(shapes: Shapes, p: np.ndarray, t: float) -> np.ndarray:
    """Distances (M,) of a point from the surfaces of the shapes as the page draws them."""
    M, d = shapes.center.shape
    center = shapes.center + (0 if shapes.velocity is None else t * shapes.velocity)
    if shapes.track is not None:
        at, times = shapes.track, shapes.step * np.arange(len(shapes.track))
        center = np.stack([[np.interp(t, times, at[:, i, j]) for j in range(d)] for i in range(M)])
    if shapes.turn is None:
        axes = np.tile(np.eye(d), (M, 1, 1))
    elif d == 2:
        c, s = np.cos(shapes.turn), np.sin(shapes.turn)
        axes = np.moveaxis(np.array([[c, s], [-s, c]]), 2, 0)
    else:
        axes = Rotation.from_quat(shapes.turn[:, [1, 2, 3, 0]]).as_matrix().transpose(0, 2, 1)
    over = np.abs(np.einsum("mij,mj->mi", axes, p - center)) - shapes.half
    return np.linalg.norm(over.clip(min=0), axis=1) + over.max(axis=1).clip(max=0) - shapes.radius


def test_every_kind_is_drawn_where_it_is() -> None:
    task, rng = problem(2), np.random.default_rng(1)
    for part in task.obstacles:
        shapes = shapes_of(part, 1, 1.0)
        assert shapes is not None and len(shapes.center) == int((~part.absent[1]).sum())
        for p, t in zip(rng.uniform(-3, 9, (40, 3)), rng.uniform(0, 4, 40), strict=True):
            there = part.signed_distance(torch.from_numpy(p).expand(2, 1, 3), torch.tensor([t]).double())[1, 0]
            there = there[~part.absent[1]].numpy() + RADIUS
            np.testing.assert_allclose(distance(shapes, p, t), there, atol=1e-9)


def test_what_swings_is_drawn_where_it_is() -> None:
    rng, task = np.random.default_rng(5), problem(2)
    boxes = Boxes(rng.uniform(0, 5, (2, 3)), [[0.3, 0.1, 0.2], [0.4, 0.4, 0.4]], RADIUS)
    sines = (rng.uniform(low, high, (2, 2, 3)) for low, high in ((-1, 1), (-3, 3), (-3, 3)))
    part = Problem(task.dynamics, task.cost, [OscillatingBoxes(boxes, *sines)], task.x0, N).obstacles[0]
    shapes = shapes_of(part, 1, 20.0)
    assert shapes is not None and shapes.track is not None
    for p, t in zip(rng.uniform(-3, 9, (40, 3)), rng.uniform(0, 20, 40), strict=True):
        there = part.signed_distance(torch.from_numpy(p).expand(2, 1, 3), torch.tensor([t]).double())[1, 0].numpy()
        np.testing.assert_allclose(distance(shapes, p, t), there + RADIUS, atol=0.03)  # 0.5 % of swings up to 4 m


@pytest.mark.parametrize("half", [None, [[0.3, 0.1, 0.0], [0.4, 0.4, 0.4]]])
def test_what_follows_a_track_is_drawn_where_it_is(half: list[list[float]] | None) -> None:
    rng, task = np.random.default_rng(4), problem(2)
    path = rng.uniform(0, 5, (N + 1, 2, 3))
    task = Problem(task.dynamics, task.cost, [Moved(path, 0.2, RADIUS, half)], task.x0, N)
    part, bodies = task.obstacles[0], world_of(task, 1).scenes[0].bodies[0]
    shapes = shapes_of(part, 1, 1.0)
    assert shapes is not None and len(bodies) == 2 and all(body.moving for body in bodies)
    for p, t in zip(rng.uniform(-3, 9, (40, 3)), rng.uniform(0, 5, 40), strict=True):
        there = part.signed_distance(torch.from_numpy(p).expand(2, 1, 3), torch.tensor([t]).double())[1, 0].numpy()
        np.testing.assert_allclose(distance(shapes, p, t), there + RADIUS, atol=1e-9)
        drawn = [body.distance(p[None], np.array([t]))[0] - body.radius for body in bodies]
        np.testing.assert_allclose(drawn, there + RADIUS, atol=1e-9)
    held = shapes.packed(Packing(), np.zeros(3))
    assert held["knots"] == N + 1 and held["step"] == DT and held["track"]["shape"] == [2 * (N + 1), 3]


def test_turned_boxes_in_the_plane() -> None:
    cost = QuadraticCost(Q=[0.0] * 6, R=[1.0] * 2, Qf=[1.0] * 6, x_ref=[1.0, 0, 0, 0, 0, 0])
    boxes = Boxes([[0.5, 0.2], [0.1, 0.9]], [[0.3, 0.1], [0.2, 0.2]], 0.05, rotations=[0.7, -2.0], radii=[0.1, 0.0])
    task = Problem(Planar(), cost, [boxes], torch.zeros(1, 6, dtype=torch.float64), 5)
    shapes = shapes_of(task.obstacles[0], 0, 1.0)
    assert shapes is not None
    for p in np.random.default_rng(2).uniform(-1, 1, (20, 2)):
        there = task.obstacles[0].signed_distance(torch.from_numpy(p).view(1, 1, 2), torch.zeros(1))[0, 0].numpy()
        np.testing.assert_allclose(distance(shapes, p, 0.0), there + 0.05, atol=1e-9)


def test_quaternions_of_any_turn() -> None:
    turned = Rotation.random(200, random_state=3).as_matrix()
    half = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()  # where a component of the quaternion is 0
    for matrices in (turned, half):
        found = turns(matrices.transpose(0, 2, 1))
        assert found is not None
        np.testing.assert_allclose(Rotation.from_quat(found[:, [1, 2, 3, 0]]).as_matrix(), matrices, atol=1e-12)
    assert turns(np.tile(np.eye(3), (4, 1, 1))) is None


def test_sides_in_any_order_are_turned_to_be_drawn() -> None:
    sides = Rotation.random(5, random_state=4).as_matrix()[:, [1, 0, 2]]  # left-handed
    found = turns(sides)
    assert found is not None
    drawn = Rotation.from_quat(found[:, [1, 2, 3, 0]]).as_matrix().transpose(0, 2, 1)
    np.testing.assert_allclose(np.abs((drawn * sides).sum(-1)), 1.0, atol=1e-12)  # the same sides, whichever way


def test_equal_rows_are_kept_once() -> None:
    assert once(np.ones((5, 2))).shape == (1, 2) and once(np.eye(2)).shape == (2, 2)


def test_a_kind_that_is_added_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    part = problem(1).obstacles[1]
    other = RoundedBoxes(np.zeros((1, 3)), np.ones((1, 3)), np.eye(3)[None], np.zeros(1))
    seen = shapes_of(part, 0, 1.0)  # as the search for paths sees boxes
    assert seen is not None and np.allclose(seen.half, part.half_sizes[0])  # type: ignore[attr-defined]
    monkeypatch.setattr(BoundBoxes, "shapes", lambda part, b: other)
    drawn = shapes_of(part, 0, 1.0)
    assert drawn is not None and drawn.half is other.half and drawn.center is other.center


@pytest.mark.parametrize("shape", [(7,), (6, 9), (5, 6, 7), (1, 1, 1)])
def test_occupied_cells_are_filled_once(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    for share in (0.0, 0.3, 0.8, 1.0):
        cells, filled = rng.random(shape) < share, np.zeros(shape, dtype=int)
        for low, high in zip(*merged(cells), strict=True):
            filled[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] += 1
        np.testing.assert_array_equal(filled, cells)
    assert len(merged(np.ones(shape, dtype=bool))[0]) == 1


@pytest.mark.parametrize("batch", [False, True])
def test_cells_and_points_of_maps_are_drawn_where_they_are(batch: bool) -> None:
    rng = np.random.default_rng(5)
    cells = rng.random((2, 6, 5, 4) if batch else (6, 5, 4)) < 0.2
    origin = rng.uniform(-1, 1, (2, 3) if batch else 3)
    x0 = torch.zeros(2, 3, dtype=torch.float64)
    dynamics = FunctionDynamics(lambda x, u: u, n=3, m=3, dt=DT, position=slice(0, 3))
    cost = QuadraticCost(Q=[0.0] * 3, R=[1.0] * 3, Qf=[1.0] * 3, x_ref=[8.0, 0, 0])

    def drawn(source: OccupancyGrid | PointCloud) -> Shapes:
        found = shapes_of(Problem(dynamics, cost, [Field(DistanceField.of(source), 0.1)], x0, 4).obstacles[0], 1, 1.0)
        assert found is not None
        return found

    shapes = drawn(OccupancyGrid(cells, origin, 0.2))
    own, lowest = (cells[1], origin[1]) if batch else (cells, origin)
    for index in np.ndindex(own.shape):
        inside = distance(shapes, lowest + 0.2 * (np.array(index) + 0.5), 0.0).min(initial=1.0) < 0
        assert inside == own[index]
    points = rng.uniform(-1, 1, (2, 9, 3) if batch else (9, 3))
    np.testing.assert_allclose(drawn(PointCloud(points, 0.3)).center, points[1] if batch else points)


def test_violations_are_those_of_the_worst_constraint_at_each_knot() -> None:
    task, X = problem(2), trajectories(2)[SOLVERS[1]]
    U = X.new_zeros(2, N, 3)
    violation, which = violated(task, X, U, 1e-3)
    for k in range(N + 1):
        depth = [
            float((-part.signed_distance(X[:1, k : k + 1], torch.tensor([k * DT])).amin()).clamp(min=0)) if k else 0.0
            for part in task.obstacles
        ]
        worst = int(np.argmax(depth)) if max(depth) > 1e-3 else -1
        assert which[0, k] == worst
        np.testing.assert_allclose(violation[0, k], max(depth) if worst >= 0 else 0.0, atol=1e-9)


def test_the_worst_constraint_is_named_in_the_table() -> None:
    task, X = problem(1), trajectories(1)[SOLVERS[1]]
    (flight,) = flights_of(task, Look(), X, X.new_zeros(1, N, 3), "one", ["failed"], [[]], 1e-3, np.array([False]))
    ((label, text),) = flight.rows
    # The straight line meets the centre of the sphere at (3, 0, 0): 0.8 m + 0.3 m deep, at knot 15.
    assert label == "worst" and text == "Spheres, knot 15: 1.1 m"
    good = trajectories(1)[SOLVERS[0]]
    (flight,) = flights_of(task, Look(), good, X.new_zeros(1, N, 3), "one", ["reached"], [[]], 1e-3, np.array([True]))
    assert flight.rows == [] and len(flight.contacts) == 0


def test_contact_is_marked_once_where_it_is_deepest() -> None:
    task = problem(1)
    path = np.stack((np.linspace(0, 8, 81), np.full(81, 0.2), np.zeros(81)), axis=-1)
    found = contacts(task.obstacles, path, DT)
    # The sphere at (3, 0, 0), and the moving one at (6, 2.5 - 0.5 t, 0), which is there at t = 6.
    assert len(found) == 2 and np.allclose(found[0], [3.0, 0.2, 0.0])
    assert abs(found[1][0] - 6.0) < 0.6
    assert len(contacts(task.obstacles, path - [0, 0, 5.0], DT)) == 0
    assert contacts(task.obstacles, path[:0], DT).shape == (0, 3)
    assert len(contacts(task.obstacles, path[:1], DT)) == 0
    long = np.array([[0.0, 0.2, 0], [6.0, 0.2, 0]])  # both knots are clear of the sphere at rest
    np.testing.assert_allclose(contacts(task.obstacles[:1], long, DT), [[3.0, 0.2, 0]])
    below = long - np.array([0.0, 2.2, 0.0])
    np.testing.assert_allclose(contacts(task.obstacles[1:], below, DT), [[4.5, -2, 0]])


def test_a_path_ends_where_it_is_lost() -> None:
    X = np.arange(12.0).reshape(4, 3)
    X[2, 1] = np.nan
    assert len(whole(X)) == 2 and len(whole(np.array([[0.0], [1e7]]))) == 1


def model(names: tuple[str, ...], d: int = 2) -> Dynamics:
    """Dynamics with states of these names, whose position comes first."""
    fields = {"n": len(names), "m": 1, "dt": 0.1, "state_names": names, "position": slice(0, d)}
    return type("Own", (Dynamics,), fields)()


def test_models_that_are_not_listed_turn_by_the_names_of_their_states() -> None:
    assert look_of(Unicycle()) == Look("car", heading=2) and look_of(QuadrotorPlanning()).body == "quadrotor"
    assert look_of(model(("x", "y", "v", "heading"))) == Look("dart", heading=3)
    assert look_of(model(("x", "y", "z", "qw", "qx", "qy", "qz"), 3)) == Look("dart", quaternion=slice(3, 7))
    assert look_of(model(("x", "y", "qw"))) == Look("dart", along=slice(0, 2))
    assert look_of(FunctionDynamics(lambda x, u: x + u, 2, 2, 0.1)) == Look()


@pytest.mark.parametrize("d", [2, 3])
def test_a_dart_points_along_its_way(d: int) -> None:
    """Its nose does, turned by SciPy; where the vehicle rests it points as before, at first as it will."""
    p = np.random.default_rng(d).normal(size=(8, d)).cumsum(axis=0)
    p[1], p[5], p[6] = p[0], p[4], p[4]
    q = Look("dart", along=slice(0, d)).attitude(p)
    assert q is not None
    nose = Rotation.from_quat(q[:, [1, 2, 3, 0]]).apply([1.0, 0, 0])
    steps = np.diff(np.pad(p, ((0, 0), (0, 3 - d))), axis=0)
    for k, step in enumerate((1, 1, 2, 3, 3, 3, 6, 6)):
        np.testing.assert_allclose(nose[k], steps[step] / np.linalg.norm(steps[step]), atol=1e-12)
    left = Rotation.from_quat(q[:, [1, 2, 3, 0]]).apply([0.0, 1, 0])
    np.testing.assert_allclose(left[:, 2], 0.0, atol=1e-12)
    still = Look("dart", along=slice(0, d)).attitude(np.zeros((3, d)))
    assert np.array_equal(still, [[1, 0, 0, 0]] * 3)


def test_the_page_draws_every_body() -> None:
    script = (Path(document.__file__).parent / "static" / "vehicle.js").read_text()
    (drawn,) = re.findall(r"const built = \{ (.*?) \}", script)
    assert set(drawn.split(", ")) == set(get_args(get_type_hints(Look)["body"]))
