"""Worlds that can't be flown around: woods, mazes and crossing spheres follow their rules."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import label

from benchmarks.lib.families import WORLDS
from torchgco import compose
from torchgco.base.errors import InputError
from torchgco.scenarios import Crossing, Layouts, Mazes, Rooms, Woods

WALLS = 4 * 4 * 2 + 5 * 3 * 2 + 5 * 4  # between 5 x 4 x 2 rooms
SCENARIOS = [Woods(), Mazes(), Crossing(), Rooms()]


def rows(layouts: Layouts, i: int) -> list[np.ndarray]:
    """The arrays of one layout without the padding."""
    held = [
        layouts.centers[i],
        layouts.radii[i, :, None],
        layouts.velocities[i] if layouts.velocities is not None else [],
    ]
    for part in (layouts.box_centers, layouts.box_half_sizes, layouts.box_rotations, layouts.box_radii):
        held.append(np.empty((0, 1)) if part is None else part[i].reshape(part.shape[1], -1))
    return [np.asarray(part)[~np.isnan(np.asarray(part)).all(axis=-1)] if len(part) else np.empty(0) for part in held]


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.name)
def test_a_layout_depends_on_seed_and_number_alone(scenario) -> None:
    many, alone = scenario.draw(range(6), seed=3), scenario.draw([4], seed=3)
    for mine, other in zip(rows(alone, 0), rows(many, 4), strict=True):
        assert np.array_equal(mine, other)
    others = rows(many, 3), rows(scenario.draw([4], seed=2), 0)
    assert all(any(not np.array_equal(a, b) for a, b in zip(rows(alone, 0), other, strict=True)) for other in others)


def test_trunks_are_a_poisson_process() -> None:
    woods = Woods(density=0.1)
    drawn = woods.draw(range(400), seed=0)
    assert drawn.box_centers is not None and drawn.box_radii is not None and drawn.box_half_sizes is not None
    there = ~np.isnan(drawn.box_radii)
    counts = there.sum(axis=1)
    assert woods.expected_count == pytest.approx(45)
    assert counts.mean() == pytest.approx(45, abs=5 * np.sqrt(45 / 400)) and counts.var() == pytest.approx(45, rel=0.3)
    centers = drawn.box_centers[there]
    for axis, (low, high) in enumerate(woods.region):
        assert low <= centers[:, axis].min() < low + 0.05 and high - 0.05 < centers[:, axis].max() <= high
    assert (centers[:, 2] == 0).all() and (drawn.box_half_sizes[there] == (0, 0, 8)).all()
    assert 0.25 <= drawn.box_radii[there].min() < 0.251 and 0.449 < drawn.box_radii[there].max() <= 0.45


def test_trunks_keep_clear_of_start_and_goal() -> None:
    drawn = Woods(region=[[-3, 22], [-1, 3]], clearance=2.0).draw(range(20), seed=0)
    assert drawn.box_centers is not None and drawn.start is not None and drawn.goal is not None
    for end in (drawn.start, drawn.goal):
        distance = np.linalg.norm(drawn.box_centers[..., :2] - end[:, None, :2], axis=-1)
        assert 2.0 < np.nanmin(distance) < 2.2


def test_a_wall_is_closed_but_for_its_opening() -> None:
    maze = Mazes(walls=3, loose=0)
    drawn = maze.draw(range(8), seed=0)
    assert drawn.box_centers is not None and drawn.box_half_sizes is not None
    rng = np.random.default_rng(0)
    for center, half in zip(drawn.box_centers.reshape(-1, 4, 3), drawn.box_half_sizes.reshape(-1, 4, 3), strict=True):
        points = np.column_stack([np.full(4000, center[0, 0]), rng.uniform((-24, -8), (26, 8), (4000, 2))])
        solid = (np.abs(points[:, None] - center) <= half).all(axis=2).any(axis=1)
        open_points = points[~solid]
        opening = (
            center[2, 1],
            0.5 * (center[2, 2] + half[2, 2] + center[3, 2] - half[3, 2]),
        )  # of the lower and upper box
        assert len(open_points) and (np.abs(open_points[:, 1:] - opening) <= 0.9).all()
        assert (np.abs(points[solid, 1:] - opening) >= 0.9).any(axis=1).all()
    x = drawn.box_centers[..., 0]
    assert np.unique(x).tolist() == [5.75, 9.5, 13.25]


@pytest.mark.slow
def test_doors_join_all_rooms_by_one_way() -> None:
    """Without loops: as many doors as rooms but one, so nothing is left to go around by."""
    low, high, spacing = np.array([-2.0, -2.0, -1.5]), np.array([10.0, 6.0, 4.5]), 0.15
    small = Rooms(rooms=(3, 2, 2), region=list(zip(low, high, strict=True)), goal=(8.0, 4.0, 3.0), loops=0.0)
    drawn = small.draw(range(3), seed=0)
    assert drawn.box_centers is not None and drawn.box_half_sizes is not None
    axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    for centers, halves in zip(drawn.box_centers, drawn.box_half_sizes, strict=True):
        there = ~np.isnan(centers[:, 0])
        assert there.sum() == 6 + (2 * 2 * 2 + 3 * 2 + 3 * 2) + 3 * 11  # four boxes around each of 11 doors
        solid = np.zeros(points.shape[:3], bool)
        for center, half in zip(centers[there], halves[there], strict=True):
            solid |= (np.maximum(np.abs(points - center) - half, 0.0) ** 2).sum(-1) <= 0.3**2
        assert label(~solid)[1] == 1  # the vehicle gets from everywhere to everywhere


def test_some_of_the_other_walls_have_doors_too() -> None:
    few, all_of_them = Rooms(loops=0.0).draw([0], 0), Rooms(loops=1.0).draw([0], 0)
    assert few.box_centers is not None and all_of_them.box_centers is not None
    assert all_of_them.box_centers.shape[1] - few.box_centers.shape[1] == 3 * (WALLS - 39)
    assert all_of_them.box_centers.shape[1] == 6 + 4 * WALLS


def test_spheres_cross_the_corridor_within_the_horizon_and_spare_the_start() -> None:
    crossing = Crossing(num_obstacles=20)
    drawn = crossing.draw(range(50), seed=0)
    assert drawn.velocities is not None and drawn.start is not None
    speed = np.linalg.norm(drawn.velocities, axis=-1)
    assert 1.0 <= speed.min() < 1.1 and 3.9 < speed.max() <= 4.0 and (drawn.velocities[..., 2] == 0).all()
    times = np.linspace(0, 8, 801)
    place = drawn.centers[..., None, :] + times[:, None] * drawn.velocities[..., None, :]
    low, high = np.array(crossing.corridor).T
    assert ((place >= low - 0.03) & (place <= high + 0.03)).all(axis=-1).any(axis=-1).all()
    early = place[:, :, :101] - drawn.start[:, None, None, :3]
    assert 1.25 < np.linalg.norm(early, axis=-1).min() < 1.5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Woods(density=1e6), "scenario.density: expected at most 50000 trunks in scenario.region"),
        (lambda: Woods(radii=[0.5, 0.2]), "scenario.radii: expected a list of 2 numbers above 0 m"),
        (lambda: Woods(height=[1.0]), "scenario.height: expected a list of 2 numbers"),
        (lambda: Mazes(opening=[20.0, 1.0], opening_region=[[-20, 20], [0, 0]]), "scenario.opening: expected openings"),
        (lambda: Rooms(door=[4.0, 1.0]), "scenario.door: expected openings that fit into the walls of a room"),
        (
            lambda: Rooms(goal=[14.0, 12.0, 3.0]),
            "scenario.goal: expected a point of scenario.region clear of its walls",
        ),
        (lambda: Mazes(walls=-1), "scenario.walls: expected a whole number between 0 and 1000"),
        (lambda: Crossing(speeds=[-1, 2]), "scenario.speeds: expected a list of 2 numbers between 0 and 1e+06 m/s"),
        (
            lambda: Crossing(corridor=[[-1, -1], [1, 1], [0, 0]], grace=8.0).draw([0], 0),
            "scenario.clearance: expected room for 10 spheres",
        ),
    ],
)
def test_refuses(make, message) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", WORLDS)
def test_the_public_layouts_are_drawn_by_the_rules(name) -> None:
    """The first public layout is among the first ones drawn: those without a way through were left out."""
    family = WORLDS[name]
    held = Layouts.load(family.file())
    drawn = compose([*family.drawn, "seed=0"]).scenario.draw(range(40), 0)
    assert held.count == 32 and held.best_cost is not None
    first = rows(held, 0)
    assert any(all(np.array_equal(a, b) for a, b in zip(first, rows(drawn, i), strict=True)) for i in range(40))
