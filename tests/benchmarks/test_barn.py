"""The worlds of the BARN challenge: how they are read, the body, the score, and some worlds from end to end."""

from __future__ import annotations

import heapq

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from benchmarks.outside.barn import (
    BODY,
    RECTANGLE,
    VEHICLE,
    Drives,
    drive,
    gap,
    headings,
    main,
    problems,
    rectangle_gap,
    worlds,
)
from benchmarks.outside.barn_data import GOAL, RADIUS, START, cylinders, path_length
from benchmarks.outside.barn_lidar import CELL, CORNER, RETURNS, Robot, braking, run, world_of
from torchgco import Unicycle, judge, solve

MODEL = """<model name='{name}'><static>1</static><pose frame=''>{x} {y} 0 0 0 0</pose><link name='link'><collision
name='collision'><geometry><{kind}><radius>{radius}</radius></{kind}></geometry></collision></link></model>"""


def world(*models: str) -> str:
    """The text of a world; a simulator's state repeats the models."""
    ground = "<model name='ground_plane'><link name='link'><collision name='c'><plane/></collision></link></model>"
    state = "<state><model name='unit_cylinder_0'><pose frame=''>9 9 0 0 0 0</pose></model></state>"
    return f"<sdf version='1.6'><world name='default'>{ground}{''.join(models)}{state}</world></sdf>"


def model(x: float, y: float, radius: float = RADIUS) -> str:
    return MODEL.format(name="unit_cylinder_0", x=x, y=y, kind="cylinder", radius=radius)


def test_a_world_is_read_without_ground_and_state() -> None:
    assert cylinders(world(model(-0.075, 0.075), model(-1.5, 2.25))).tolist() == [[-0.075, 0.075], [-1.5, 2.25]]
    for text in (world(), world(model(0, 0, radius=0.1))):
        with pytest.raises(ValueError, match=r"expected cylinders of radius 0\.075"):
            cylinders(text)


def test_the_path_leads_from_start_to_goal_over_the_middles_of_cells() -> None:
    first, last = np.array([-1.575, 5.075]), np.array([-1.575, 5.375])  # cells (20, 0) and (20, 2)
    expected = np.linalg.norm(first - START) + 0.3 + np.linalg.norm(GOAL - last)
    assert path_length(np.array([[20, 0], [20, 1], [20, 2]])) == pytest.approx(expected)


def test_the_shipped_worlds_are_the_test_worlds() -> None:
    layouts, table = worlds()
    assert table["world"].tolist() == layouts.ids.tolist() == list(range(0, 300, 6))
    assert worlds(test=False)[0].ids.tolist() == [world for world in range(300) if world % 6]
    present = ~np.isnan(layouts.radii)
    assert present.sum(axis=1).tolist() == table["cylinders"].tolist() and (layouts.radii[present] == RADIUS).all()
    places = (layouts.centers[present] - RADIUS) / (2 * RADIUS)  # of a grid of touching cylinders
    np.testing.assert_allclose(places, places.round(), rtol=0, atol=1e-6)
    assert (table["optimal"] * 2 > 10.0).all() and layouts.start is not None
    assert layouts.start[0].tolist() == [*START, np.pi / 2, 0.0]


def widest(centers: np.ndarray) -> float:
    """Radius of the largest disc that gets from start to goal between cylinders (M, 2): a path over Delaunay's gaps."""
    points = np.vstack((centers, [[-30, -20], [25, -20], [-30, 40], [25, 40]]))
    mesh = Delaunay(points)
    start, goal = int(mesh.find_simplex(START)), int(mesh.find_simplex(GOAL))
    best, queue = {start: np.inf}, [(-np.inf, start)]
    while queue:
        width, here = heapq.heappop(queue)
        if here == goal:
            return -width / 2 - RADIUS
        for side, there in enumerate(mesh.neighbors[here]):
            a, b = np.delete(mesh.simplices[here], side)
            gate = min(-width, float(np.linalg.norm(points[a] - points[b])))
            if there >= 0 and gate > best.get(there, 0.0):
                best[there] = gate
                heapq.heappush(queue, (-gate, int(there)))
    return 0.0


def test_the_planned_disc_fits_through_every_world() -> None:
    layouts, _ = worlds()
    radii = [widest(centers[~np.isnan(centers[:, 0])]) for centers in layouts.centers]
    assert min(radii) == pytest.approx(0.375) and BODY < VEHICLE < min(radii)
    assert pytest.approx(np.hypot(0.229, 0.207795)) == BODY


def test_the_drive_is_that_of_a_fine_unicycle() -> None:
    generator = torch.Generator().manual_seed(0)
    U, x = torch.randn(20, 2, generator=generator, dtype=torch.float64), torch.tensor([-2.25, 3.0, 1.5, 0.3]).double()
    path, along, fine = drive(x.numpy(), U.numpy()), headings(x.numpy(), U.numpy()), Unicycle(dt=0.001)
    for k in range(20):
        for _ in range(100):
            x = fine.step(x, U[k])
        np.testing.assert_allclose(path[100 * (k + 1)], x[:2], rtol=0, atol=1e-6)
        assert along[100 * (k + 1)] == pytest.approx(float(x[2]), abs=1e-9)


def test_contact_between_knots_counts() -> None:
    path = np.stack((np.zeros(1001), np.linspace(0.0, 1.0, 1001)), axis=-1)
    assert gap(path, np.array([[0.5, 0.55], [np.nan, np.nan]])) == pytest.approx(0.5 - RADIUS - BODY)


def test_the_rectangle_is_measured_as_it_turns() -> None:
    path, length, width = np.array([[1.0, 2.0]]), 0.229, 0.207795  # half of each, m
    cases = {(1.0, 2.5): 0.5 - length, (1.5, 2.0): 0.5 - width, (1.3, 2.3): np.hypot(0.3 - length, 0.3 - width)}
    for center, apart in cases.items():
        rows = np.array([center, [np.nan, np.nan], [9.0, 9.0]])
        assert rectangle_gap(path, np.array([np.pi / 2]), rows) == pytest.approx(apart - RADIUS)
        other = rectangle_gap(np.repeat(path, 2, 0), np.array([np.pi / 2, 0.0]), rows)
        assert other == pytest.approx(min(apart, 0.5 - length if 1.5 in center else apart) - RADIUS)
    assert rectangle_gap(path, np.zeros(1), np.array([[1.1, 2.1]])) == pytest.approx(-RADIUS)  # within
    corners = np.array([[sx * length, sy * width] for sx in (-1, 1) for sy in (-1, 1)])
    away = np.linalg.norm(corners[:, None] - RECTANGLE.offsets.numpy(), axis=-1)
    assert (away.min(1) <= RECTANGLE.radii.numpy().max()).all()


def test_the_score_is_the_challenges() -> None:
    one, yes = np.ones(4), np.array([True, True, True, False])
    drives = Drives(np.array([5.0, 20.0, 90.0, 5.0]), one, one, yes)
    assert drives.score(np.full(4, 5.0)).tolist() == [0.5, 0.25, 0.125, 0.0]


@pytest.mark.slow
def test_four_worlds_from_end_to_end(capsys) -> None:
    """The first two test worlds and the first two others."""
    assert main(["--first", "2"]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| `gco`")]
    assert [row[2][:6] for row in rows] == ["2 of 2"] * 2 and [row[3] for row in rows] == ["0.500"] * 2


@pytest.mark.slow
def test_worlds_with_narrow_gaps_are_crossed_within_the_limit_on_speed() -> None:
    """The way takes as long as the limit allows: candidates that hurry leave their paths, and fall into the traps."""
    layouts, table = worlds(test=False)
    problem = problems(layouts.take(np.flatnonzero(table["world"].isin((111, 181, 266)))))
    verdict = judge(problem, solve(problem).U)
    assert bool(verdict.reached.all())


def test_a_vehicle_at_rest_succeeds_nowhere() -> None:
    layouts, known = worlds(first=1)
    problem = problems(layouts)
    drives = Drives.of(problem, layouts, torch.zeros(1, problem.N, 2, dtype=torch.float64))
    assert not drives.sound.any() and np.isinf(drives.seconds).all() and drives.clearance[0] > 1.0
    assert drives.score(known["optimal"].to_numpy()).tolist() == [0.0]


def robot(*returns: tuple[float, float]) -> Robot:
    """A robot at the origin that has marked cells at some points, m."""
    one = Robot(world_of(np.full((1, 2), np.nan)), 0, np.array([0.0, 3.0, np.pi / 2, 2.0]))
    for point in returns:
        one.counts[tuple(np.floor((np.array(point) - CORNER) / CELL).astype(int))] = RETURNS
    return one


def test_braking_stops_within_the_limits_and_turns_on_as_much_as_the_change_of_rate_asks_for() -> None:
    x, before = np.array([0.0, 0.0, 0.0, 2.0]), np.array([0.0, 1.57])
    U = braking(x, before)
    assert np.abs(U[:, 0]).max() <= 10.0 and abs(np.abs(np.diff(U[:, 1], prepend=1.57)).max()) <= 2.0
    assert 2.0 + 0.1 * U[:, 0].sum() == pytest.approx(0.0, abs=1e-12) and not U[3:].any()


def test_a_stage_is_flown_where_the_robot_can_stop_behind_it() -> None:
    x, straight = np.array([0.0, 3.0, np.pi / 2, 2.0]), np.zeros(2)  # at 2 m/s it stops after 0.2 + 0.2 m
    assert robot().clear_until_rest(x, straight)
    assert robot((0.0, 3.0 + 0.45 + BODY)).clear_until_rest(x, straight)
    assert not robot((0.0, 3.0 + 0.35 + BODY)).clear_until_rest(x, straight)
    assert robot((0.0, 3.0 - BODY + 0.01)).clear_until_rest(x, straight)  # in contact, but on its way out of it


def test_a_scan_marks_the_near_sides_of_cylinders() -> None:
    one = Robot(world_of(np.array([[0.0, 5.0], [np.nan, np.nan]])), 0, np.array([0.0, 3.0, np.pi / 2, 0.0]))
    one.sense(0, seed=0)
    cells = CORNER + (np.argwhere(one.counts) + 0.5) * CELL
    away = np.linalg.norm(cells - [0.0, 5.0], axis=1)
    assert len(cells) > 3 and (np.abs(away - RADIUS) <= CELL).all() and (cells[:, 1] < 5.0).all()


@pytest.mark.slow
def test_a_world_is_driven_through_a_lidar() -> None:
    layouts, known = worlds()
    assert layouts.start is not None
    found = run(layouts.start[12], layouts.centers[12], int(layouts.ids[12]), seed=0)
    assert found.outcome == "REACHED" and found.clearance > 0 and found.turn_change <= 20.0
    assert found.seconds <= 2 * known["optimal"].iloc[12] and len(found.period) * 0.1 == pytest.approx(found.seconds)
