"""scenario=map: flights on the map in a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from PIL import Image

from tests.maps.files import samples
from tests.plotting.straight import layout_grid
from torchgco import Hold, InputError, judge
from torchgco.experiments.config.build import compose
from torchgco.experiments.results.identity import layout_digests
from torchgco.maps import DistanceField, OccupancyGrid, PointCloud
from torchgco.plotting.layouts import ROCK
from torchgco.scenarios import Layouts, MapFile, concatenate

# Two rooms of 4 m x 4 m with a door, and a closed one of 1 m x 4 m; cells of 0.25 m.
ROOMS = np.zeros((38, 18), bool)
ROOMS[[0, -1]] = ROOMS[:, [0, -1]] = ROOMS[[16, 33]] = True
ROOMS[16, 7:11] = False


def rooms(folder: Path, **more: Any) -> Path:
    raw = samples.npz(occupied=ROOMS, origin=[-1.0, 2.0], resolution=0.25, **more)
    return samples.write(folder, "rooms.npz", raw)


def test_the_file_may_say_start_goal_and_sizes(tmp_path: Path) -> None:
    path = rooms(tmp_path, start=[0.0, 3.0], goal=[6.0, 5.0], vehicle_radius=0.1, goal_radius=0.2)
    scenario = MapFile(path)
    assert scenario.available == 1 and scenario.dimension == 2 and scenario.name == "rooms"
    layouts = scenario.draw([0], 0)
    assert layouts.start.tolist() == [[0, 3]] and layouts.goal.tolist() == [[6, 5]]
    assert (layouts.vehicle_radius, layouts.goal_radius, layouts.map) == (0.1, 0.2, scenario.map)
    changed = MapFile(path, goal=[5.0, 5.0], vehicle_radius=0.3).draw([0], 0)
    assert changed.goal.tolist() == [[5, 5]] and changed.vehicle_radius == 0.3 and changed.goal_radius == 0.2


def test_drawn_ends_are_free_connected_and_apart(tmp_path: Path) -> None:
    """In the two rooms: the closed third one is smaller."""
    layouts = MapFile(rooms(tmp_path)).draw(range(50), 3)
    for end in (layouts.start, layouts.goal):
        assert (layouts.map.distance(end) > 0.25).all()
        assert (end > [-1, 2]).all() and (end < [-1 + 33 * 0.25, 6.5]).all()
    assert np.linalg.norm(layouts.start - layouts.goal, axis=1).min() > 0.4 * np.linalg.norm(
        np.ptp(layouts.start, axis=0)
    )
    assert len(np.unique(layouts.start, axis=0)) > 30
    again = MapFile(rooms(tmp_path)).draw([7, 3], 3)
    np.testing.assert_array_equal(again.goal, layouts.goal[[7, 3]])
    assert (MapFile(rooms(tmp_path)).draw([0], 4).start != layouts.start[0]).any()


@pytest.mark.parametrize("corners", ["[[-0.35,-0.25],[0.35,0.25]]", "[[-0.2,-0.25],[0.9,0.25]]"])
@pytest.mark.parametrize("scenario", ["map", "floors"])
def test_drawn_ends_are_free_for_the_body_of_the_vehicle(scenario: str, corners: str, tmp_path: Path) -> None:
    """They were for the scenario's ball alone: every third of these began or ended in a wall."""
    words = [f"scenario={scenario}", *([f"scenario.path={rooms(tmp_path)}"] if scenario == "map" else [])]
    setup = compose([*words, "model=unicycle", f"+model.vehicle.footprint={corners}", "+model.vehicle.cells=[3,2]"])
    layouts = setup.layouts(16)
    for group in layouts.alike():
        problem = setup.task(layouts.take(group)).problem
        assert bool(problem.start_is_clear.all())
        ends = problem.cost.x_ref[:, -1]
        assert all(bool(obstacles.start_is_clear(ends).all()) for obstacles in problem.obstacles)
    drawn = setup.vehicle.among(compose([*words, "model=unicycle"]).scenario, range(4))
    assert np.array_equal(drawn.layouts.start, layouts.take(range(4)).start)


def test_a_body_without_a_place_is_told(tmp_path: Path) -> None:
    words = ["scenario=map", f"scenario.path={rooms(tmp_path)}", "model=unicycle", "+model.vehicle.cells=[8,2]"]
    long = compose([*words, "+model.vehicle.footprint=[[-3.5,-0.25],[3.5,0.25]]"])
    with pytest.raises(InputError, match="free for the vehicle's body, turned as its start is") as error:
        long.layouts(1)
    assert error.value.field == "scenario.path"


def test_one_end_is_given(tmp_path: Path) -> None:
    """The other is drawn from the space around it, here the closed room."""
    layouts = MapFile(rooms(tmp_path), goal=[7.875, 4.0], vehicle_radius=0.1).draw(range(20), 0)
    assert (layouts.goal == [7.875, 4.0]).all() and (layouts.start[:, 0] > -1 + 34 * 0.25).all()
    layouts = MapFile(rooms(tmp_path), start=[0.0, 3.0]).draw(range(20), 0)
    assert (layouts.start == [0, 3]).all() and (layouts.goal[:, 0] < -1 + 33 * 0.25).all()


def test_what_lies_around_the_cells_is_free_or_occupied(tmp_path: Path) -> None:
    path = samples.write(
        tmp_path, "open.npz", samples.npz(occupied=np.zeros((6, 8), bool), origin=[0.0, 1.0], resolution=0.5)
    )
    beyond, inside = [[-0.25, 3.0], [3.2, 5.2]], [0.5, 3.0]
    assert (MapFile(path).map.distance(beyond) > 1e3).all()
    closed = MapFile(path, outside="occupied").map
    assert (closed.distance(beyond) < 0).all() and closed.distance(inside, smooth=False) == pytest.approx(0.5)
    cloud = tmp_path / "cloud.npy"
    np.save(cloud, np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"scenario.outside: expected free"):
        MapFile(cloud, radius=0.1, outside="occupied")


@pytest.mark.parametrize("place", [[-0.1, 1.0], [4.2, 1.0], [1.0, -3.0], [2.0, 30.0]])
def test_a_place_outside_of_a_map_servers_map_is_refused_unless_it_is_free_there(
    place: list[float], tmp_path: Path
) -> None:
    Image.fromarray(np.full((40, 80), 255, np.uint8)).save(tmp_path / "hall.pgm")
    path = samples.write(tmp_path, "hall.yaml", samples.yaml(image="hall.pgm", resolution=0.05, origin=[0, 0, 0]))
    within = MapFile(path, start=[0.4, 0.4], goal=[3.6, 1.6])
    assert within.outside == "occupied" and within.draw([0], 0).goal.tolist() == [[3.6, 1.6]]
    for name in ("start", "goal"):
        with pytest.raises(InputError, match=r"a place on the map, .* unless scenario.outside=free") as error:
            MapFile(path, **{"start": [0.4, 0.4], "goal": [3.6, 1.6]} | {name: place})
        assert error.value.field == f"scenario.{name}"
    assert MapFile(path, outside="free", start=[0.4, 0.4], goal=place).draw([0], 0).goal.tolist() == [place]


def test_unknown_cells_count_as_asked(tmp_path: Path) -> None:
    cells = np.where(np.arange(100).reshape(10, 10) < 50, 0.0, np.nan)
    path = samples.write(tmp_path, "half.npz", samples.npz(occupied=cells, origin=[0.0, 0.0]))
    assert MapFile(path).draw(range(20), 0).start[:, 0].max() < 2.5
    assert MapFile(path, unknown="free").draw(range(20), 0).start[:, 0].max() > 2.5


@pytest.mark.parametrize(("options", "field", "said"), [
    ({"start": [0.0]}, "start", "2 coordinates"),
    ({"goal": [0.0, np.inf]}, "goal", "2 coordinates"),
    ({"start": [-0.9, 2.1]}, "start", "a place on the map that is free"),
    ({"goal": [99.0, 2.1]}, "goal", "a place on the map that is free"),
    ({"vehicle_radius": 5.0}, "vehicle_radius", "free for a vehicle of radius 5 m"),
    ({"vehicle_radius": -1.0}, "vehicle_radius", "0"),
    ({"stages": 0}, "stages", "1"),
    ({"unknown": "maybe"}, "unknown", "occupied"),
    ({"outside": "maybe"}, "outside", "occupied"),
    ({"resolution": 0.1}, "resolution", "no use for it"),
    ({"path": "gone.npz"}, "path", "No such file"),
])  # fmt: skip
def test_wrong_fields(options: dict[str, Any], field: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said) as error:
        MapFile(**{"path": rooms(tmp_path)} | options).draw([0], 0)
    assert error.value.field == f"scenario.{field}"


@pytest.mark.parametrize("name", ["rooms.npz", "points.xyz", "tree.ot", "plan.png"])
def test_layouts_keep_their_map_in_a_file(name: str, tmp_path: Path) -> None:
    raw, options = samples.SAMPLES.get(name, (None, {}))
    path = rooms(tmp_path) if raw is None else samples.write(tmp_path, name)
    d = 2 if name in ("rooms.npz", "plan.png") else 3
    layouts = MapFile(path, start=[0.0] * d, goal=[1.0] * d, **options).draw([0], 0)
    layouts.save(tmp_path / "layouts.npz")
    loaded = Layouts.load(tmp_path / "layouts.npz")
    assert loaded.arrays().keys() == layouts.arrays().keys() and loaded.map is not None
    np.testing.assert_array_equal(loaded.map.values, layouts.map.values)
    assert type(loaded.map.source) is (PointCloud if name == "points.xyz" else OccupancyGrid)
    taken = layouts.take([0])
    assert taken.map is layouts.map and concatenate([taken, layouts]).map is layouts.map


def test_maps_are_of_the_layouts_space_and_shared(tmp_path: Path) -> None:
    layouts = MapFile(rooms(tmp_path)).draw([0, 1], 0)
    raw = samples.npz(occupied=ROOMS[:, :9], origin=[-1.0, 2.0], resolution=0.25)
    small = samples.write(tmp_path, "small.npz", raw)
    other = MapFile(small).draw([2], 0)
    with pytest.raises(InputError, match=r"layouts\.map: expected the same in all parts, or grids of the same size"):
        concatenate([layouts, other])
    with pytest.raises(InputError, match=r"layouts\.map: expected the same in all parts, got none in some"):
        concatenate([replace(layouts, map=None), layouts])
    with pytest.raises(InputError, match=r"layouts\.map: expected one map for all, 3-D"):
        Layouts(np.empty((1, 0, 3)), np.empty((1, 0)), map=layouts.map)
    arrays = layouts.arrays()
    del arrays["map_origin"]
    np.savez(tmp_path / "cut.npz", **arrays)
    with pytest.raises(InputError, match=r"layouts\.map_origin: expected this array beside map_occupied"):
        Layouts.load(tmp_path / "cut.npz")


@pytest.mark.slow
def test_a_study_flies_on_the_map(tmp_path: Path) -> None:
    """The command's words make problems with the map as a constraint, which the judge measures."""
    words = ["model=unicycle", "scenario=map", f"scenario.path={rooms(tmp_path)}", "scenario.start=[0,3]"]
    setup = compose([*words, "scenario.goal=[6,3]", "solver=hold"])
    assert setup.layouts().count == 1 and compose(words).layouts().count == 64
    task = setup.task()
    solution = Hold().solve(task.problem, task.U0)
    verdict = judge(task.problem, solution.U, task.goal, task.goal_radius)
    # 0.75 m from two walls; contact is at the vehicle's radius, less what counts as feasible.
    assert float(verdict.clearance[0]) == pytest.approx(0.75 - 0.249, abs=1e-6) and not verdict.reached[0]


@pytest.mark.parametrize(("words", "said"), [
    (["scenario=map"], "scenario.path: expected the map: add scenario.path=FILE, got none"),
    (["scenario=map", "model=quadrotor", "scenario.path=PATH"], "model: expected model=planar or model=unicycle"),
])  # fmt: skip
def test_commands_that_lack_a_word(words: list[str], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        compose([word.replace("PATH", str(rooms(tmp_path))) for word in words])


def test_the_map_counts_in_the_digest(tmp_path: Path) -> None:
    ends: dict[str, Any] = {"start": [0.0, 3.0], "goal": [6.0, 5.0]}
    vehicle = {"dynamics": {"dt": 0.1}}
    digests = [layout_digests(MapFile(rooms(tmp_path), **ends).draw([0], 0), vehicle)[0] for _ in range(2)]
    changed = ROOMS.copy()
    changed[5, 5] = True
    raw = samples.npz(occupied=changed, origin=[-1.0, 2.0], resolution=0.25)
    other = MapFile(samples.write(tmp_path, "rooms.npz", raw), **ends).draw([0], 0)
    assert digests[0] == digests[1] != layout_digests(other, vehicle)[0]


@pytest.mark.parametrize("d", [2, 3])
def test_pictures_show_the_map(d: int, tmp_path: Path) -> None:
    cells = ROOMS if d == 2 else np.repeat(ROOMS[..., None], 8, axis=2)
    field = DistanceField.of(OccupancyGrid(cells, [-1.0, 2.0, 0.0][:d], 0.25))
    ends = np.array([[0.0, 3.0, 1.0], [6.0, 3.0, 1.0]])[:, :d]
    none = np.empty((1, 0, d))
    layouts = Layouts(none, none[..., 0], start=ends[:1], goal=ends[1:], vehicle_radius=0.2, map=field)
    row = {"scenario": "map", "model": "m", "layout": 0, "solver": "gco", "feasible": True, "reached": True}
    path = torch.linspace(0, 1, 20)[:, None].numpy() * (ends[1] - ends[0]) + ends[0]
    figure = layout_grid(layouts.arrays(), {"gco": path[None]}, pd.DataFrame([row]))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())
    for place, colour in (([3.125, 2.75], ROCK), ([3.0, 5.5], "#FFFFFF")):  # in the wall, and in a room
        x, y = figure.axes[0].transData.transform(place)
        assert to_hex(image[len(image) - int(y) - 1, int(x)] / 255).upper() == colour
    assert any(text.get_text().startswith("obstacle") for text in figure.legends[0].get_texts())
