"""Layouts: accepted and refused input, error messages, files, taking, padding and joining."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchgco.base.errors import InputError
from torchgco.scenarios import LayoutFile, Layouts, concatenate

DATA = Path(__file__).parents[2] / "benchmarks" / "data"
NAN = np.nan


def example(**changes) -> Layouts:
    """Two layouts in the plane, the second with one obstacle absent."""
    given = {
        "centers": np.array([[[0.0, 1.0], [2.0, 3.0]], [[4.0, 5.0], [NAN, NAN]]]),
        "radii": np.array([[0.1, 0.2], [0.3, NAN]]),
        "velocities": np.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 1.0], [9.0, 9.0]]]),
        "start": np.array([-1.0, 0.0, 0.5, 0.0, 0.0, 0.0]),
        "goal": np.array([[1.0, 0.4, 0.0, 0.0, 0.0, 0.0], [2.0, 0.4, 0.0, 0.0, 0.0, 0.0]]),
        "vehicle_radius": 0.06,
        "goal_radius": 0.3,
        "dt": 0.05,
        "stages": 200,
        "control_lower": [-10.0, -np.inf],
        "control_upper": [10.0, np.inf],
        "best_cost": [700.0, NAN],
        "name": "example",
    }
    return Layouts(**(given | changes))


def test_canonical_form():
    layouts = example()
    assert (layouts.count, layouts.dimension) == (2, 2)
    assert layouts.start is not None and layouts.start.shape == (2, 6)
    assert layouts.velocities is not None and np.isnan(layouts.velocities[1, 1]).all()
    assert layouts.ids.tolist() == [0, 1] and layouts.ids.dtype == np.int64
    assert isinstance(layouts.stages, int) and isinstance(layouts.dt, float)
    bare = Layouts(centers=np.zeros((1, 0, 3)), radii=np.zeros((1, 0)))  # free space
    assert bare.dimension == 3 and bare.start is None and bare.best_cost is None


def test_arrays_are_copies():
    centers = np.zeros((1, 1, 2))
    layouts = Layouts(centers=centers, radii=np.ones((1, 1)))
    centers[:] = 7.0
    assert (layouts.centers == 0.0).all()


ONE = np.zeros((2, 2, 2))  # centres without an absent one
ERRORS = {
    "centers rank": ({"centers": np.zeros((2, 2))}, "layouts.centers: expected shape (L, M, d)"),
    "dimension": ({"centers": np.zeros((2, 2, 4))}, "d = 2 or 3, got shape (2, 2, 4)"),
    "no layout": ({"centers": np.zeros((0, 2, 2))}, "L >= 1"),
    "text": ({"centers": np.array([["a"]])}, "layouts.centers: expected an array of real numbers"),
    "complex": ({"radii": np.ones((2, 2)) * 1j}, "layouts.radii: expected an array of real numbers"),
    "radii shape": ({"radii": np.ones((2, 3))}, "layouts.radii: expected shape (L, M) = (2, 2)"),
    "negative radius": (
        {"radii": [[0.1, -0.2], [0.3, NAN]]},
        "layouts.radii: expected finite radii >= 0, got -0.2",
    ),
    "infinite radius": ({"radii": [[0.1, np.inf], [0.3, NAN]]}, "layouts.radii: expected finite radii >= 0"),
    "infinite centre": ({"centers": ONE + np.inf}, "layouts.centers: expected finite rows or rows of NaN"),
    "half a centre": (
        {"centers": [[[0.0, NAN], [2.0, 3.0]], [[4.0, 5.0], [NAN, NAN]]]},
        "layouts.centers: expected finite rows or rows of NaN, got [0.0, nan] at [0, 0]",
    ),
    "radius of nothing": ({"radii": np.ones((2, 2))}, "layouts.radii: expected NaN where the centre is NaN"),
    "no radius": (
        {"centers": ONE},
        "layouts.radii: expected a radius where the centre is finite, got nan at [1, 1]",
    ),
    "velocity shape": ({"velocities": np.zeros((2, 2))}, "layouts.velocities: expected the shape (2, 2, 2)"),
    "velocity": ({"velocities": ONE * NAN}, "layouts.velocities: expected finite velocities"),
    "start shape": ({"start": np.zeros((3, 6))}, "layouts.start: expected shape (n,) or (2, n) with n >= 2"),
    "start too short": ({"start": [1.0]}, "layouts.start: expected shape (n,)"),
    "start": ({"start": [0.0, 0.0, NAN, 0.0, 0.0, 0.0]}, "layouts.start: expected finite states"),
    "goal": ({"goal": np.full((2, 6), np.inf)}, "layouts.goal: expected finite states"),
    "goal length": ({"goal": np.zeros(14)}, "layouts.goal: expected n = 6 as start has, got 14"),
    "vehicle radius": (
        {"vehicle_radius": -0.1},
        "layouts.vehicle_radius: expected a number between 0 and 1e+06 m, got -0.1",
    ),
    "goal radius": ({"goal_radius": 0.0}, "layouts.goal_radius: expected a number above 0 m and at most 1e+06 m"),
    "dt": ({"dt": 0}, "layouts.dt: expected a number above 0 s and at most 1e+06 s, got 0"),
    "dt array": ({"dt": np.ones(2)}, "layouts.dt: expected a number above 0 s and at most 1e+06 s"),
    "infinite dt": ({"dt": np.inf}, "layouts.dt: expected a number above 0 s and at most 1e+06 s, got inf"),
    "stages": ({"stages": 0}, "layouts.stages: expected a whole number between 1 and 1e+09, got 0"),
    "half a stage": ({"stages": 2.5}, "layouts.stages: expected a whole number between 1 and 1e+09, got 2.5"),
    "bound": ({"control_lower": [NAN, 0.0]}, "layouts.control_lower: expected shape (m,) without NaN"),
    "bound rank": ({"control_upper": 10.0}, "layouts.control_upper: expected shape (m,) without NaN"),
    "bound length": (
        {"control_upper": [1.0]},
        "layouts.control_upper: expected the shape (2,) of control_lower",
    ),
    "crossed": ({"control_upper": [-11.0, 1.0]}, "layouts.control_lower: expected at most control_upper"),
    "cost shape": ({"best_cost": [1.0]}, "layouts.best_cost: expected shape (2,), got shape (1,)"),
    "cost": ({"best_cost": [1.0, np.inf]}, "layouts.best_cost: expected finite costs"),
    "ids shape": ({"ids": [1]}, "layouts.ids: expected integers >= 0 of shape (2,)"),
    "ids": ({"ids": [1, -1]}, "layouts.ids: expected integers >= 0"),
    "fractional ids": ({"ids": [0.0, 1.0]}, "layouts.ids: expected integers >= 0"),
}


@pytest.mark.parametrize(("changes", "message"), ERRORS.values(), ids=ERRORS.keys())
def test_refuses(changes, message):
    with pytest.raises(InputError) as caught:
        example(**changes)
    assert message in str(caught.value)


def test_equality():
    layouts = example()
    assert layouts == example()
    assert layouts != example(name="other")
    assert layouts != example(best_cost=None)
    assert layouts != example(ids=[3, 4])
    radii = layouts.radii.copy()
    radii[0, 0] += 1e-12
    assert layouts != example(radii=radii)


@pytest.mark.parametrize("ids", [[0, 1], [5, 2]])
def test_round_trip(tmp_path, ids):
    layouts = example(ids=ids)
    layouts.save(tmp_path / "example.npz")
    with np.load(tmp_path / "example.npz", allow_pickle=False) as held:
        assert ("layout" in held.files) == (ids != [0, 1])
        assert "name" not in held.files
    assert Layouts.load(tmp_path / "example.npz") == layouts
    assert [path.name for path in tmp_path.iterdir()] == ["example.npz"]


def test_round_trip_of_the_least(tmp_path):
    layouts = Layouts(centers=np.zeros((1, 1, 2)), radii=np.ones((1, 1)), name="least")
    layouts.save(tmp_path / "least.npz")
    with np.load(tmp_path / "least.npz") as held:
        assert sorted(held.files) == ["centers", "radii"]
    assert Layouts.load(tmp_path / "least.npz") == layouts


def test_interrupted_save_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "example.npz"
    example().save(path)

    def fail(*_, **__):
        raise OSError("disk full")

    for module, call in ((np, "savez_compressed"), (os, "fsync"), (os, "replace")):
        with monkeypatch.context() as patch, pytest.raises(OSError, match="disk full"):
            patch.setattr(module, call, fail)
            example(dt=0.1).save(path)
    assert Layouts.load(path) == example()
    assert [file.name for file in tmp_path.iterdir()] == ["example.npz"]


def test_load_refuses(tmp_path):
    def message(path) -> str:
        with pytest.raises(InputError) as caught:
            Layouts.load(path)
        return str(caught.value)

    missing = tmp_path / "missing.npz"
    assert message(missing) == f"scenario.path: expected a layout file (.npz), got {missing}, which isn't there"
    path = tmp_path / "file.npz"
    np.savez(path, centers=np.zeros((1, 1, 2)))
    assert message(path) == f"layouts.radii: expected this array in {path}, got only ['centers']"
    np.savez(path, centers=np.zeros((1, 1, 2)), radii=np.ones((1, 1)), radius=1.0)
    assert message(path).startswith("layouts.radius: expected only centers, radii, velocities,")
    np.savez(path, centers=np.zeros((1, 1, 2)), radii=np.ones((1, 1)), dt=-1.0)
    assert message(path).startswith("layouts.dt: expected a number above 0 s and at most 1e+06 s")
    np.savez(path, centers=np.array([None]), radii=np.ones((1, 1)))
    assert message(path).startswith("scenario.path: expected a readable npz file without pickles")
    path.write_bytes(b"not a zip")
    assert message(path).startswith("scenario.path: expected a readable npz file without pickles")
    path.write_bytes(b"")
    assert message(path).startswith("scenario.path: expected a readable npz file")
    np.save(tmp_path / "array.npy", np.zeros(3))
    assert message(tmp_path / "array.npy").startswith("scenario.path: expected a readable npz file")
    assert message(tmp_path).startswith("scenario.path: expected a readable npz file")


def test_take():
    taken = example(ids=[7, 8]).take([1, 0, 1])
    assert taken.ids.tolist() == [8, 7, 8]
    assert taken.radii[:, 0].tolist() == [0.3, 0.1, 0.3]
    assert taken.goal is not None and taken.goal[:, 0].tolist() == [2.0, 1.0, 2.0]
    assert taken.best_cost is not None and taken.best_cost[1] == 700.0
    for wrong, message in (
        ([2], "positions in 0..1, got 2"),
        ([-1], "at least one integer >= 0"),
        ([], "at least"),
    ):
        with pytest.raises(InputError, match=r"layouts\.take") as caught:
            example().take(wrong)
        assert message in str(caught.value)


def test_concatenate_pads_and_fills():
    still = Layouts(
        **{
            **example().arrays(),
            "centers": np.ones((1, 3, 2)),
            "radii": np.ones((1, 3)),
            "velocities": None,
            "start": np.zeros(6),
            "goal": np.ones(6),
            "best_cost": None,
            "name": "still",
        }
    )
    both = concatenate([example(), still])
    assert (both.count, both.radii.shape, both.name) == (3, (3, 3), "example+still")
    assert both.ids.tolist() == [0, 1, 0]
    assert np.isnan(both.radii[:2, 2]).all()
    assert both.velocities is not None and (both.velocities[2] == 0.0).all() and both.velocities[0, 0, 0] == 1.0
    assert both.best_cost is not None and both.best_cost[0] == 700.0 and np.isnan(both.best_cost[1:]).all()
    assert both.take([0, 1]).radii[:, :2].tolist() == pytest.approx(example().radii, nan_ok=True)
    assert concatenate([example().take([0]), example().take([1])]) == example()


def test_concatenate_refuses():
    first = example()
    for other, field in (
        (replace(first, dt=0.1), "layouts.dt: expected the same in all parts, got 0.05 and 0.1"),
        (replace(first, stages=None), "layouts.stages"),
        (replace(first, control_upper=np.array([10.0, 3.0])), "layouts.control_upper"),
        (replace(first, start=None), "layouts.start"),
        (Layouts(centers=np.zeros((1, 1, 3)), radii=np.ones((1, 1))), "layouts.dimension"),
    ):
        with pytest.raises(InputError) as caught:
            concatenate([first, other])
        assert field in str(caught.value)
    with pytest.raises(InputError, match="at least one part"):
        concatenate([])


@pytest.mark.parametrize("family", ["planar_trap", "planar_random", "forest30", "forest60", "walls"])
def test_public_file(family, tmp_path):
    layouts = Layouts.load(DATA / f"{family}.npz")
    assert (layouts.name, layouts.count) == (family, 32)
    with np.load(DATA / f"{family}.npz") as held:
        assert layouts.arrays().keys() == set(held.files)
        assert np.array_equal(layouts.centers, held["centers"], equal_nan=True)
    layouts.save(tmp_path / f"{family}.npz")
    assert Layouts.load(tmp_path / f"{family}.npz") == layouts


def test_file_scenario(tmp_path):
    file = LayoutFile(str(DATA / "walls.npz"))
    assert (file.name, file.dimension, file.available) == ("walls", 3, 32)
    drawn = file.draw([31, 0], seed=5)
    assert drawn == file.draw([31, 0], seed=6) and drawn.ids.tolist() == [31, 0]
    assert np.array_equal(drawn.centers[0], Layouts.load(DATA / "walls.npz").centers[31], equal_nan=True)
    with pytest.raises(InputError) as caught:
        file.draw(range(33), seed=0)
    assert str(caught.value).startswith("study.layouts: expected at most the 32 layouts in ")
    with pytest.raises(InputError, match=r"scenario\.path"):
        LayoutFile(tmp_path / "missing.npz")
    with pytest.raises(InputError, match=r"scenario\.path: expected the path of a layout file, got None"):
        LayoutFile(None)  # type: ignore[arg-type]


def test_file_scenario_numbers_rows_not_stored_ids(tmp_path):
    example(ids=[40, 41]).save(tmp_path / "flown.npz")
    assert LayoutFile(tmp_path / "flown.npz").draw([1]).ids.tolist() == [1]
