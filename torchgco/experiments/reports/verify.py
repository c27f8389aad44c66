"""Confirms the tables of finished studies from their stored controls, layouts and settings, and says what is confirmed.

The controls of every row are simulated again, open-loop, with the model of study.json, and judged by `torchgco.judge`,
which uses no solver code. Missions are confirmed from the log in mission.parquet, as far as it goes, and fleets with
the rows of their vehicles. Then summary.csv and paired.csv are counted again from the table.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from torchgco.base.errors import InputError
from torchgco.experiments.config.build import metrics_of
from torchgco.experiments.flying.metrics import metric_columns
from torchgco.experiments.flying.mission_flight import FAILED, VEHICLES, fleet_columns, vehicles_table
from torchgco.experiments.reports.finished import MEASURED_AT_ONCE, Study
from torchgco.experiments.results.durations import judged_columns
from torchgco.experiments.results.files import damaged, readable
from torchgco.experiments.results.folder import (
    DONE,
    JUDGED,
    MANIFEST,
    TRIALS,
    StudyFolder,
    with_success,
)
from torchgco.experiments.results.identity import closed_loop, layout_digests
from torchgco.experiments.results.kinds import joined, parts_of
from torchgco.experiments.results.limits import read_table
from torchgco.experiments.results.merge import values_of
from torchgco.experiments.results.runs import below
from torchgco.experiments.statistics.statistics import swept_columns
from torchgco.experiments.statistics.tables import aligned, csv_text
from torchgco.fleets.drawn import solution_of
from torchgco.missions.contact import Contact
from torchgco.missions.outcome import STATES, Outcome, step_columns
from torchgco.scenarios import Layouts

TOLERANCE = 1e-8  # of numbers, relative above 1: other processors and libraries round differently
TRIAL = ["solver", "layout"]
IDENTITY = ("model", "seed", "version", "device", "dtype", "layout_digest", "settings_digest")
ROW_KEYS = pd.Index(["solver", "solver_a", "solver_b", "outcome"])  # of a row of summary.csv or paired.csv
DIFFERENT = 10  # differing values that are printed per table
# Of missions: columns that the log, which has the states at control steps alone, can't confirm; and those that are
# compared with the outcome only.
NOT_LOGGED = (
    "outcome", "flight_time", "clearance", "goal_distance", "gates_passed", "gate_distance", "duration", "energy",
    "iterations",
)  # fmt: skip
BY_OUTCOME = ("status", "feasible", "reached")


@dataclass(frozen=True)
class Table:
    """What was confirmed of one table of a study.

    Args:
        rows: of the table.
        columns: that were computed again and compared.
        others: its other columns, which only the checksum of the file guards, if anything.
        lacking: columns that it would have today: it is of an older version.
        differences: names of the row (solver and layout), column, held and computed, in the order of the table; no
            rows: all columns are confirmed.
    """

    name: str
    rows: int
    columns: tuple[str, ...]
    others: tuple[str, ...]
    differences: pd.DataFrame
    lacking: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verification:
    """What was confirmed of one study: its trials.parquet, and where no row differs, vehicles.parquet of fleets,
    summary.csv and paired.csv.

    Args:
        absent: of these, those that should exist, but don't.
    """

    folder: Path
    tables: tuple[Table, ...]
    absent: tuple[str, ...]
    missions: bool

    @property
    def differs(self) -> bool:
        """Whether any value differs from the one computed again."""
        return any(len(table.differences) for table in self.tables)


def verify(folders: Iterable[str | os.PathLike[str]], trust: bool = False) -> tuple[list[Verification], list[str]]:
    """Confirm every finished study in and below some folders; also names the studies that aren't finished.

    Args:
        trust: whether the studies' files may name any class, which then runs, or torchgco's own alone.

    Raises:
        InputError: a missing folder, folders without a finished study, a damaged or missing file, a table that doesn't
            have one row per solver and layout, a study of an older version, a class that `trust` alone admits.
    """
    paths = [Path(folder) for folder in folders]
    studies = below(paths, MANIFEST).values()
    done = [folder for folder in studies if (folder / DONE).is_file()]
    if not done:
        raise InputError("folders", "a finished study in or below them", ", ".join(map(str, paths)))
    unfinished = [str(folder) for folder in studies if folder not in done]
    return [verify_study(folder, trust) for folder in done], unfinished


def verify_study(folder: Path, trust: bool = False) -> Verification:
    """Confirm the table of one finished study. Raises InputError as `verify` does."""
    study = Study.read(folder, trust, changed=True)
    manifest, kept = study.manifest, study.trials
    rows = pd.MultiIndex.from_product([list(manifest.solvers), list(manifest.layouts)], names=TRIAL)
    if not set(TRIAL) <= set(kept.columns) or not kept.set_index(TRIAL).index.sort_values().equals(rows.sort_values()):
        raise damaged(folder / TRIALS, "doesn't have one row per solver and layout")
    kept = kept.set_index(TRIAL)
    single = _trajectories if study.layouts.vehicles is None else _fleets
    try:
        computed = (_missions if study.missions else single)(study).reindex(kept.index)
    except (InputError, KeyError, IndexError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        if isinstance(error, InputError) and error.field in ("hydra.run.dir", "RUN"):
            raise
        raise damaged(folder, f"can't be simulated again ({error})") from None
    computed = computed.join(_identity(study, kept.index))
    keys = values_of(kept.reset_index(), manifest, swept_columns(kept))
    computed = computed.assign(**keys)
    differences = _differences(kept, computed)
    if differences.empty:  # nothing that can be computed differs: has any other column been changed?
        StudyFolder(folder, manifest).verify()
    others = tuple(str(name) for name in kept.columns if name not in computed.columns)
    trials = Table(TRIALS, len(kept), tuple(computed.columns), others, differences)
    # Of rows that differ, the tables that count them would differ, too.
    if not differences.empty:
        return Verification(folder, (trials,), (), study.missions)
    (tables, lost), (counted, absent) = _vehicles(study), _counted(folder, kept.reset_index())
    return Verification(folder, (trials, *tables, *counted), (*lost, *absent), study.missions)


def _vehicles(study: Study) -> tuple[list[Table], list[str]]:
    """What is confirmed of vehicles.parquet; and its name where it is absent."""
    path, layouts = study.folder / VEHICLES, study.layouts
    if layouts.vehicles is None or not path.is_file():
        return [], [] if layouts.vehicles is None else [VEHICLES]
    computed = vehicles_table(study.vehicle, layouts, study.controls)
    return [
        _compared(VEHICLES, readable(path, read_table, trust=study.trust), computed, pd.Index([*TRIAL, "vehicle"]))
    ], []


def _counted(folder: Path, trials: pd.DataFrame) -> tuple[list[Table], tuple[str, ...]]:
    """What is confirmed of summary.csv and paired.csv, counted again from the table of trials; and which are absent."""
    tables, absent = [], []
    for name, table in joined(parts_of(trials)).items():
        path = folder / f"{name}.csv"
        if not path.is_file():
            absent += [path.name] if len(table) else []
            continue
        stored, computed = readable(path, pd.read_csv), pd.read_csv(io.StringIO(csv_text(table)))
        tables.append(_compared(path.name, stored, computed, ROW_KEYS))
    return tables, tuple(absent)


def _compared(name: str, stored: pd.DataFrame, computed: pd.DataFrame, keys: pd.Index) -> Table:
    """A table of which all columns are computed again, row by row; `keys` name a row.

    Columns that one of both has alone are of another version.
    """
    both = [column for column in computed.columns if column in stored.columns]
    lacking, others = (
        tuple(a.columns.difference(b.columns, False)) for a, b in ((computed, stored), (stored, computed))
    )
    if len(stored) != len(computed):
        shapes = (f"{len(frame)} rows, {len(frame.columns)} columns" for frame in (stored, computed))
        differences = pd.DataFrame([("-", "-", *shapes)], columns=["row", "column", "held", "computed"])
    else:
        index = pd.MultiIndex.from_frame(computed[keys.intersection(computed.columns)])
        differences = _differences(stored[both].set_axis(index), computed[both].set_axis(index))
    return Table(name, len(computed), tuple(both), others, differences, lacking)


def _identity(study: Study, index: pd.MultiIndex) -> pd.DataFrame:
    """The columns that name layouts, settings and surroundings, from layouts.npz and study.json."""
    manifest, configuration = study.manifest, study.manifest.configuration
    codes = layout_digests(study.layouts, configuration["model"]["vehicle"], closed_loop(configuration))
    rows = pd.DataFrame({"model": study.vehicle.name, **manifest.constants}, index=index)
    rows["layout_digest"] = index.get_level_values("layout").map(codes)
    rows["settings_digest"] = index.get_level_values("solver").map(manifest.settings)
    return rows[list(IDENTITY)]


def _trajectories(study: Study) -> pd.DataFrame:
    """The judged columns of single trajectories, by (solver, layout)."""
    metrics, parts = metrics_of(study.manifest.configuration) if study.trust else {}, []  # code of a user runs
    for places, task in study.tasks():
        for name in study.manifest.solvers:
            U, times = study.flight(name, places, task.problem.N)
            columns = judged_columns(task, U, times)[1] | metric_columns(metrics, task.problem, U, times, None)
            parts.append(pd.DataFrame({"solver": name, "layout": task.layouts.ids, **columns}))
    return _with_success(study, parts)


def _fleets(study: Study) -> pd.DataFrame:
    """The judged columns of fleets, by (solver, layout)."""
    parts = []
    for name, U in study.controls.items():
        for places in study.layouts.together(MEASURED_AT_ONCE):
            some = study.layouts.take(places)
            columns = fleet_columns(solution_of(study.vehicle, some, U[places]).verdict)
            parts.append(pd.DataFrame({"solver": name, "layout": some.ids, **columns}))
    return _with_success(study, parts)


def _with_success(study: Study, parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Judged columns as one table by (solver, layout), with those that compare its rows."""
    rows = pd.concat(parts, ignore_index=True)
    judged = [name for name in rows.columns if name not in TRIAL]
    return with_success(rows, study.layouts, len(study.manifest.solvers)).set_index(TRIAL)[[*judged, *JUDGED]]


def _missions(study: Study) -> pd.DataFrame:
    """The columns of missions that the log decides, by (solver, layout).

    The log has the plant's state at the start of every control step, and a flight is judged at all time steps: the
    outcome itself, and what belongs to the end of a flight, can't be confirmed.
    """
    log, layouts, solvers = study.log, study.layouts, study.manifest.solvers
    log["shifted"] = log["source"] == "shifted"
    problem = study.vehicle.task(layouts).problem
    contact, period = Contact.among(problem), float(problem.dynamics.dt)
    flights = {key: rows for key, rows in log.groupby(["solver", "mission"], sort=False)}
    nearest = {name: _nearest(log[log["solver"] == name], layouts, contact, period) for name in solvers}
    rows = []
    for (solver, layout), outcome in study.trials.set_index(TRIAL)["outcome"].items():
        steps = flights.get((solver, layout), log.iloc[:0])
        rows.append(
            {
                "solver": solver, "layout": layout, "status": outcome,
                "feasible": outcome not in {lost.name for lost in FAILED}, "reached": outcome == Outcome.REACHED.name,
                "clearance_knots": nearest[solver][layout],
                **step_columns({str(name): column.to_numpy() for name, column in steps.items()}, period),
            }
        )  # fmt: skip
    return pd.DataFrame(rows).set_index(TRIAL)


def _nearest(log: pd.DataFrame, layouts: Layouts, contact: Contact, period: float) -> dict[int, float]:
    """Smallest distance to contact at the starts of each mission's control steps, m, by layout; infinite without."""
    ids = layouts.ids.tolist()
    x = np.full((len(ids), 1 + log["step"].max() if len(log) else 0, STATES), np.nan)
    x[log["mission"].map(ids.index).to_numpy(dtype=int), log["step"]] = log[[f"x{i}" for i in range(STATES)]]
    distances = contact.distances(torch.from_numpy(x), period).numpy()
    nearest = np.fmin.reduce(np.where(np.isnan(x[..., 0]), np.inf, distances), axis=1, initial=np.inf)
    return dict(zip(ids, nearest.tolist(), strict=True))


def _differences(stored: pd.DataFrame, computed: pd.DataFrame) -> pd.DataFrame:
    differing = []
    for name in computed.columns:
        values = stored[name] if name in stored.columns else pd.Series(pd.NA, index=stored.index)
        differ = np.flatnonzero(~_equal(values, computed[name]))
        differing += [(i, *stored.index[i], name, values.iloc[i], computed[name].iloc[i]) for i in differ.tolist()]
    names = [*stored.index.names, "column", "held", "computed"]
    return pd.DataFrame(sorted(differing, key=lambda row: row[0]), columns=["row", *names])[names]


def _equal(stored: pd.Series, computed: pd.Series) -> np.ndarray:
    """Whether values agree: numbers within TOLERANCE, all else exactly; undefined values agree with each other."""
    if computed.dtype == np.float64 and pd.api.types.is_numeric_dtype(stored):
        a, b = stored.to_numpy(dtype=float, na_value=np.nan), computed.to_numpy()
        with np.errstate(invalid="ignore"):  # infinite distances
            near = np.abs(a - b) <= TOLERANCE * np.maximum(1.0, np.abs(b))
        return (near & np.isfinite(b)) | (a == b) | (np.isnan(a) & np.isnan(b))
    a, b = stored.astype(object).to_numpy(), computed.astype(object).to_numpy()
    equal, known = pd.isna(a) & pd.isna(b), ~pd.isna(a) & ~pd.isna(b)
    equal[known] = (a[known] == b[known]).astype(bool)
    return equal


def confirmed_text(studies: Sequence[Verification]) -> str:
    """The values that differ, study by study, and what is confirmed of all others together."""
    right = [study for study in studies if not study.differs]
    where = f" in {len(right)} studies" if len(right) > 1 else ""
    lines = [*difference_texts(studies), f"{_rows(study.tables[0].rows for study in right)} confirmed{where}"]
    for kind in (False, True):
        of_kind = [study for study in right if study.missions == kind]
        if 0 < len(of_kind) < len(right):
            rows = _rows(study.tables[0].rows for study in of_kind)
            lines.append(f"{rows} of {'missions' if kind else 'trajectories'}:")
        lines += list(dict.fromkeys(f"  {line}" for study in of_kind for line in _columns(study)))
    for name in (VEHICLES, "summary.csv", "paired.csv"):
        rows = [table.rows for study in right for table in study.tables if table.name == name]
        lines += [f"{_rows(rows)} of {name} confirmed"] if rows else []
    lines += [f"not confirmed: {study.folder / name}, which is missing" for study in right for name in study.absent]
    lines += [
        _version_text(study, table) for study in right for table in study.tables[1:] if table.lacking + table.others
    ]
    return "\n".join(lines)


def _version_text(study: Verification, table: Table) -> str:
    """What of a table is of another version."""
    words = ("lacks newer columns", table.lacking), ("older ones aren't confirmed", table.others)
    said = "; ".join(f"{word}: {', '.join(names)}" for word, names in words if names)
    return f"of another version: {study.folder / table.name} ({said})"


def _rows(counts: Iterable[int]) -> str:
    total = sum(counts)
    return "1 row" if total == 1 else f"{total} rows"


def difference_texts(studies: Sequence[Verification]) -> list[str]:
    """The first values that differ in each table."""
    pairs = [(study, table) for study in studies for table in study.tables if len(table.differences)]
    return [_difference_text(study, table) for study, table in pairs]


def confirmed_frame(studies: Sequence[Verification]) -> pd.DataFrame:
    """A row per study and file.

    Columns: `study`, `file`, `rows`, `differing` values, and the names of the columns that are `confirmed` ("all" where
    there are no others), that follow from the outcome of a mission alone (`by_outcome`), that the `checksum` guards
    alone, and that are `unconfirmed`. A table that is missing has no rows and no columns.
    """
    rows = []
    for study in studies:
        for table in study.tables:
            names = _sorted(study, table)
            cells = {kind: " ".join(named) for kind, named in names.items()}
            whole = not table.lacking and not any(named for kind, named in names.items() if kind != "confirmed")
            cells |= {"confirmed": "all"} if whole else {}
            first = {"study": str(study.folder), "file": table.name, "rows": table.rows}
            rows.append({**first, "differing": len(table.differences), **cells})
        empty = dict.fromkeys(("confirmed", "by_outcome", "checksum", "unconfirmed"), "")
        for name in study.absent:
            rows.append({"study": str(study.folder), "file": name, "rows": 0, "differing": 0, **empty})
    return pd.DataFrame(rows)


def _sorted(study: Verification, table: Table) -> dict[str, list[str]]:
    """The columns of a table by how far they are confirmed."""
    trials = table is study.tables[0]
    bound = BY_OUTCOME if study.missions and trials else ()
    unknown = (NOT_LOGGED if study.missions else ()) if trials else table.others  # a checksum guards trials alone
    return {
        "confirmed": [name for name in table.columns if name not in bound],
        "by_outcome": [name for name in table.columns if name in bound],
        "checksum": [name for name in table.others if name not in unknown],
        "unconfirmed": [name for name in table.others if name in unknown],
    }


def _columns(study: Verification) -> list[str]:
    columns = {name: ", ".join(names) for name, names in _sorted(study, study.tables[0]).items()}
    texts = {
        "confirmed": "columns: {}",
        "by_outcome": "agree with the outcome: {}",
        "checksum": "not computed again, but as the study wrote them (checksum): {}",
        "unconfirmed": "not confirmed: {} (missions are judged at time steps, of which the log has only the control "
        "steps), but as the study wrote them (checksum)",
    }
    return [text.format(columns[name]) for name, text in texts.items() if columns[name]]


def _difference_text(study: Verification, table: Table) -> str:
    count, path = len(table.differences), study.folder
    path = path if table is study.tables[0] else path / table.name
    rows = [[str(value) for value in row] for row in table.differences.head(DIFFERENT).to_numpy().tolist()]
    values = "1 value differs" if count == 1 else f"{count} values differ"
    lines = [f"{path}: {values} in {_rows([table.rows])}"]
    lines.append(aligned([list(table.differences.columns), *rows], 1))
    more = count - len(rows)
    return "\n".join([*lines, *([f"... and {more} more"] if more else [])])
