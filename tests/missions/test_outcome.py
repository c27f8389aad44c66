"""The judge of flights against dense sampling, and the tables of flights against direct sums."""

import math

import numpy as np
import pandas as pd
import pytest
import torch

from tests.missions.missions import DT, REST, mission
from tests.missions.test_mission import NAMES, RADII, ends, six
from torchgco import Airframe, Problem, QuadraticCost, QuadrotorPlanning, Spheres
from torchgco.missions.contact import Contact
from torchgco.missions.log import MissionLog
from torchgco.missions.outcome import (
    Ending,
    Outcome,
    ending,
    energy,
    judge_flight,
    mission_frame,
    mission_row,
    samples,
    time_step_frame,
)

PER_SEGMENT = 200  # points between two samples of the dense judge
FRAME = Airframe()
Flight = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


def dense(
    t: np.ndarray,
    position: np.ndarray,
    centers: np.ndarray,
    contact: np.ndarray,
    velocities: np.ndarray,
    goal: np.ndarray,
    radius: float,
) -> tuple[Outcome, float, float]:
    """Outcome, time and clearance of a flight, at many points of every segment; NaN spheres are absent."""
    clearance = math.inf
    for k in range(len(t)):
        if np.isnan(position[k]).any() or math.dist(position[k], position[0]) > 1e3:
            return Outcome.DIVERGED, t[k], clearance
        for s in np.linspace(0.0, 1.0, PER_SEGMENT) if k > 0 else [1.0]:
            i = max(k - 1, 0)
            p, now = (1 - s) * position[i] + s * position[k], (1 - s) * t[i] + s * t[k]
            for o, r, v in zip(centers, contact, velocities, strict=True):
                if not math.isnan(r):
                    clearance = min(clearance, math.dist(p, o + now * v) - r)
        if clearance < 0:
            return Outcome.COLLISION, t[k], clearance
        if math.dist(position[k], goal) < radius:
            return Outcome.REACHED, t[k], clearance
    return Outcome.TIMEOUT, t[-1], clearance


def drawn(seed: int) -> Flight:
    """A flight towards a goal among three spheres; every other one with spheres at rest, some are lost on the way."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(15)
    position = np.cumsum(rng.normal([0.25, 0.0, 0.0], 0.08, (15, 3)), axis=0)
    if seed % 5 == 0:
        position[rng.integers(4, 14) :] = np.nan if seed % 10 else 2e3
    centers = rng.uniform([-0.2, -1.4, -1.4], [3.4, 1.4, 1.4], (3, 3))
    contact, velocities = rng.uniform(0.1, 0.6, 3), rng.normal(0.0, 0.5, (3, 3)) * (seed % 2)
    if seed % 3 == 0:
        centers[2], contact[2], velocities[2] = np.nan, np.nan, np.nan
    return t, position, centers, contact, velocities, np.array([2.6, 3.0 * (seed % 4 == 1), 0.0]), 0.5


def among(centers: np.ndarray, contact: np.ndarray, velocities: np.ndarray | None) -> Contact:
    """The obstacles of a flight among spheres that are touched at distances `contact` (M,) from their centres, m."""
    centers, radii, moves = (
        None if part is None else torch.from_numpy(part)[None] for part in (centers, contact / 0.95, velocities)
    )
    rest = torch.tensor([REST], dtype=torch.float64)
    cost = QuadraticCost([1.0] * 14, [1.0] * 4, [1.0] * 14)
    return Contact.among(Problem(QuadrotorPlanning(dt=0.1), cost, [Spheres(centers, radii, 0.0, moves)], rest, 5))


def judged(
    t: np.ndarray,
    position: np.ndarray,
    centers: np.ndarray,
    contact: np.ndarray,
    velocities: np.ndarray | None,
    goal: np.ndarray,
    radius: float,
) -> Ending:
    return judge_flight(position, float(t[1] - t[0]), among(centers, contact, velocities), goal, radius)


@pytest.mark.slow
def test_random_flights_are_judged_as_by_dense_sampling() -> None:
    seen = []
    for seed in range(80):
        flight = drawn(seed)
        outcome, time, clearance = dense(*flight)
        end = judged(*flight)
        if abs(clearance) < 2e-4 or abs(end.clearance) < 2e-4:  # dense sampling can't tell
            continue
        assert (end.outcome, end.flight_time) == (outcome, pytest.approx(time)), seed
        assert clearance - 2e-3 <= end.clearance <= clearance + 1e-12
        if seed % 2 == 0:  # at rest: without velocities, too
            t, position, centers, contact, _, goal, radius = flight
            assert judged(t, position, centers, contact, None, goal, radius).clearance == end.clearance
        if outcome != Outcome.DIVERGED:
            last = int(np.searchsorted(flight[0], time - 1e-9))
            assert end.goal_distance == pytest.approx(math.dist(flight[1][last], flight[5]))
        seen.append(outcome)
    assert len(seen) > 70 and all(seen.count(outcome) >= 5 for outcome in Outcome)


def straight(speed: float, steps: int = 10) -> tuple[np.ndarray, np.ndarray]:
    t = 0.1 * np.arange(steps + 1)
    return t, np.outer(t, [speed, 0.0, 0.0])


def test_contact_between_samples_is_seen() -> None:
    t, position = straight(2.0)  # samples at 0.4 m and 0.6 m
    center, far = np.array([[0.5, 0.0, 0.0]]), np.array([9.0, 0.0, 0.0])
    end = judged(t, position, center, np.array([0.05]), None, far, 0.1)
    assert (end.outcome, end.flight_time) == (Outcome.COLLISION, pytest.approx(0.3))
    assert end.clearance == pytest.approx(-0.05)
    beside = judged(t, position, center + np.array([0.0, 0.06, 0.0]), np.array([0.05]), None, far, 0.1)
    assert (beside.outcome, beside.clearance) == (Outcome.TIMEOUT, pytest.approx(0.01))
    falling = np.array([[0.0, -0.75, 0.0]])
    moving = judged(t, position, center + np.array([0.3, 0.3, 0.0]), np.array([0.05]), falling, far, 0.1)
    assert moving.outcome == Outcome.COLLISION and moving.flight_time == pytest.approx(0.4)


def test_contact_comes_before_the_goal() -> None:
    t, position = straight(1.0)
    goal, center = np.array([0.5, 0.0, 0.0]), np.array([[0.45, 0.0, 0.0]])
    none = np.zeros((0, 3)), np.zeros(0)
    free = judged(t, position, *none, None, goal, 0.15)
    assert (free.outcome, free.flight_time) == (Outcome.REACHED, pytest.approx(0.4))
    assert free.clearance == math.inf and free.goal_distance == pytest.approx(0.1)
    end = judged(t, position, center, np.array([0.06]), None, goal, 0.11)
    assert end.outcome == Outcome.COLLISION  # at 0.39 m, before the sample at 0.4 m is near enough to the goal
    assert all(outcome.sentence.endswith(".") for outcome in Outcome)


def test_a_state_that_is_not_finite_ends_a_mission_wherever_it_is(flights: tuple[MissionLog, list[Ending]]) -> None:
    """Body rates, say; and control steps count although no plan was found for them."""
    log, _ = flights
    arrays, contact, goal = log.arrays(), Contact(()), np.array([9.0, 0.0, 0.0])
    arrays |= {name: arrays[name].copy() for name in ("x", "cost")}
    arrays["cost"][2, 3:] = np.nan
    assert ending(arrays, 2, DT, contact, goal, 0.1).flight_time == pytest.approx(6 * DT)
    arrays["x"][2, 3, 2:, 11] = np.nan
    end = ending(arrays, 2, DT, contact, goal, 0.1)
    assert (end.outcome, end.flight_time) == (Outcome.DIVERGED, pytest.approx(3 * DT + 0.02))


def own_ends(log: MissionLog) -> list[float]:
    """When the simulation ended each mission, s: from then on its state stands still."""
    dt, found = log.period / log.commands.shape[2], []
    arrays = log.arrays()
    for b in range(len(log.x)):
        _, x = samples(arrays, b, log.period)
        still = np.nan_to_num(x, nan=9e9)
        last = len(x) - 1
        while last > 0 and (still[last] == still[last - 1]).all():
            last -= 1
        found.append(last * dt)
    return found


def test_the_simulations_own_end_is_the_judges() -> None:
    problem, flown = six()
    log = flown.fly(problem)
    for name, own, end in zip(NAMES, own_ends(log), ends(log, problem, RADII), strict=True):
        assert own == pytest.approx(end.flight_time), name


def test_energy_is_the_sum_of_torque_times_speed() -> None:
    rng = np.random.default_rng(0)
    t, x = np.cumsum(rng.uniform(0.005, 0.02, 30)), rng.uniform(0.2, 5.0, (30, 17))
    x[4, 14] = -1.0  # counts as no thrust
    power = []
    for row in x:
        watts = 0.0
        for F in row[13:]:
            speed = math.sqrt(max(F, 0.0) / FRAME.thrust_coefficient) * 2 * math.pi / 60
            watts += FRAME.rotor_torque * max(F, 0.0) * speed
        power.append(watts)
    direct = sum(0.5 * (power[k] + power[k + 1]) * (t[k + 1] - t[k]) for k in range(29))
    assert energy(t, x, FRAME) == pytest.approx(direct, rel=1e-12)
    hover = np.tile(FRAME.mass * 9.81 / 4, (11, 17))  # 5000 rpm
    watts = FRAME.rotor_torque * FRAME.mass * 9.81 * 5000 * 2 * math.pi / 60
    assert energy(0.1 * np.arange(11), hover, FRAME) == pytest.approx(watts, rel=1e-12)


@pytest.fixture(scope="module")
def flights() -> tuple[MissionLog, list[Ending]]:
    problem, flown = six()
    log = flown.fly(problem)
    return log, ends(log, problem, RADII)


def test_a_row_per_mission_and_control_step(flights: tuple[MissionLog, list[Ending]]) -> None:
    log, _ = flights
    clearances = np.arange(6) + 0.5 + np.zeros((6, 1))
    table = mission_frame(log.arrays(), [10, 11, 12, 13, 14, 15], DT, clearances)
    assert list(table.columns) == [
        "mission", "step", "t", *(f"x{i}" for i in range(17)), "cost", "violation", "f1", "f2", "f3", "f4",
        *(f"u{i}{end}" for end in ("", "_low", "_high") for i in range(1, 5)), "clearance", "planner_seconds",
        "tracker_seconds", "tracking_violation", "guided", "source",
    ]  # fmt: skip
    assert table.groupby("mission").size().to_dict() == {10 + b: K for b, K in enumerate(log.steps()) if K > 0}
    row = table[(table["mission"] == 12) & (table["step"] == 3)].iloc[0]
    assert row["t"] == pytest.approx(0.15) and row["clearance"] == 3.5 and row["source"] == "solved"
    np.testing.assert_array_equal(row[[f"x{i}" for i in range(17)]].to_numpy(float), log.x[2, 3, 0].numpy())
    np.testing.assert_array_equal(row[["f1", "f2", "f3", "f4"]].to_numpy(float), log.x[2, 3, 0, 13:].numpy())
    np.testing.assert_array_equal(row[["u1", "u2", "u3", "u4"]].to_numpy(float), log.commands[2, 3, 0].numpy())
    assert row["cost"] == float(log.cost[2, 3]) and table["guided"].dtype.kind == "i"
    kept = (log.shifted == 1).nonzero().tolist()
    log.shifted[2, 3] = 1.0
    changed = mission_frame(log.arrays(), range(6), DT, clearances)
    log.shifted[2, 3] = 0.0
    assert changed[changed["source"] == "shifted"][["mission", "step"]].to_numpy().tolist() == sorted([*kept, [2, 3]])
    assert not table.drop(columns="source").isna().to_numpy().any()


def test_a_control_step_shows_all_of_its_commands(flights: tuple[MissionLog, list[Ending]]) -> None:
    log, _ = flights
    arrays = log.arrays()
    clearances = np.zeros((6, 6))
    table = mission_frame(arrays, range(6), DT, clearances).set_index(["mission", "step"])
    for (b, k), row in table.iterrows():  # type: ignore[misc]
        u = arrays["commands"][b, k]
        u = u[~np.isnan(u).any(-1)]
        assert row[[f"u{i}_low" for i in range(1, 5)]].tolist() == u.min(0).tolist()
        assert row[[f"u{i}_high" for i in range(1, 5)]].tolist() == u.max(0).tolist()
    assert (table["u1_low"] < table["u1"]).any() and (table["u1_high"] > table["u1"]).any()


def test_a_row_per_time_step_until_a_mission_ends(flights: tuple[MissionLog, list[Ending]]) -> None:
    log, found = flights
    table = time_step_frame(log.arrays(), range(6), DT, FRAME)
    for b, end in enumerate(found):
        rows = table[table["mission"] == b]
        assert len(rows) == round(100 * end.flight_time) + 1 and rows["t"].iloc[-1] == pytest.approx(end.flight_time)
        steps = len(rows) - 1
        x = torch.cat((log.x[b, :1, 0], log.x[b, :, 1:].flatten(0, 1)))[: steps + 1].numpy()
        np.testing.assert_array_equal(rows[[f"x{i}" for i in range(17)]].to_numpy(), x)
        np.testing.assert_array_equal(rows[["f1", "f2", "f3", "f4"]].to_numpy(), x[:, 13:])
        u = log.commands[b].flatten(0, 1)[:steps].numpy()
        np.testing.assert_array_equal(rows[["u1", "u2", "u3", "u4"]].to_numpy()[:-1], u)
        applied = FRAME.reachable(torch.from_numpy(u)).numpy()
        np.testing.assert_array_equal(rows[["r1", "r2", "r3", "r4"]].to_numpy()[:-1], applied)
        assert np.isfinite(u).all()


def test_commands_after_a_mission_has_ended_are_not_in_the_log(flights: tuple[MissionLog, list[Ending]]) -> None:
    log, found = flights
    assert any(round(100 * end.flight_time) % 5 > 0 for end in found), "one that ends within a control period"
    for b, end in enumerate(found):
        commanded = torch.isfinite(log.commands[b]).all(-1).flatten()
        assert int(commanded.sum()) == round(100 * end.flight_time) and bool(commanded[: int(commanded.sum())].all())


def test_the_columns_of_a_mission(flights: tuple[MissionLog, list[Ending]]) -> None:
    log, found = flights
    arrays = log.arrays()
    arrays["planner_seconds"] = np.where(np.isnan(arrays["planner_seconds"]), np.nan, 0.01)
    arrays["planner_seconds"][2, 1], arrays["planner_seconds"][2, 2] = 0.06, 0.03
    arrays["tracker_seconds"] = np.where(np.isnan(arrays["tracker_seconds"]), np.nan, 0.01)
    rows = pd.DataFrame([mission_row(arrays, b, DT, found[b], FRAME) for b in range(6)], index=NAMES)
    assert rows["outcome"].tolist() == [end.outcome.name for end in found]
    assert rows["missed_deadlines"].tolist() == [0, 0, 1, 0, 0, 0]
    assert rows["shifted_plans"].tolist() == (log.shifted == 1).sum(-1).tolist()
    timeout = rows.loc["timeout"]
    assert timeout["planner_seconds_median"] == pytest.approx(0.01) and timeout["tracker_seconds_median"] == 0.01
    assert timeout["planner_seconds_p99"] == pytest.approx(np.quantile([0.01] * 4 + [0.03, 0.06], 0.99))
    assert timeout["tracking_violation"] == pytest.approx(float(log.tracking_violation[2].max()))
    t, x = samples(arrays, 1, DT)
    until = round(found[1].flight_time / 0.01) + 1
    assert rows.loc["collision", "energy"] == pytest.approx(energy(t[:until], x[:until], FRAME))
    assert rows.loc["in contact", "energy"] == 0.0 and math.isnan(float(rows.loc["in contact", "planner_seconds_p99"]))


def test_a_vehicle_far_from_the_origin_has_not_diverged() -> None:
    """A kilometre counts from the start of each mission."""
    problem, _ = six()
    away = problem.take(torch.tensor([2]))
    x0 = away.x0.clone()
    x0[:, 0] += 5e3
    shifted = away.started_at(x0, away.constraints)
    assert mission(duration=0.1).fly(shifted).steps().tolist() == [2]
