"""Scenes in which obstacles move follow their rules, and a point gets through each that is drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchgco import Layouts, compose, judge, solve
from torchgco.base.errors import InputError
from torchgco.scenarios import Conveyor, Revolving, Sliding, Swarm, Traffic, Walkers
from torchgco.scenarios.moving import AmongMovers
from torchgco.scenarios.passable import way_through

IN_THE_PLANE = [Traffic(), Sliding(), Walkers(), Revolving(), Conveyor()]
QUICK = [pytest.param(one, id=one.name) for one in IN_THE_PLANE]
ALL = [*QUICK, pytest.param(Swarm(), id="swarm", marks=pytest.mark.slow)]


def clearance(layout: Layouts, p: np.ndarray, t: float) -> float:
    """Distance of a place (d,) from the surfaces of all obstacles at a time, m: one after the other."""
    least = np.inf
    for i, radius in enumerate(layout.radii[0]):
        if np.isnan(radius):
            continue
        moved = layout.centers[0, i] + (0 if layout.velocities is None else t * layout.velocities[0, i])
        least = min(least, float(np.linalg.norm(p - moved) - radius))
    for k in range(0 if layout.box_centers is None else layout.box_centers.shape[1]):
        center = layout.box_centers[0, k].copy()
        if layout.box_amplitudes is not None:
            sines = (getattr(layout, f"box_{name}")[0, k] for name in ("amplitudes", "rates", "phases"))
            for a, w, phase in zip(*sines, strict=True):
                center += a * np.sin(w * t + phase)
        q = np.abs(p - center) - layout.box_half_sizes[0, k]
        least = min(least, np.linalg.norm(np.maximum(q, 0)) + min(q.max(), 0.0) - layout.box_radii[0, k])
    return least


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scenario", ALL)
def test_a_layout_depends_on_seed_and_number_alone(scenario) -> None:
    many = scenario.draw([0, 5], seed=3)
    assert scenario.draw([5], seed=3) == many.take([1])
    assert scenario.draw([5], seed=2) != many.take([1]) != many.take([0])
    assert many.name == scenario.name


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scenario", QUICK)
def test_a_point_gets_through_with_room_from_rest_to_rest(scenario: AmongMovers) -> None:
    for number in range(3):
        layout = scenario.draw([number], seed=1)
        way = way_through(layout, scenario.region, scenario.pace, scenario.room, scenario.grace, scenario.cell)
        assert way is not None
        assert np.linalg.norm(way.points[0] - layout.start[0]) < 0.71 * scenario.cell
        assert np.linalg.norm(way.points[-1] - layout.goal[0]) < 0.71 * scenario.cell
        speed = np.linalg.norm(np.diff(way.points, axis=0), axis=1) / np.diff(way.times)
        assert speed.max() <= scenario.pace * (1 + 1e-9)
        rests = way.times <= scenario.grace
        assert (way.points[rests] == way.points[0]).all() and (way.points[way.times >= 15.5] == way.points[-1]).all()
        assert way.times[-1] <= scenario.stages * scenario.dt + 1e-9
        half = 0.5 * (way.points[1:] + way.points[:-1]), 0.5 * (way.times[1:] + way.times[:-1])
        for p, t in [*zip(way.points, way.times, strict=True), *zip(*half, strict=True)]:
            assert clearance(layout, p, t) >= scenario.vehicle_radius + scenario.room - 1e-9


def gate(opens: bool, late: bool = False) -> Layouts:
    """A wall with an opening of 1 m that a box of 1.2 m covers, always or but for half a period."""
    boxes = [[2.0, -1.5], [2.0, 1.5], [2.0, 0.0]]
    half = [[0.1, 1.0], [0.1, 1.0], [0.15, 0.6]]
    amplitudes = np.zeros((1, 3, 1, 2))
    amplitudes[0, 2, 0, 1] = 2.0 * opens
    rates, phases = np.full((1, 3, 1, 2), 2 * np.pi / 8.0), np.zeros((1, 3, 1, 2))
    return Layouts(
        np.empty((1, 0, 2)), np.empty((1, 0)), start=[0.0, 0.0], goal=[4.0, 0.0], vehicle_radius=0.2, dt=0.1,
        stages=30 if late else 100, box_centers=np.array([boxes]), box_half_sizes=np.array([half]),
        box_radii=np.zeros((1, 3)), box_amplitudes=amplitudes, box_rates=rates, box_phases=phases,
    )  # fmt: skip


def test_ways_wait_for_what_opens_and_there_is_none_through_what_does_not() -> None:
    region, how = [[-1, 5], [-2, 2]], (1.0, 0.05, 0.5, 0.2)
    assert way_through(gate(True), region, *how) is not None
    assert way_through(gate(False), region, *how) is None
    assert way_through(gate(True, late=True), region, *how) is None, "in 3 s, of which 1 s is at rest"
    assert way_through(gate(True), region, 1.0, 0.4, 0.5, 0.2) is None, "no room"


def test_traffic_keeps_its_gaps_and_its_lanes_are_never_empty() -> None:
    scenario = Traffic()
    drawn = scenario.draw(range(5), seed=0)
    for centers, radii, velocities in zip(drawn.centers, drawn.radii, drawn.velocities, strict=True):
        for x in scenario.lanes:
            lane = centers[:, 0] == x
            y, (radius,), (v,) = np.sort(centers[lane, 1]), {*radii[lane]}, {*velocities[lane, 1]}
            gaps = np.diff(y) - 2 * radius - 2 * scenario.vehicle_radius
            assert 0.35 <= radius <= 0.45 and 0.3 <= abs(v) <= 0.8 and (velocities[lane, 0] == 0).all()
            assert (gaps > 0.6 - 1e-9).all() and (gaps < 1.2 + 1e-9).all() and np.ptp(gaps) < 1e-9
            for t in np.linspace(0, 16, 9):
                now = np.sort(y + t * v)
                assert now[0] <= -2.4 + radius + 2.6 and now[-1] >= 2.4 - radius - 2.6


def test_leaves_cover_their_opening_and_leave_it() -> None:
    drawn = Sliding().draw([0, 1], seed=0)
    for i in range(2):
        for k in (2, 5):
            low, high = drawn.box_centers[i, k - 2 : k, 1] + np.array([1, -1]) * drawn.box_half_sizes[i, k - 2 : k, 1]
            assert high - low == pytest.approx(0.8)
            leaf = drawn.box_centers[i, k, 1] + drawn.box_amplitudes[i, k, 0, 1] * np.array([-1, 1])
            assert leaf == pytest.approx([0.5 * (low + high), 0.5 * (low + high) + 0.8])
            assert 3.0 <= 2 * np.pi / drawn.box_rates[i, k, 0, 1] <= 6.0


def test_arms_turn_about_the_middle_of_their_opening() -> None:
    drawn = Revolving(arms=2).draw([0], seed=0)
    half, center = drawn.box_half_sizes[0], drawn.box_centers[0]
    balls = (half == 0).all(1) & (center[:, 0] == 2.0)
    a, w, phase = (getattr(drawn, f"box_{name}")[0, balls, 0] for name in ("amplitudes", "rates", "phases"))
    (middle,) = {tuple(c) for c in center[balls]}
    for t in (0.0, 1.3):
        off = a * np.sin(w * t + phase)
        assert np.linalg.norm(off, axis=1) == pytest.approx(a[:, 0]) and np.linalg.matrix_rank(off, 1e-9) == 1
        assert np.linalg.norm(off, axis=1).max() == pytest.approx(1.0)
    walls = (half[:, 0] == 0.1) & (center[:, 0] == 2.0)
    ends = np.abs(center[walls, 1] - middle[1]) - half[walls, 1]
    assert ends == pytest.approx([1.1, 1.1])
    spaced = np.sort(a[:, 0] * np.sign(np.sin(phase[:, 1] - phase[0, 1] + 0.1)))
    assert np.diff(spaced).max() <= 2 * 0.07 + 1e-9, "neighbours touch"


@pytest.mark.slow
def test_belts_miss_some_discs_and_walkers_stay_away_at_first() -> None:
    drawn = Conveyor(missing=0.4).draw(range(4), seed=0)
    y = np.sort(drawn.centers[0][drawn.centers[0, :, 0] == 1.4, 1])
    steps = np.diff(y) / 1.1
    assert steps == pytest.approx(np.round(steps)) and steps.max() > 1.5
    scenario = Walkers(num_obstacles=20, pace=2.0)
    drawn = scenario.draw(range(3), seed=0)
    for t in np.linspace(0, 1, 20):
        assert np.linalg.norm(drawn.centers + t * drawn.velocities - [0.7, 3.0], axis=-1).min() > 0.9
    speeds = np.linalg.norm(drawn.velocities, axis=-1)
    assert speeds.min() >= 0.4 and speeds.max() <= 1.3 and drawn.radii.shape == (3, 20)


def test_what_cannot_be_drawn_is_said(monkeypatch) -> None:
    monkeypatch.setattr("torchgco.scenarios.moving.TRIES", 3)
    with pytest.raises(InputError, match=r"scenario\.pace: expected layouts that a point gets through .* none in 3"):
        Traffic(pace=0.3).draw([0], seed=0)
    with pytest.raises(InputError, match=r"scenario\.clearance: expected room for 10 walkers"):
        Walkers(clearance=50.0).draw([0], seed=0)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("scenario", QUICK)
def test_files_keep_them_and_any_model_of_the_plane_moves_there(scenario: AmongMovers, tmp_path: Path) -> None:
    drawn = scenario.draw([0], seed=4)
    drawn.save(tmp_path / "scene.npz")
    assert replace(Layouts.load(tmp_path / "scene.npz"), name=scenario.name) == drawn
    for model in ("planar", "unicycle", "car"):
        problem = compose([f"scenario={scenario.name}", f"model={model}"]).task(drawn).problem
        assert problem.N == 160 and any(part.moving for part in problem.obstacles)
        assert problem.x0[0, :2].tolist() == list(scenario.start)


@pytest.mark.slow
def test_a_walk_through_the_room_is_found() -> None:
    setup = compose(["scenario=walkers", "seed=1"])
    problem = setup.task(setup.layouts(2)).problem
    assert bool(judge(problem, solve(problem, verbose=False).U).reached.all())
