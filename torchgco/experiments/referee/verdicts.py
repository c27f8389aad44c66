"""Controls of any solver as rows of a study's table, judged and certified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch

from torchgco.base.errors import InputError
from torchgco.experiments.referee.controls import Controls
from torchgco.experiments.results.durations import judged_columns, states_of, times_at
from torchgco.experiments.results.folder import COLUMNS, with_success
from torchgco.experiments.results.identity import layout_digests
from torchgco.judging.certificate import certify
from torchgco.judging.certificate import frame_columns as certificate_columns
from torchgco.scenarios import Layouts, Task, Vehicle

AT_ONCE = 64  # layouts judged at once
# How a row's status calls controls that are given in part, or not at all; others are FEASIBLE, INFEASIBLE, NON_FINITE.
ABSENT, INCOMPLETE = "ABSENT", "INCOMPLETE"
UNKNOWN: Mapping[str, Any] = {
    "iterations": np.nan, "outer_iterations": np.nan, "guided": np.nan, "batch_size": np.nan, "threads": np.nan,
    "device": "", "dtype": "", "kernels": "", "version": "",
}  # fmt: skip


def judged(
    layouts: Layouts, vehicle: Vehicle, model: Mapping[str, Any], controls: Sequence[Controls], seed: int = 0
) -> pd.DataFrame:
    """A row per solver and layout, with the columns of a study.

    What a foreign solver alone could say (iterations, threads) is missing. Its name and controls are its settings, so
    that a report tells two submissions of one name apart.

    Args:
        model: the vehicle's node of the configuration, of which layouts have their digests.
        seed: of the studies that rows are to be compared with.

    Raises:
        InputError: layouts that don't fit the vehicle, or a solver's name that is given twice.
    """
    names = [solver.name for solver in controls]
    for name in names:
        if names.count(name) > 1:
            raise InputError("CONTROLS", "another name for each solver (the file's, or its `solver`)", f"{name} twice")
    tasks = [(places, vehicle.task(layouts.take(places))) for places in layouts.together(AT_ONCE)]
    tables = [_rows(task, solver, places) for solver in controls for places, task in tasks]
    rows = pd.concat(tables, ignore_index=True)
    digests = layout_digests(vehicle.at_rest(layouts), model)
    rows = rows.assign(
        scenario=layouts.name, seed=seed, model=vehicle.name, layout_digest=rows["layout"].map(digests), **UNKNOWN
    )
    order = [f"{name}\n{number:020d}" for name in names for number in layouts.ids.tolist()]
    keys = [f"{row.solver}\n{row.layout:020d}" for row in rows[["solver", "layout"]].itertuples()]
    rows = rows.iloc[pd.Index(keys).get_indexer(pd.Index(order))].reset_index(drop=True)
    rows = with_success(rows, layouts, len(controls))
    return rows[[*COLUMNS, *(name for name in rows.columns if name not in COLUMNS)]]


def _rows(task: Task, solver: Controls, places: np.ndarray) -> pd.DataFrame:
    """The rows of one solver on layouts that a batch can hold."""
    problem = task.problem
    U = torch.from_numpy(solver.U[places, : problem.N])
    times = times_at(solver.times, places, problem.N)
    if times is not None:  # of a layout that is lacking the times are, too
        times = torch.where(times.isfinite().all(-1, keepdim=True), times, _usual(task))
    verdict, columns = judged_columns(task, U, times)
    X = states_of(problem, U, times)
    certificate = certify(problem, X, U, verdict.feasible, times=times)
    lacking, stages = solver.lacking[places], problem.stages.numpy()
    finite = torch.isfinite(X).flatten(1).all(-1).numpy()
    status = np.where(verdict.feasible.numpy(), "FEASIBLE", np.where(finite, "INFEASIBLE", "NON_FINITE"))
    status = np.where(lacking >= stages, ABSENT, np.where(lacking > 0, INCOMPLETE, status))
    return pd.DataFrame(
        {
            "layout": task.layouts.ids, "solver": solver.name, "status": status, **columns,
            **certificate_columns(certificate),
            "seconds": solver.seconds[places], "settings_digest": solver.digest,
        }
    )  # fmt: skip


def _usual(task: Task) -> torch.Tensor:
    """The times (N+1,) of knots at the usual distance."""
    dt = task.problem.dynamics.dt
    return torch.arange(task.problem.N + 1, dtype=torch.float64) * float(dt)
