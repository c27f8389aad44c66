"""How flights ended, judged from the log of the plant alone, and flights as tables: a row per step and per mission.

A flight ends with the first of three events: the vehicle touches an obstacle (COLLISION), its state is no longer finite
or leaves all reason (DIVERGED), or it comes within the goal's radius (REACHED), in a race once all gates are passed.
Without any it ends with TIMEOUT.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchgco.base.errors import InputError
from torchgco.base.options import Meters, Seconds, check_value
from torchgco.dynamics.quadrotor import Airframe
from torchgco.missions.contact import Contact, Passing
from torchgco.missions.log import TIMED_PARTS, MissionLog
from torchgco.problem.problem import Problem

FARTHEST = 1e3  # m from the start: a vehicle beyond has diverged


class Outcome(IntEnum):
    """The four ends of a mission; `sentence` explains each."""

    REACHED = 0
    COLLISION = 1
    TIMEOUT = 2
    DIVERGED = 3

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Outcome.REACHED: "The vehicle came within the goal's radius, without contact before.",
    Outcome.COLLISION: "The vehicle touched an obstacle.",
    Outcome.TIMEOUT: "The time was over before the vehicle came within the goal's radius.",
    Outcome.DIVERGED: "The state became non-finite, or the vehicle left for more than a kilometre.",
}


@dataclass(frozen=True)
class Ending:
    """How one flight ended."""

    outcome: Outcome
    flight_time: float  # s, until the event, or of the whole log
    clearance: float  # m, smallest distance to where bodies touch, between samples too; infinite without obstacles
    goal_distance: float  # m, at the end
    gates_passed: int | None = None  # in their order, between samples too; None without gates
    gate_distance: float | None = None  # m, largest of the least distances from the middles of these and the next one


def judge_flight(
    x: Any, dt: float, contact: Contact, goal: Any, goal_radius: float, gates: Passing | None = None
) -> Ending:
    """Judge one flight.

    Args:
        x: samples (T, 17) of the plant's state, one every dt, s, or where no vehicle has a `Body` of its positions
            (T, 3), m; after the flight's end NaN.
        contact, gates: of a single problem.
        goal, goal_radius: (3,) and a number above 0, m.

    Raises:
        InputError: arrays of other shapes, without a sample, or of anything but numbers; a radius or a time step that
            isn't above 0.
    """
    x, goal = _numbers(x, "x", (None, None)), _numbers(goal, "goal", (3,))
    if x.shape[1] not in (3, 17):
        raise InputError("x", "positions (T, 3) or states (T, 17)", x.shape)
    position = x[:, :3]
    check_value(goal_radius, Meters, "goal_radius")
    check_value(dt, Seconds, "dt")
    if len(position) == 0:
        raise InputError("x", "at least one sample", "none")
    with np.errstate(invalid="ignore"):
        lost = ~(np.linalg.norm(position - position[0], axis=-1) <= FARTHEST)
    there = np.linalg.norm(position - goal, axis=-1) < goal_radius
    if gates is not None:
        when, _ = gates.along(torch.from_numpy(position[~lost].astype(float)))
        there &= np.arange(len(there)) >= int(when.max())
    last = int(np.argmax(lost | there)) if (lost | there).any() else len(position) - 1
    way = torch.from_numpy(x[None, : last + (not lost[last])].astype(float))

    def clearance(samples: int) -> float:
        return float(contact.along(way[:, :samples], dt)) if samples else np.inf

    outcome = Outcome.DIVERGED if lost[last] else Outcome.REACHED if there[last] else Outcome.TIMEOUT
    samples = way.shape[1]
    if clearance(samples) < 0:  # the first sample by which there was contact
        samples = 1 + bisect_left(range(1, samples), True, key=lambda count: clearance(count) < 0)
        outcome, last = Outcome.COLLISION, samples - 1
    distance = float("nan") if outcome is Outcome.DIVERGED else float(np.linalg.norm(position[last] - goal))
    ending = Ending(outcome, last * dt, clearance(samples), distance)
    if gates is None:
        return ending
    when, away = gates.along(way[0, :samples, :3])
    return replace(ending, gates_passed=int((when < samples).sum()), gate_distance=float(away[away.isfinite()].max()))


def _numbers(value: Any, field: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """`value` as an array of numbers of this shape; None stands for any length."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        array = np.empty((), object)
    fits = len(shape) == array.ndim and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "iuf":
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise InputError(field, f"numbers of shape ({wanted})", f"{array.dtype} of shape {array.shape}")
    return array


if TYPE_CHECKING:
    import pandas as pd

Arrays = Mapping[str, np.ndarray]
LOG_SCALARS = (
    "cost", "violation", "shifted", "guided", "iterations", "planner_seconds", "tracker_seconds", "tracking_violation",
)  # fmt: skip
SENSED = (*TIMED_PARTS, "safe")  # further ones, of missions with a sensor: safe is 1 where the period held a safe plan
STATES, ROTOR_COUNT = 17, 4


def packed(arrays: Arrays) -> np.ndarray:
    """The arrays of B missions as one (B, K, W), a row per control step; planned positions come last, if they do."""
    B, K = arrays["cost"].shape
    more = SENSED if "safe" in arrays else ()
    names = ("x", "commands", *LOG_SCALARS, *more, *(["plan"] if "plan" in arrays else []))
    return np.concatenate([arrays[name].reshape(B, K, -1) for name in names], axis=-1)


def unpacked(rows: np.ndarray, substeps: int, sensed: bool = False) -> dict[str, np.ndarray]:
    """The arrays that `packed` made of logs with so many time steps per control step, with a sensor or without."""
    B, K, J = *rows.shape[:2], substeps
    names = (*LOG_SCALARS, *(SENSED if sensed else ()))
    widths = [(J + 1) * STATES, J * ROTOR_COUNT, *[1] * len(names)]
    x, commands, *scalars, plan = np.split(rows, np.cumsum(widths), axis=-1)
    arrays = {name: column[..., 0] for name, column in zip(names, scalars, strict=True)}
    arrays |= {"x": x.reshape(B, K, J + 1, STATES), "commands": commands.reshape(B, K, J, ROTOR_COUNT)}
    return arrays | ({"plan": plan.reshape(B, K, -1, 3)} if plan.shape[-1] else {})


def clearances(arrays: Arrays, period: float, contact: Contact) -> np.ndarray:
    """Distances (B, K) of missions from contact at the starts of their control steps, m; NaN after their ends."""
    distances = contact.distances(torch.from_numpy(arrays["x"][:, :, 0]), period).numpy()
    return np.where(np.isnan(arrays["planner_seconds"]), np.nan, distances)


def gates_passed(arrays: Arrays, gates: Passing) -> np.ndarray:
    """How many gates missions have passed by the starts of their control steps, between time steps too, (B, K)."""
    B, K, J = arrays["commands"].shape[:3]
    starts, counts = J * np.arange(K), []
    for b in range(B):
        _, x = samples(arrays, b, 1.0)
        when, _ = gates.take(slice(b, b + 1)).along(torch.from_numpy(x[np.isfinite(x).all(-1), :3]))
        counts.append((when.numpy() <= starts[:, None]).sum(-1))
    return np.stack(counts)


def mission_frame(
    arrays: Arrays, ids: Sequence[int], period: float, clearances: np.ndarray, passed: np.ndarray | None = None
) -> pd.DataFrame:
    """A row per mission and control step.

    Args:
        arrays: see `MissionLog.arrays`.
        ids: numbers of the missions; period: of a control step, s.
        clearances: (B, K), at the starts of control steps, m.
        passed: see `gates_passed`; None: missions without gates.

    Commands `u1` to `u4` are the first of a control step; `u1_low` and `u1_high` the least and the largest of it.
    """
    import pandas as pd

    frames = []
    for b, number in enumerate(ids):
        K = _steps(arrays, b)
        x = arrays["x"][b, :K, 0]
        columns = {"mission": np.full(K, number), "step": np.arange(K), "t": period * np.arange(K)}
        columns |= {f"x{i}": x[:, i] for i in range(x.shape[1])}
        columns |= {name: arrays[name][b, :K] for name in ("cost", "violation")}
        columns |= {f"f{i + 1}": x[:, 13 + i] for i in range(4)}
        columns |= _commands(arrays["commands"][b, :K])
        columns |= {"clearance": clearances[b][:K]}
        columns |= {} if passed is None else {"gates_passed": passed[b][:K]}
        columns |= {name: arrays[name][b, :K] for name in ("planner_seconds", "tracker_seconds", "tracking_violation")}
        columns |= {"guided": arrays["guided"][b, :K].astype(int)}
        columns |= {name: arrays[name][b, :K] for name in SENSED if name in arrays}
        columns |= {"source": np.where(arrays["shifted"][b, :K] == 1, "shifted", "solved")}
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def _commands(u: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of commands (K, J, 4), rpm, NaN after a mission's end: the first of each control step and their range."""
    parts = {"": u[:, 0], "_low": np.fmin.reduce(u, axis=1), "_high": np.fmax.reduce(u, axis=1)}
    return {f"u{i + 1}{end}": values[:, i] for end, values in parts.items() for i in range(ROTOR_COUNT)}


def time_step_frame(arrays: Arrays, ids: Sequence[int], period: float, airframe: Airframe) -> pd.DataFrame:
    """A row per mission and time step of the plant: mission, t, states, thrusts, commands, and the speeds they make.

    A command holds from its row to the next one; the last row is the mission's end and repeats the last command.
    Arguments as `mission_frame`.
    """
    import pandas as pd

    low, high = airframe.rotor_speeds
    frames = []
    for b, number in enumerate(ids):
        u = arrays["commands"][b, : _steps(arrays, b)].reshape(-1, ROTOR_COUNT)
        u = u[: int((~np.isnan(u).all(-1)).sum())]  # of a control step in which the mission ends, a part is flown
        t, x = (series[: len(u) + 1] for series in samples(arrays, b, period))
        u = np.concatenate((u, u[-1:] if len(u) else np.full((1, ROTOR_COUNT), np.nan)))
        columns = {"mission": np.full(len(t), number), "t": t} | {f"x{i}": x[:, i] for i in range(STATES)}
        parts = {"f": x[:, 13:], "u": u, "r": u.clip(low, high)}
        columns |= {f"{name}{i + 1}": series[:, i] for name, series in parts.items() for i in range(ROTOR_COUNT)}
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def samples(arrays: Arrays, b: int, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,), s, and states (T, 17) of the plant at all time steps of mission b; at least one."""
    K, J = _steps(arrays, b), arrays["commands"].shape[2]
    x = arrays["x"][b]
    states = np.concatenate((x[0, :1], x[:K, 1:].reshape(K * J, x.shape[-1])))
    return np.arange(K * J + 1) * (period / J), states


def energy(t: np.ndarray, x: np.ndarray, airframe: Airframe) -> float:
    """Shaft work of the rotors over a flight, J: torque k_r F times speed sqrt(F / b), for states x (T, 17)."""
    F = x[:, 13:].clip(min=0.0)
    speed = np.sqrt(F / airframe.thrust_coefficient) * 2.0 * math.pi / 60.0  # rad/s
    return float(np.trapezoid((airframe.rotor_torque * F * speed).sum(-1), t))


def mission_row(arrays: Arrays, b: int, period: float, end: Ending, airframe: Airframe) -> dict[str, object]:
    """The columns of mission b that its log decides, but for its clearance at the starts of control steps."""
    t, x = samples(arrays, b, period)
    until = t <= end.flight_time + 1e-9
    steps = {name: arrays[name][b, : _steps(arrays, b)] for name in (*LOG_SCALARS, *SENSED) if name in arrays}
    raced = end.outcome is Outcome.REACHED
    return {
        "outcome": end.outcome.name,
        "flight_time": end.flight_time,
        "clearance": end.clearance,
        "goal_distance": end.goal_distance,
        **(
            {}
            if end.gates_passed is None
            else {
                "gates_passed": end.gates_passed,
                "gate_distance": end.gate_distance,
                "duration": end.flight_time if raced else math.nan,
            }
        ),
        "energy": energy(t[until], x[until], airframe),
        "iterations": int(steps["iterations"].sum()),
        **step_columns(steps, period),
    }


def step_columns(steps: Arrays, period: float) -> dict[str, float]:
    """The columns of a mission that are counts, sums and quantiles over its control steps.

    Args:
        steps: violation, guided, shifted, planner_seconds, tracker_seconds and tracking_violation, (K,) each; with a
            sensor safe, too.
        period: of a control step, s.
    """
    planner, tracker = steps["planner_seconds"], steps["tracker_seconds"]
    flew = len(planner) > 0
    return {
        "violation": float(steps["violation"].max(initial=0.0)),
        "outer_iterations": len(planner),
        "guided": int((steps["guided"] > 0).sum()),
        "seconds": float((planner + tracker).sum()),
        "missed_deadlines": int((planner + tracker > period).sum()),
        "shifted_plans": int(steps["shifted"].sum()),
        "planner_seconds_median": float(np.median(planner)) if flew else math.nan,
        "planner_seconds_p99": float(np.quantile(planner, 0.99)) if flew else math.nan,
        "tracker_seconds_median": float(np.median(tracker)) if flew else math.nan,
        "tracking_violation": float(steps["tracking_violation"].max(initial=0.0)),
        **({"safe_share": float(np.mean(steps["safe"])) if flew else math.nan} if "safe" in steps else {}),
    }


def ending(
    arrays: Arrays, b: int, period: float, contact: Contact, goal: np.ndarray, goal_radius: float,
    gates: Passing | None = None,
) -> Ending:  # fmt: skip
    """How mission b ended; `contact` and `gates` are those of all missions, the goal (3,) its own; `judge_flight`."""
    _, x = samples(arrays, b, period)
    dt, finite = period / arrays["commands"].shape[2], np.isfinite(x).all(axis=-1, keepdims=True)
    row = slice(b, b + 1)
    its_gates = None if gates is None else gates.take(row)
    return judge_flight(np.where(finite, x, np.nan), dt, contact.take(row), goal, goal_radius, its_gates)


def endings(log: MissionLog, problem: Problem, goal_radius: float | None = None) -> list[Ending]:
    """How each mission of a log ended: outcome, flight time, clearance, distance from the goal, and gates passed.

    Args:
        problem: the problems that were flown.
        goal_radius: m, as the mission had it; None: the problems' own.

    Raises:
        InputError: other problems than the log's, problems without a goal, or a radius that isn't above 0.
    """
    check_value(goal_radius, Meters | None, "goal_radius")
    if len(log.x) != problem.B or problem.goal is None:
        raise InputError("problem", f"the {len(log.x)} problems with goals that were flown", f"{problem.B} problems")
    contact, gates = Contact.among(problem), Passing.among(problem)
    goal, arrays = problem.goal.position.numpy(), log.arrays()
    radii = problem.goal.radius.tolist() if goal_radius is None else [goal_radius] * problem.B
    return [ending(arrays, b, log.period, contact, goal[b], radii[b], gates) for b in range(problem.B)]


def _steps(arrays: Arrays, b: int) -> int:
    return int((~np.isnan(arrays["planner_seconds"][b])).sum())
