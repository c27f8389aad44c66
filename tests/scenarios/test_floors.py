"""scenario=floors: plans follow their rules, and have a way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt, label

from torchgco import InputError, judge
from torchgco.experiments.config.build import compose
from torchgco.experiments.results.identity import layout_digests
from torchgco.maps import OccupancyGrid
from torchgco.scenarios import Floors, Layouts, concatenate
from torchgco.scenarios.floors import RIM, Canvas

SMALL: dict[str, Any] = {"size": (9.0, 7.0), "apart": 4.0}


def cells_of(layouts: Layouts) -> np.ndarray:
    assert layouts.map is not None and isinstance(layouts.map.source, OccupancyGrid)
    return layouts.map.source.occupied


def test_a_layout_depends_on_seed_and_number_alone() -> None:
    floors = Floors(**SMALL)
    many, alone = floors.draw(range(5), seed=3), floors.draw([4], seed=3)
    assert many.take([4]) == alone and many.ids.tolist() == [0, 1, 2, 3, 4] and many.name == "floors"
    assert floors.draw([2, 0], seed=3) == many.take([2, 0])
    assert many.take([3]) != alone and floors.draw([4], seed=2) != alone
    assert layout_digests(many, {"dynamics": {}})[4] == layout_digests(alone, {"dynamics": {}})[4]
    assert len(set(layout_digests(many, {"dynamics": {}}).values())) == 5


def test_every_layout_has_a_way_as_long_as_asked() -> None:
    """By the distances of cells' centres, at twice the resolution, and a flood from the start."""
    floors = Floors()
    drawn = floors.draw(range(12), seed=8)
    assert drawn.start is not None and drawn.goal is not None
    stages = np.broadcast_to(np.asarray(drawn.stages), 12)
    for i, cells in enumerate(cells_of(drawn)):
        fine = cells.repeat(2, 0).repeat(2, 1)
        away = 0.05 * distance_transform_edt(~fine)
        regions, _ = label(away > floors.vehicle_radius, np.ones((3, 3)))
        places = [tuple(np.floor(end[i] / 0.05).astype(int)) for end in (drawn.start, drawn.goal)]
        assert regions[places[0]] == regions[places[1]] > 0
        assert min(away[place] for place in places) > 1.3 * floors.vehicle_radius
        way = float(stages[i]) * floors.dt * floors.pace  # rounded up to a second
        assert floors.apart <= way and np.linalg.norm(drawn.start[i] - drawn.goal[i]) <= way + 1e-9
    assert (stages % 10 == 0).all() and len(set(stages.tolist())) > 5


def test_all_rooms_are_joined_by_doors_and_walls_are_as_thick_as_asked() -> None:
    thick = set()
    for seed in range(20):
        canvas = Canvas.of((20.0, 14.0), 0.1)
        Floors(loops=0.0, furniture=0.0).draw_rooms(np.random.default_rng(seed), canvas)
        free = ~canvas.occupied
        away = 0.1 * distance_transform_edt(free)
        regions, _ = label(away > 0.3)
        assert np.bincount(regions.ravel())[1:].max() > 0.99 * (regions > 0).sum(), "for a vehicle of 0.25 m"
        edge = round(RIM / 0.1)
        assert canvas.occupied[:edge].all() and canvas.occupied[:, -edge:].all()
        runs = np.diff(np.flatnonzero(np.diff(canvas.occupied[:, edge + 12].astype(int))))[1::2]
        thick |= set(runs.tolist())
    assert min(thick) <= 2 and 12 < max(thick) <= 17, "cells"


def test_furniture_keeps_off_doors() -> None:
    bare, full = (Canvas.of((20.0, 14.0), 0.1) for _ in range(2))
    Floors(thickness=(0.1, 0.4), furniture=0.0).draw_rooms(np.random.default_rng(3), bare)
    Floors(thickness=(0.1, 0.4), furniture=2.0).draw_rooms(np.random.default_rng(3), full)
    more = full.occupied & ~bare.occupied
    assert more.sum() > 500 and not (bare.occupied & ~full.occupied).any()
    regions, _ = label(0.1 * distance_transform_edt(~bare.occupied) > 0.25)
    narrow = (distance_transform_edt(~bare.occupied) < 9) & (regions > 0)  # near walls, doors too
    assert (more & narrow).any() and label(~full.occupied)[1] < 60


@pytest.mark.parametrize("seed", range(6))
def test_a_track_is_one_lane_as_wide_as_asked(seed: int) -> None:
    canvas = Canvas.of((20.0, 14.0), 0.1)
    start, goal = Floors().draw_track(np.random.default_rng(seed), canvas)
    free = ~canvas.occupied
    away = distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * 0.1
    assert label(free)[1] == 1 and 0.5 <= away.max() <= 1.45, "half its width, more in corners"
    for end in (start, goal):
        assert away[tuple(np.floor(end / 0.1).astype(int))] >= 0.45
    assert label(away < 0.05 + 1e-9)[1] == 1, "no island: there is one way"
    assert not free[: round(RIM / 0.1)].any() and not free[:, -round(RIM / 0.1) :].any()


def test_tracks_or_rooms_alone() -> None:
    track_alone, rooms_alone = (Floors(tracks=share).draw(range(4), 0) for share in (1.0, 0.0))
    fill = [float((~cells_of(one)).mean()) for one in (track_alone, rooms_alone)]
    assert fill[0] < 0.35 < fill[1]


def test_a_file_keeps_the_maps_and_stages_of_all_layouts(tmp_path: Path) -> None:
    layouts = Floors(**SMALL).draw(range(4), 1)
    assert isinstance(layouts.stages, np.ndarray)
    layouts.save(tmp_path / "floors.npz")
    held = Layouts.load(tmp_path / "floors.npz")
    assert held == layouts
    np.testing.assert_array_equal(held.map.values, layouts.map.values)
    both = concatenate([layouts.take([3]), layouts.take([0, 1])])
    assert both.map is not None and both.map.batch == 3
    assert isinstance(both.stages, np.ndarray) and both.stages.tolist() == layouts.stages[[3, 0, 1]].tolist()
    np.testing.assert_array_equal(both.map.values, layouts.map.values[[3, 0, 1]])
    places = layouts.alike()
    assert sorted(np.concatenate(places).tolist()) == [0, 1, 2, 3]
    assert all(isinstance(layouts.take(some).stages, int) for some in places)


@pytest.mark.parametrize("stages", [[1, 2], [0, 1, 2], [1.5, 2.0, 3.0], "3"])
def test_wrong_stages_are_refused(stages: Any) -> None:
    none = np.empty((3, 0, 2))
    with pytest.raises(InputError, match=r"layouts\.stages: expected"):
        Layouts(none, none[..., 0], stages=stages)


def test_maps_of_another_number_are_refused() -> None:
    layouts = Floors(**SMALL).draw(range(3), 1)
    none = np.empty((2, 0, 2))
    with pytest.raises(InputError, match=r"layouts\.map: expected one map for all, 2-D as centers, or a grid for each"):
        Layouts(none, none[..., 0], map=layouts.map)


def test_the_command_makes_problems_with_horizons_of_their_own() -> None:
    setup = compose(["scenario=floors", "scenario.size=[9,7]", "scenario.apart=4", "study.layouts=3", "solver=hold"])
    assert setup.vehicle.name == "unicycle"
    layouts = setup.layouts()
    task = setup.task(layouts)
    assert task.problem.stages.tolist() == np.broadcast_to(np.asarray(layouts.stages), 3).tolist()
    assert task.U0.shape == (3, int(task.problem.stages.max()), 2) and bool(task.problem.start_is_clear.all())
    verdict = judge(task.problem, task.U0)
    assert bool((verdict.clearance > 0).all()) and not bool(verdict.reached.any())
    gaps = [float(layouts.map.single(i).distance(layouts.start[i, :2])) for i in range(3)]
    torch.testing.assert_close(verdict.clearance, torch.tensor(gaps).double() - 0.249, rtol=0, atol=5e-3)
    fixed = compose(["scenario=floors", "scenario.stages=77", "model=planar"]).layouts(2)
    assert fixed.stages == 77


@pytest.mark.parametrize(("options", "said"), [
    ({"door": (0.7, 1.0)}, r"scenario\.door: expected widths of at least 0\.95 m"),
    ({"lane": (0.7, 1.0)}, r"scenario\.lane: expected widths of at least 0\.95 m"),
    ({"room": 1.5}, r"scenario\.room: expected more than the widest door"),
    ({"size": (4.0, 9.0)}, r"scenario\.size: expected at least 4\.8 m along each axis"),
    ({"lanes": (5, 3)}, r"scenario\.lanes: expected a list of 2"),
    ({"thickness": (0.0, 1.0)}, r"scenario\.thickness: expected a list of 2"),
    ({"tracks": 1.5}, r"scenario\.tracks: expected"),
    ({"pace": 0.0}, r"scenario\.pace: expected"),
    ({"stages": 0}, r"scenario\.stages: expected"),
])  # fmt: skip
def test_wrong_fields(options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        Floors(**options)


def test_a_way_longer_than_any_plan_has() -> None:
    with pytest.raises(InputError, match=r"scenario\.apart: expected a way that a plan of 6 x 6 m has"):
        Floors(size=(6.0, 6.0), apart=500.0).draw([0], 0)
