"""Tables of trials made by hand, with every column of a study; a test gives only the columns it needs."""

from collections.abc import Iterable
from itertools import count
from typing import Any

import pandas as pd

from torchgco.experiments.results.identity import Manifest

PLAIN = {
    "scenario": "forest",
    "layout": 0,
    "seed": 0,
    "model": "quadrotor",
    "solver": "gco",
    "status": "CONVERGED",
    "feasible": True,
    "reached": True,
    "success": True,
    "clear_95": True,
    "cost": 100.0,
    "best_cost": 100.0,
    "violation": 1e-6,
    "clearance": 0.05,
    "clearance_knots": 0.06,
    "goal_distance": 0.2,
    "dynamics_residual": 0.0,
    "clearance_full": 0.01,
    "bound_violation": 0.0,
    "kkt_residual": 1e-3,
    "step_error": 1e-3,
    "step_cost": 1e-3,
    "iterations": 40,
    "outer_iterations": 10,
    "guided": 2,
    "seconds": 0.1,
    "batch_size": 8,
    "threads": 1,
    "device": "cpu",
    "dtype": "float64",
    "kernels": "native",
    "version": "0.1.0",
    "best_from": "file",
    "layout_digest": "one",
    "settings_digest": "one",
}


def trials(*rows: dict[str, Any]) -> pd.DataFrame:
    """A table of rows, each given by its differences from PLAIN."""
    table = pd.DataFrame([PLAIN | row for row in rows])
    return table.astype({"success": "boolean"})


def flights(solver: str, reached: Iterable[bool], **more: Any) -> list[dict[str, Any]]:
    """One row per layout 0, 1, ...: feasible, reached and success are all True or all False."""
    return [
        {"solver": solver, "layout": i, "feasible": hit, "reached": hit, "success": hit, **more}
        for i, hit in zip(count(), reached, strict=False)
    ]


def manifest(**configuration: Any) -> bytes:
    """The study.json of a finished study without solvers and layouts, with these keys in its configuration."""
    given = {"version": "0.1.0", "seed": 0, "device": {"name": "cpu", "dtype": "float64"}}
    return Manifest(given | configuration, {}, {}).to_json()


ENDS = {"R": "REACHED", "C": "COLLISION", "T": "TIMEOUT", "D": "DIVERGED"}


def missions(solver: str, ends: str, **more: Any) -> list[dict[str, Any]]:
    """One row per mission 0, 1, ..., which end as the letters of `ends` say, after 5, 6, ... seconds."""
    rows = []
    for i, outcome in enumerate(ENDS[end] for end in ends):
        row = {"solver": solver, "layout": i, "outcome": outcome, "status": outcome, "reached": outcome == "REACHED"}
        row |= {"feasible": outcome in ("REACHED", "TIMEOUT"), "success": None, "cost": float("nan")}
        row |= {"best_cost": float("nan"), "flight_time": 5.0 + i, "energy": 500.0 + i, "missed_deadlines": 1 + i}
        row |= {
            "shifted_plans": 0,
            "tracker_seconds_median": 0.007,
            "tracking_violation": 1e-9,
            "outer_iterations": 120,
        }
        row |= {"planner_seconds_median": 0.012, "planner_seconds_p99": 0.025, "batch_size": len(ends)}
        rows.append(row | more)
    return rows
