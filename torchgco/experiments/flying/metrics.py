"""Metrics of a user, `study.metrics`: functions of trajectories that become columns of a study's trials."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown, theirs
from torchgco.base.mixing import why
from torchgco.base.shapes import MISTAKES
from torchgco.experiments.results.durations import states_of
from torchgco.problem.problem import Problem
from torchgco.problem.times import times as usual_times

Metrics = Mapping[str, Callable[..., Any]]
# Columns of some studies alone.
SOMETIMES = (
    "duration", "gates_passed", "violation_between", "outcome", "vehicles", "makespan", "least_distance", "flight_time",
)  # fmt: skip


def check_metrics(metrics: Metrics, columns: Collection[str], problem: Problem, U: Tensor) -> None:
    """Check names, which may not be those of other columns, and what the metrics return of some controls (B, N, m).

    Raises:
        InputError: a name that is no word or another column's, and as `metric_columns` but for NaN: the trajectory of
            a solver may have numbers where that of these controls has none.
    """
    for name in metrics:
        if not name.isidentifier() or name in (*columns, *SOMETIMES):
            raise InputError(f"study.metrics.{name}", "a name of its own, of letters, digits and _", "a column's")
    metric_columns(metrics, problem, U, None, None)


def metric_columns(
    metrics: Metrics, problem: Problem, U: Tensor, times: Tensor | None, ids: Sequence[int] | np.ndarray | None
) -> dict[str, np.ndarray]:
    """A column (B,) for each metric, NaN where a trajectory isn't finite.

    A metric is called with X (b, N+1, n), U (b, N, m), the times t (b, N+1) of the knots, s, and their problems, of
    some trajectories with as many stages, in float64, X simulated from U; it returns a number for each, (b,).

    Args:
        U: (B, N, m), with `times` (B, N+1) of the knots where the time is free.
        ids: numbers of the layouts, for errors; None: NaN is admitted.

    Raises:
        InputError: a metric that fails, returns another shape, or NaN of a finite trajectory.
    """
    if not metrics:
        return {}
    X = states_of(problem, U, times)
    t = usual_times(problem).expand(problem.B, -1) if times is None else times
    finite, stages = torch.isfinite(X).flatten(1).all(-1), problem.stages
    columns = {name: np.full(problem.B, np.nan) for name in metrics}
    for last in stages[finite].unique().tolist():
        rows = (finite & (stages == last)).nonzero().flatten()
        for name, metric in metrics.items():  # each gets copies of its own: one may write into them
            flown = X[rows, : last + 1], U[rows, :last], t[rows, : last + 1], problem.take(rows)
            values = _values(f"study.metrics.{name}", metric, flown)
            if ids is not None and np.isnan(values).any():
                number = np.asarray(ids)[rows.numpy()[np.isnan(values)]][0]
                raise InputError(f"study.metrics.{name}", "a number of each trajectory", f"NaN on layout {number}")
            columns[name][rows.numpy()] = values
    return columns


def _values(field: str, metric: Callable[..., Any], flown: tuple[Any, ...]) -> np.ndarray:
    """What a metric returns of b trajectories, (b,)."""
    count = len(flown[0])
    try:
        value = metric(*flown)
        values = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    except MISTAKES as error:
        raise InputError(field, "a function of (X, U, t, problem)", why(error, metric, *flown)) from theirs(error)
    if values.shape != (count,) or values.dtype.kind not in "biuf":
        got = f"{values.dtype} {values.shape}" if values.dtype.kind != "O" else shown(value)
        raise InputError(field, f"numbers ({count},), one for each trajectory", got)
    return values.astype(np.float64)
