"""Boxes in layout files: reading, checking, joining, plotting, and the problems made from them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from tests.plotting.straight import layout_grid
from tests.reference import boxes as slow
from torchgco import InputError, Planar
from torchgco.obstacles.boxes import BoundBoxes
from torchgco.plotting.bodies import Box, bodies
from torchgco.scenarios.layouts import BOXES, Layouts, concatenate
from torchgco.scenarios.vehicle import Vehicle

NAN = np.nan
CAR = Vehicle(
    "planar", Planar(dt=0.1), [5, 5, 0, 1, 1, 0], [0.1, 0.1], [50, 50, 0, 1, 1, 0], [0, 0], [-10, -10], [10, 10],
    [-1, 0, 0, 0, 0, 0], [1, 0.4, 0, 0, 0, 0], radius=0.06, goal_radius=0.3, stages=20,
)  # fmt: skip


def example(**changes) -> Layouts:
    """Two layouts in the plane without discs, the second with a single box."""
    given = {
        "centers": np.zeros((2, 0, 2)),
        "radii": np.zeros((2, 0)),
        "box_centers": np.array([[[0.0, 0.0], [0.5, 0.5]], [[0.1, 0.0], [NAN, NAN]]]),
        "box_half_sizes": np.array([[[0.1, 0.2], [0.3, 0.1]], [[0.1, 0.1], [NAN, NAN]]]),
        "box_rotations": np.array([[0.3, -0.2], [0.0, 7.0]]),
    }
    return Layouts(**(given | changes))


def with_capsule(**changes) -> Layouts:
    """As `example`, with a capsule and a rounded box in the first layout."""
    given = {
        "box_half_sizes": np.array([[[0.2, 0.0], [0.3, 0.1]], [[0.1, 0.1], [NAN, NAN]]]),
        "box_radii": np.array([[0.1, 0.05], [0.0, 7.0]]),
    }
    return example(**(given | changes))


def in_space(**changes) -> Layouts:
    half = np.sqrt(0.5)
    given = {
        "centers": np.zeros((1, 0, 3)),
        "radii": np.zeros((1, 0)),
        "box_centers": np.array([[[0.0, 0.0, 1.0]]]),
        "box_half_sizes": np.array([[[0.1, 0.2, 0.3]]]),
        "box_rotations": np.array([[[half, half, 0.0, 0.0]]]),
    }
    return Layouts(**(given | changes))


def test_a_round_trip_keeps_the_boxes(tmp_path: Path) -> None:
    parts = example(name="boxes"), in_space(name="boxes"), example(name="boxes", box_rotations=None)
    for layouts in (*parts, with_capsule(name="boxes")):
        layouts.save(tmp_path / "boxes.npz")
        assert Layouts.load(tmp_path / "boxes.npz") == layouts
    assert np.isnan(with_capsule().box_radii[1, 1]) and example() != with_capsule()
    assert np.isnan(example().box_rotations[1, 1])
    assert example().take([1]).box_centers.shape == (1, 2, 2)


def test_a_file_may_hold_boxes_alone(tmp_path: Path) -> None:
    for layouts in (example(name="boxes"), in_space(name="boxes")):
        held = {name: value for name, value in layouts.arrays().items() if name not in ("centers", "radii")}
        np.savez(tmp_path / "boxes.npz", **held)
        assert Layouts.load(tmp_path / "boxes.npz") == layouts
    np.savez(tmp_path / "boxes.npz", **held, centers=np.zeros((1, 1, 3)))
    with pytest.raises(InputError, match=r"^layouts\.radii: expected this array"):
        Layouts.load(tmp_path / "boxes.npz")
    np.savez(tmp_path / "flat.npz", **held | {"box_centers": np.zeros(3)})
    with pytest.raises(InputError, match=r"^layouts\.centers: expected this array"):
        Layouts.load(tmp_path / "flat.npz")


def test_parts_with_and_without_boxes_are_joined() -> None:
    discs = Layouts(np.ones((1, 2, 2)), np.ones((1, 2)))
    plain = example(box_centers=np.zeros((2, 1, 2)), box_half_sizes=np.ones((2, 1, 2)), box_rotations=None)
    joined = concatenate([discs, example(), plain])
    assert joined.box_centers.shape == (5, 2, 2) and np.isnan(joined.box_centers[0]).all()
    assert joined.box_rotations[1].tolist() == [0.3, -0.2] and joined.box_rotations[3, 0] == 0.0
    assert concatenate([discs, discs]).box_centers is None
    assert concatenate([plain, plain]).box_rotations is None and joined.box_radii is None
    mixed = concatenate([discs, plain, with_capsule(box_rotations=None)])
    assert mixed.box_rotations is None and mixed.box_radii[1:4].tolist()[0][0] == 0.0
    assert mixed.box_radii[3].tolist() == [0.1, 0.05] and np.isnan(mixed.box_radii[:3, 1]).all()
    assert concatenate([in_space(), in_space(box_rotations=None)]).box_rotations[1, 0].tolist() == [1, 0, 0, 0]


def test_a_task_has_boxes_as_obstacles() -> None:
    task = CAR.task(example())
    (boxes,) = (c for c in task.problem.constraints if isinstance(c, BoundBoxes))
    assert boxes.absent.tolist() == [[False, False], [False, True]] and boxes.vehicle_radius.tolist() == [0.06] * 2
    assert task.problem.start_is_clear.tolist() == [True, True]
    p = torch.tensor([[[0.2, 0.1]]] * 2, dtype=torch.float64)
    found = boxes.signed_distance(p, torch.zeros(1, dtype=torch.float64))
    expected = slow.distance(np.array([0.2, 0.1]), np.array([0.5, 0.5]), np.array([0.3, 0.1]), -0.2) - 0.06
    assert float(found[0, 0, 1]) == pytest.approx(expected)
    assert task.problem.goal is not None and task.problem.goal.radius.tolist() == [0.3, 0.3]


def test_a_task_has_rounded_boxes_as_obstacles() -> None:
    (boxes,) = (c for c in CAR.task(with_capsule()).problem.constraints if isinstance(c, BoundBoxes))
    p = torch.tensor([[[0.2, 0.1]]] * 2, dtype=torch.float64)
    found = boxes.signed_distance(p, torch.zeros(1, dtype=torch.float64))
    centers, half, turns, radii = (part[0, 0] for part in (getattr(with_capsule(), name) for name in BOXES))
    assert float(found[0, 0, 0]) == pytest.approx(slow.distance(p[0, 0].numpy(), centers, half, turns, radii) - 0.06)


ERRORS = {
    "no sides": (dict(box_half_sizes=None), "layouts.box_half_sizes: expected this array with box_centers, got none"),
    "no centres": (dict(box_centers=None), "layouts.box_half_sizes: expected none without box_centers, got some"),
    "layouts": (
        dict(box_centers=np.zeros((3, 2, 2))),
        "layouts.box_centers: expected shape (2, K, 2), got",
    ),
    "space": (dict(box_centers=np.zeros((2, 2, 3))), "layouts.box_centers: expected shape (2, K, 2)"),
    "half there": (dict(box_centers=np.array([[[0.0, NAN]] * 2] * 2)), "layouts.box_centers: expected finite rows or"),
    "sides": (dict(box_half_sizes=np.ones((2, 1, 2))), "layouts.box_half_sizes: expected the shape (2, 2, 2)"),
    "flat": (dict(box_half_sizes=np.zeros((2, 2, 2))), "layouts.box_half_sizes: expected finite half sides above 0"),
    "too many": (
        dict(box_half_sizes=np.ones((2, 2, 2))),
        "layouts.box_half_sizes: expected NaN where",
    ),
    "flat and sharp": (
        dict(box_half_sizes=with_capsule().box_half_sizes, box_radii=np.zeros((2, 2))),
        "layouts.box_half_sizes: expected finite half sides above 0 where the centre is finite; 0 too where",
    ),
    "number of radii": (dict(box_radii=np.zeros((2, 1))), "layouts.box_radii: expected shape (2, 2), got (2, 1)"),
    "negative radius": (dict(box_radii=np.full((2, 2), -0.1)), "layouts.box_radii: expected finite radii >= 0"),
    "missing radius": (dict(box_radii=np.full((2, 2), NAN)), "layouts.box_radii: expected finite radii >= 0"),
    "turns": (dict(box_rotations=np.zeros((2, 2, 4))), "layouts.box_rotations: expected shape (2, 2): angles"),
    "no angle": (dict(box_rotations=np.full((2, 2), NAN)), "layouts.box_rotations: expected finite angles"),
    "text": (dict(box_centers="here"), "layouts.box_centers: expected an array of real numbers"),
}


@pytest.mark.parametrize(("changes", "message"), ERRORS.values(), ids=ERRORS.keys())
def test_malformed_boxes_are_named(changes: dict, message: str) -> None:
    with pytest.raises(InputError) as caught:
        example(**changes)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_radii_need_boxes() -> None:
    with pytest.raises(InputError, match=r"layouts.box_radii: expected none without box_centers, got some"):
        Layouts(np.zeros((1, 0, 2)), np.zeros((1, 0)), box_radii=np.zeros((1, 1)))


def test_a_quaternion_of_another_length_is_named() -> None:
    with pytest.raises(InputError, match=r"layouts.box_rotations: expected unit quaternions \[w, x, y, z\]"):
        in_space(box_rotations=np.ones((1, 1, 4)))


def test_an_outline_from_above() -> None:
    (box,) = bodies(in_space().arrays(), 0)  # rotated by 90 degrees about x: 0.6 m wide along y
    assert isinstance(box, Box) and box.center[2] == 1.0
    assert sorted(map(tuple, box.outline().round(12))) == [(-0.1, -0.3), (-0.1, 0.3), (0.1, -0.3), (0.1, 0.3)]
    ring = box.outline(0.5)
    assert ring[0].tolist() == pytest.approx([0.6, ring[0, 1]]) and np.abs(ring).max(axis=0).tolist() == [0.6, 0.8]
    first, second = boxes_of(example())
    inner = [slow.distance(c, np.zeros(2), np.array([0.1, 0.2]), 0.3) for c in 0.999 * first.outline()]
    assert max(inner) < 0 and len(second.outline()) == 4 and len(boxes_of(example(), 1)) == 1
    assert bodies({"radii": np.zeros((1, 0))}, 0) == ()


def boxes_of(layouts: Layouts, i: int = 0) -> list[Box]:
    return [body for body in bodies(layouts.arrays(), i) if isinstance(body, Box)]


def test_outlines_of_rounded_boxes_and_of_a_trunk() -> None:
    first, second = boxes_of(with_capsule())
    for box, half, turn, radius in ((first, [0.2, 0.0], 0.3, 0.1), (second, [0.3, 0.1], -0.2, 0.05)):
        center = np.zeros(2) if box is first else np.array([0.5, 0.5])
        for by in (0.0, 0.07):
            ring = box.outline(by)
            away = [slow.distance(p, center, np.array(half), turn, radius) for p in ring]
            assert away == pytest.approx([by] * len(ring), abs=1e-12)
    (disc,) = boxes_of(trunk())
    round_it = np.linalg.norm(disc.outline(), axis=1)
    assert round_it == pytest.approx(np.full(len(round_it), 0.3)) and disc.center[2] == 1.0


def trunk() -> Layouts:
    return in_space(box_half_sizes=np.array([[[0.0, 0.0, 2.0]]]), box_radii=np.array([[0.3]]), box_rotations=None)


@pytest.mark.parametrize("layouts", [example(), in_space(), with_capsule()], ids=["plane", "space", "rounded"])
def test_maps_show_boxes(layouts: Layouts) -> None:
    d, count = layouts.dimension, layouts.count
    ends = pd.DataFrame({"layout": range(count), "solver": "gco", "feasible": True, "reached": True})
    paths = np.zeros((count, 3, 2 * d))
    paths[..., 2:d] = layouts.box_centers[0, 0, 2:] if d == 3 else 0.0
    paths[..., 0] = [-0.5, 0.0, 0.5]
    figure = layout_grid(layouts.arrays(), {"gco": paths}, ends.assign(scenario="yard", model="unicycle"))
    top = figure.axes[0]
    shapes = [path.vertices for held in top.collections for path in held.get_paths()]
    present = len(bodies(layouts.arrays(), 0))
    assert len(shapes) == present * (2 if layouts.vehicle_radius else 1)
