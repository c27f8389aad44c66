"""Flights of missions as tables: a row per control step, and a row per mission."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from torchgco.dynamics.quadrotor import Airframe
from torchgco.outcome import Ending, judge_flight

Arrays = Mapping[str, np.ndarray]


def mission_frame(arrays: Arrays, ids: Sequence[int], period: float, clearances: Sequence[np.ndarray]) -> pd.DataFrame:
    """A row per mission and control step.

    Args:
        arrays: see `MissionLog.arrays`.
        ids: numbers of the missions; period: of a control step, s.
        clearances: of each mission, at the starts of its control steps, m.
    """
    frames = []
    for b, number in enumerate(ids):
        K = _steps(arrays, b)
        x = arrays["x"][b, :K, 0]
        columns = {"mission": np.full(K, number), "step": np.arange(K), "t": period * np.arange(K)}
        columns |= {f"x{i}": x[:, i] for i in range(x.shape[1])}
        columns |= {name: arrays[name][b, :K] for name in ("cost", "violation")}
        columns |= {f"f{i + 1}": x[:, 13 + i] for i in range(4)}
        columns |= {f"u{i + 1}": arrays["commands"][b, :K, 0, i] for i in range(4)}
        columns |= {"clearance": clearances[b][:K]}
        columns |= {name: arrays[name][b, :K] for name in ("planner_seconds", "tracker_seconds", "tracking_violation")}
        columns |= {"guided": arrays["guided"][b, :K].astype(int)}
        columns |= {"source": np.where(arrays["shifted"][b, :K] == 1, "shifted", "solved")}
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
    """The columns of mission b that a study adds to its own."""
    K = _steps(arrays, b)
    planner = arrays["planner_seconds"][b, :K]
    t, x = samples(arrays, b, period)
    until = t <= end.flight_time + 1e-9
    return {
        "outcome": end.outcome.name,
        "flight_time": end.flight_time,
        "energy": energy(t[until], x[until], airframe),
        "missed_deadlines": int((planner + arrays["tracker_seconds"][b, :K] > period).sum()),
        "shifted_plans": int(np.nansum(arrays["shifted"][b, :K])),
        "planner_seconds_median": float(np.median(planner)) if K else math.nan,
        "planner_seconds_p99": float(np.quantile(planner, 0.99)) if K else math.nan,
        "tracker_seconds_median": float(np.median(arrays["tracker_seconds"][b, :K])) if K else math.nan,
        "tracking_violation": float(arrays["tracking_violation"][b, :K].max(initial=0.0)),
    }


def ending(
    arrays: Arrays,
    b: int,
    period: float,
    spheres: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    goal: np.ndarray,
    goal_radius: float,
) -> Ending:
    """How mission b ended; spheres are centres, distances of contact and velocities, see `judge_flight`."""
    t, x = samples(arrays, b, period)
    return judge_flight(t, x[:, :3], *spheres, goal, goal_radius)


def _steps(arrays: Arrays, b: int) -> int:
    return int((~np.isnan(arrays["cost"][b])).sum())
