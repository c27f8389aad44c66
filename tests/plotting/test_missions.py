from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.contour import QuadContourSet
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from torchgco import Body, Problem, QuadraticCost, QuadrotorPlanning, Spheres
from torchgco.base.errors import InputError
from torchgco.dynamics.quadrotor import Airframe
from torchgco.maps import DistanceField, OccupancyGrid
from torchgco.missions.outcome import Outcome
from torchgco.plotting import missions
from torchgco.plotting.bodies import Ball, Box
from torchgco.plotting.course import Course
from torchgco.plotting.vehicle_body import VehicleBody

STEPS, KNOTS, PERIOD = 12, 6, 0.05


@pytest.fixture
def frame() -> pd.DataFrame:
    """A flight along x at 10 m/s, a row per control step."""
    k = np.arange(STEPS)
    columns: dict[str, Any] = {"mission": np.full(STEPS, 7), "step": k, "t": PERIOD * k}
    columns |= {f"x{i}": np.zeros(STEPS) for i in range(17)}
    columns |= {"x0": 0.5 * k, "x3": np.full(STEPS, 10.0), "x6": np.ones(STEPS)}
    columns |= {f"f{i}": np.full(STEPS, 3.0 + i) for i in range(1, 5)}
    columns |= {f"u{i}": np.full(STEPS, 5000.0 + i) for i in range(1, 5)}
    columns |= {"planner_seconds": np.where(k == 3, 0.2, 0.02), "tracker_seconds": np.full(STEPS, 0.005)}
    columns |= {"tracking_violation": np.where(k == 0, 0.0, 1e-9), "guided": (k == 3).astype(int)}
    return pd.DataFrame(columns)


@pytest.fixture
def plans() -> np.ndarray:
    """Half a metre along x from knot to knot, (K, N+1, 3)."""
    x = 0.5 * (np.arange(STEPS)[:, None] + np.arange(KNOTS))
    return np.stack((x, np.zeros_like(x), np.zeros_like(x)), axis=-1)


def course(speed: float = 0.0) -> Course:
    """A sphere 1 m beside the track at x = 2, which comes toward it at `speed`, m/s."""
    ball = Ball(np.array([2.0, 1.0, 0.0]), 0.3, np.array([0.0, -speed, 0.0]))
    return Course((ball,), np.array([6.0, 0.0, 0.0]), 0.5, vehicle_radius=0.2)


def test_a_body_counts_by_its_balls_as_they_are_turned() -> None:
    """A rotor 0.6 m to the left of a track that passes a sphere at 1 m touches it, but not once it is turned ahead."""
    body = Spheres([[9.0, 9.0, 9.0]], [0.3], Body([[0.0, 0.6, 0.0], [0.0, 0.0, 0.0]], 0.2, "quaternion"))
    rest = torch.zeros(1, 14, dtype=torch.float64)
    rest[0, 6] = 1.0
    cost = QuadraticCost([1.0] * 14, [1.0] * 4, [1.0] * 14)
    held = VehicleBody.of(Problem(QuadrotorPlanning(), cost, [body], rest, 3))
    ball = Ball(np.array([2.0, 1.0, 0.0]), 0.3, np.zeros(3))
    drawn = Course((ball,), np.array([6.0, 0.0, 0.0]), 0.5, vehicle_radius=0.2, body=held)
    states = pd.DataFrame({f"x{i}": np.zeros(9) for i in range(13)} | {"t": PERIOD * np.arange(9)})
    states["x0"], states["x6"] = 0.5 * np.arange(9), 1.0
    track = drawn.track(states)
    assert drawn.nearness(track, states["t"].to_numpy()).min() == pytest.approx(0.4 / 0.5)
    (place,) = drawn.contacts(track, PERIOD)
    assert place == pytest.approx([2.0, 0.0, 0.0], abs=0.1)
    states["x6"], states["x9"] = np.cos(np.pi / 4), -np.sin(np.pi / 4)
    ahead = drawn.track(states)
    assert drawn.nearness(ahead, states["t"].to_numpy()).min() == pytest.approx(1.0 / 0.5, abs=0.05)
    assert len(drawn.contacts(ahead, PERIOD)) == 0
    assert drawn.limits(track)[0][1] <= -0.8, "the whole body is in the picture"
    plans = np.zeros((9, KNOTS, 3))
    (ax, *_) = panels_of(missions.snapshots_figure(states, plans, drawn, [4], PERIOD))
    (shape,) = [c for c in ax.collections if isinstance(c, PolyCollection) and len(c.get_paths()) == 2]
    centers = [path.get_extents().get_points().mean(axis=0) for path in shape.get_paths()]
    np.testing.assert_allclose(centers, [[2.6, 0.0], [2.0, 0.0]], atol=1e-6)


def panels_of(figure: Figure) -> list[Axes]:
    return [ax for ax in figure.axes if ax.get_label() != "<colorbar>"]


def curve(ax: Axes, i: int) -> np.ndarray:
    return np.asarray(ax.lines[i].get_ydata(), dtype=float)


def test_times_are_in_milliseconds_beside_the_period(frame: pd.DataFrame) -> None:
    figure = missions.compute_figure({"gco": frame, "al_ilqr": frame.iloc[:3]}, PERIOD)
    first, second = figure.axes
    assert curve(first, 0).tolist() == pytest.approx((1e3 * frame["planner_seconds"]).tolist())
    assert curve(first, 1).tolist() == pytest.approx([5.0] * STEPS)
    assert curve(first, 2)[0] == pytest.approx(50.0)
    assert first.get_title("left") == "gco: 1 of 12 steps above the period"
    assert second.get_title("left") == "al_ilqr: 0 of 3 steps above the period"
    bands = [patch for patch in first.patches if isinstance(patch, Rectangle)]
    assert [(band.get_x(), band.get_width()) for band in bands] == [pytest.approx((0.15, PERIOD))]
    assert second.get_xlabel() == "time in the mission [s]" and "[ms]" in first.get_ylabel()


def test_distances_are_shares_of_both_radii_and_follow_moving_spheres(frame: pd.DataFrame) -> None:
    x, t = frame["x0"].to_numpy(), frame["t"].to_numpy()
    for speed in (0.0, 2.0):
        figure = missions.distance_figure({"gco": frame}, course(speed))
        expected = np.hypot(x - 2.0, 1.0 - speed * t) / 0.5
        assert curve(figure.axes[0], 0) == pytest.approx(expected)
        assert [curve(figure.axes[0], i)[0] for i in (2, 3)] == [1.0, 0.95]
    ends = np.asarray(figure.axes[1].lines[1].get_xydata())
    assert ends.tolist() == [pytest.approx([t[-1], expected[-1]])]


def test_nothing_is_near_without_obstacles(frame: pd.DataFrame) -> None:
    empty = Course((), np.zeros(3), 0.5)
    assert np.isinf(empty.nearness(np.zeros((2, 3)), np.zeros(2))).all()
    assert missions.distance_figure({"gco": frame}, empty).axes


def test_a_map_is_cut_where_the_vehicle_is(frame: pd.DataFrame, plans: np.ndarray) -> None:
    """A wall of cells in x from 4 to 4.4 with a window in y from -1 to 1 and z from -0.6 to 0.6."""
    cells = np.zeros((40, 20, 20), bool)
    cells[20:22] = True
    cells[20:22, 5:15, 7:13] = False
    grid = OccupancyGrid(cells, [0.0, -2.0, -2.0], 0.2)
    walled = Course((), np.array([6.0, 0.0, 0.0]), 0.5, 0.2, DistanceField.of(grid))
    near = walled.nearness(np.array([[4.2, 0.0, 0.3], [3.5, 1.5, 0.0], [4.2, 1.5, 0.0]]), np.zeros(3))
    assert near[:2] == pytest.approx([0.3 / 0.2, 0.5 / 0.2], abs=0.4) and near[2] < 0.5
    assert walled.infeasible(np.array([[4.2, 1.5, 0.0], [2.0, 0.0, 0.0]]), np.zeros(2)).tolist() == [True, False]
    above, side = panels_of(missions.snapshots_figure(frame, plans, walled, [3], PERIOD))
    for ax in (above, side):  # both cut through the window: the wall is filled on both sides of it, and not within
        (filled,) = [one for one in ax.collections if isinstance(one, QuadContourSet) and one.filled]
        (path,) = filled.get_paths()
        inside = path.contains_points([[4.2, 1.6], [4.2, -1.6], [4.2, 0.0], [3.0, 0.0]])
        assert inside.tolist() == [True, True, False, False]


def test_snapshots_show_plan_track_and_obstacles_of_their_own_time(frame: pd.DataFrame, plans: np.ndarray) -> None:
    figure = missions.snapshots_figure(frame, plans, course(2.0), [0, 6], PERIOD)
    above = panels_of(figure)[2]
    assert above.get_title("left") == "0.30 s, from above"
    (vehicle,) = [patch for patch in above.patches if isinstance(patch, Circle)]
    assert vehicle.center == (3.0, 0.0) and vehicle.get_radius() == 0.2
    obstacle = above.collections[0].get_paths()[0].get_extents()
    assert (obstacle.x0 + obstacle.x1) / 2 == pytest.approx(2.0)
    assert (obstacle.y0 + obstacle.y1) / 2 == pytest.approx(1.0 - 2.0 * 0.3)
    assert obstacle.height / 2 == pytest.approx(0.3)  # without the vehicle
    flown = [line for line in above.lines if len(np.asarray(line.get_xdata())) == 7]
    assert np.asarray(flown[0].get_xdata()).tolist() == (0.5 * np.arange(7)).tolist()
    assert {ax.get_ylabel() for ax in panels_of(figure)} == {"y [m]", "z [m]"}


def test_a_wall_is_cut_where_the_vehicle_is(frame: pd.DataFrame, plans: np.ndarray) -> None:
    """Distances count from its sides; from the side its opening is seen while the vehicle is in front of it."""
    half, sides = np.array([0.2, 4.0, 1.0]), np.eye(3)
    over, under = (Box(np.array([4.0, 0.0, z]), half, sides) for z in (-1.5, 1.5))
    beyond = Box(np.array([4.0, 9.0, 0.0]), np.array([0.2, 5.0, 2.0]), sides)
    wall = Course((over, under, beyond), np.array([6.0, 0.0, 0.0]), 0.5, vehicle_radius=0.2)
    near = wall.nearness(np.array([[4.0, 0.0, 0.3], [3.5, 0.0, 0.6]]), np.zeros(2))
    assert near == pytest.approx([0.2 / 0.2, 0.3 / 0.2])
    above, side = panels_of(missions.snapshots_figure(frame, plans, wall, [3], PERIOD))
    heights = [path.get_extents().bounds for path in side.collections[0].get_paths()]
    assert heights == [pytest.approx((3.8, z, 0.4, 2.0)) for z in (-2.5, 0.5)]
    (left,) = above.collections[0].get_paths()
    assert left.get_extents().bounds == pytest.approx((3.8, 4.0, 0.4, 10.0)), "at its height only the wall beyond"


@pytest.mark.parametrize(("speed", "expected"), [(0.0, []), (5.0, [2.0])])
def test_crosses_mark_knots_that_meet_a_sphere_at_their_own_time(
    frame: pd.DataFrame, plans: np.ndarray, speed: float, expected: list[float]
) -> None:
    # Knot j of plan 2 is at x = 1 + j / 2 at 0.1 + 0.05 j s; the moving sphere is at y = 0.5 - 0.25 j then.
    figure = missions.snapshots_figure(frame, plans, course(speed), [2], PERIOD)
    lines = [line for line in panels_of(figure)[0].lines if line.get_marker() == "x"]
    assert [x for line in lines for x in np.asarray(line.get_xdata()).tolist()] == expected


def test_speeds_and_thrusts_have_their_limits(frame: pd.DataFrame) -> None:
    body = Airframe()
    speeds, thrusts = missions.commands_figure(frame).axes
    assert [curve(speeds, i)[0] for i in range(4)] == [5001.0, 5002.0, 5003.0, 5004.0]
    assert [curve(thrusts, i)[0] for i in range(4)] == [4.0, 5.0, 6.0, 7.0]
    assert [curve(thrusts, i)[0] for i in (4, 5)] == [body.thrust_min, body.thrust_max]
    assert body.thrust_coefficient * curve(speeds, 5)[0] ** 2 == pytest.approx(body.thrust_max)
    assert "[rpm]" in speeds.get_ylabel() and "[N]" in thrusts.get_ylabel()


def test_commands_between_control_steps_are_a_band(frame: pd.DataFrame) -> None:
    assert not missions.commands_figure(frame).axes[0].collections
    ends = {
        f"u{i}_{end}": np.full(STEPS, value) for i in range(1, 5) for end, value in (("low", 2000.0), ("high", 6e3))
    }
    speeds, thrusts = missions.commands_figure(frame.assign(**ends)).axes
    heights = [path.vertices[:, 1] for band in speeds.collections for path in band.get_paths()]
    assert [(held.min(), held.max()) for held in heights] == [(2000.0, 6000.0)] * 4 and not thrusts.collections


def test_states_have_their_targets_and_angles_are_in_degrees(frame: pd.DataFrame) -> None:
    frame["x6"], frame["x9"] = np.cos(np.pi / 8), np.sin(np.pi / 8)  # 45 degrees about z
    axes = missions.states_figure(frame, np.array([6.0, 1.0, 2.0])).axes
    assert [curve(ax, 0)[0] for ax in axes] == [6.0, 1.0, 2.0, 0.0, 0.0, 0.0]
    assert curve(axes[0], 1).tolist() == frame["x0"].tolist()
    assert curve(axes[3], 1)[0] == 10.0
    assert [curve(axes[4], i)[0] for i in (1, 2, 3)] == pytest.approx([0.0, 0.0, 45.0])
    labels = [ax.get_ylabel().split("[")[1] for ax in axes]
    assert labels == ["m]", "m]", "m]", "m/s]", "deg]", "rad/s]"]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_about_one_axis_is_one_euler_angle(axis: int) -> None:
    q = np.zeros((4, 1))
    q[0], q[1 + axis] = 2 * np.cos(0.2), 2 * np.sin(0.2)  # of any length
    expected = np.zeros(3)
    expected[axis] = 0.4
    assert missions.euler_angles(q)[:, 0] == pytest.approx(expected)


def test_tracking_violations_of_zero_stay_on_the_logarithmic_axis(frame: pd.DataFrame) -> None:
    above, below = missions.tracking_figure(frame).axes
    assert above.get_yscale() == "log" and "[N]" in above.get_ylabel()
    assert curve(above, 0)[:2].tolist() == [1e-16, 1e-9]
    assert curve(below, 0) == pytest.approx(5.0)
    (alone,) = missions.tracking_figure(frame, "time").axes
    assert curve(alone, 0) == pytest.approx(5.0)


def test_shares_of_outcomes_add_up_and_missions_without_one_do_not_count() -> None:
    names = ["REACHED"] * 6 + ["COLLISION"] * 3 + ["DIVERGED"]
    rows = [("gco", name) for name in names] + [("gco", None), ("al_ilqr", "TIMEOUT")]
    trials = pd.DataFrame(rows, columns=["solver", "outcome"]).assign(scenario="forest", model="quadrotor")
    (ax,) = missions.outcomes_figure(trials).axes
    found = [(b.get_y() + b.get_height() / 2, b.get_x(), b.get_width()) for b in ax.patches]  # type: ignore[attr-defined]
    assert found == [pytest.approx(bar) for bar in ((0, 0, 0.6), (0, 0.6, 0.3), (0, 0.9, 0.1), (1, 0, 1))]
    colours = [to_hex(bar.get_facecolor()).upper() for bar in ax.patches]
    ends = (Outcome.REACHED, Outcome.COLLISION, Outcome.DIVERGED, Outcome.TIMEOUT)
    assert colours == [missions.ENDS[end] for end in ends]
    assert [text.get_text() for text in ax.texts] == ["6", "3", "1", "n = 10", "1", "n = 1"]
    assert [tick.get_text() for tick in ax.get_yticklabels()] == ["gco", "al_ilqr"]


def test_wrong_input_is_refused(frame: pd.DataFrame, plans: np.ndarray) -> None:
    two = pd.concat([frame, frame.assign(mission=8)])
    calls = {
        "frame": lambda: missions.tracking_figure(frame.drop(columns="tracking_violation")),
        "missions": lambda: missions.commands_figure(two),
        "steps": lambda: missions.snapshots_figure(frame, plans, course(), [STEPS], PERIOD),
        "plans": lambda: missions.snapshots_figure(frame, plans[:3], course(), [0], PERIOD),
        "outcome": lambda: missions.outcomes_figure(pd.DataFrame({"outcome": ["LOST"], "solver": ["gco"]})),
        "course.goal": lambda: Course((), np.zeros(2), 0.5),
    }
    for word, call in calls.items():
        with pytest.raises(InputError, match=word):
            call()
