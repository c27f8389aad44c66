"""What the referee found: controls judged and certified as rows, their page, and a leaderboard of entries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from torchgco.base.errors import InputError, first_line
from torchgco.experiments.config.build import compose_config, vehicle_of
from torchgco.experiments.config.groups import ANYWHERE
from torchgco.experiments.referee.controls import Controls, read_controls
from torchgco.experiments.referee.entries import Entry, entries_of, layouts_of
from torchgco.experiments.referee.page import Board, Cell, page
from torchgco.experiments.results.durations import judged_columns, states_of, times_at
from torchgco.experiments.results.folder import COLUMNS, with_success
from torchgco.experiments.results.identity import layout_digests
from torchgco.experiments.results.limits import check_stages, read_layouts, read_npz
from torchgco.experiments.statistics.statistics import summarise
from torchgco.experiments.statistics.tables import rate
from torchgco.judging.certificate import certify
from torchgco.judging.certificate import frame_columns as certificate_columns
from torchgco.scenarios import Layouts, Task, Vehicle
from torchgco.scenarios.vehicle import BUILT_IN, fitting

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


NOTES = (
    "Every trajectory is simulated again from its controls, in float64, and judged by the same code; no code of an "
    "entry runs. Rates have 95 % Wilson intervals. Layouts without controls count as missed.",
    "success: reached at no more than 5 % above the best known cost. clearance: the smallest distance to contact, "
    "between the knots, too, of those that reached. Seconds, hardware and seeds are what entrants say.",
)
OF_MODEL = ("model=", "model.", "vehicle=", "vehicle.")  # how words begin that have an effect
SHOWN = 10_000  # rows of single layouts on a page, at most: some 4 MB
RATED: dict[str, str] = {
    "success": "reached at no more than 5 % above the best known cost",
    "reached": "feasible, and within the goal's radius at the end",
    "feasible": "all constraints within 1e-3, no contact between the knots either",
    "cost ratio": "cost over the best known one, of those that reached: median (90 % quantile)",
    "clearance": "m, the least of those that reached, to contact",
    "seconds": "median per layout, as the entrant says",
}


@dataclass(frozen=True)
class Scene:
    """Layouts of a file with the vehicle that flies them, and its node of the configuration."""

    layouts: Layouts
    vehicle: Vehicle
    model: Mapping[str, Any]

    @classmethod
    def read(cls, path: Path, words: Sequence[str] = (), best: Path | None = None, trust: bool = False) -> Scene:
        """The layouts of a file.

        Args:
            words: of the command `torchgco`, which name the model or change it; by default the built-in model with as
                many states, `unicycle` or `quadrotor` where the file gives positions alone.
            best: a file whose `best_cost` (L,) replaces those of the layouts.
            trust: whether the files may take any memory.

        Raises:
            InputError: as `Layouts.load`, a model that doesn't fit, other words, best costs of another shape.
        """
        if other := [word for word in words if not word.lstrip("+~").startswith(OF_MODEL)]:
            raise InputError("KEY=VALUE", f"words that name a model or change it: {', '.join(OF_MODEL)}", other[0])
        layouts = read_layouts(path, trust)
        named = any(word.startswith("model=") for word in words)
        model = [] if named else [f"model={usual_model(layouts)}"]
        config = compose_config(["scenario=layouts", f"scenario.path={path}", "study.baselines=[]", *model, *words])
        vehicle = vehicle_of(config, trust=True)  # these words are the referee's own
        if best is not None:
            layouts = with_best(layouts, best, trust)
        if not trust:
            check_stages(path, vehicle, layouts, AT_ONCE)
        return cls(layouts, vehicle, config["model"]["vehicle"])

    def controls(self, path: Path, trust: bool = False) -> list[Controls]:
        return read_controls(path, self.layouts, self.vehicle, trust)

    def judged(self, controls: Sequence[Controls]) -> pd.DataFrame:
        return judged(self.layouts, self.vehicle, self.model, controls)


def usual_model(layouts: Layouts) -> str:
    """The built-in model that flies layouts; InputError where none has as many states."""
    ends = layouts.start if layouts.start is not None else layouts.goal
    states = layouts.dimension if ends is None else ends.shape[-1]
    if states == layouts.dimension:
        return ANYWHERE[layouts.dimension]
    for name, space in BUILT_IN.items():
        if space == (layouts.dimension, states):
            return name
    raise InputError("model", fitting(layouts.dimension, None), f"{states} states in {layouts.name}")


def with_best(layouts: Layouts, path: Path, trust: bool) -> Layouts:
    """The layouts with the best costs (L,) of another file."""
    try:
        best = read_npz(path, trust).get("best_cost")
    except InputError:
        raise
    except Exception as error:
        raise InputError("--best", "a readable npz file", f"{path} ({first_line(error)})") from None
    if best is None or best.shape != (layouts.count,) or best.dtype.kind not in "iuf":
        got = "none" if best is None else f"{best.dtype} {best.shape}"
        raise InputError("--best", f"best_cost ({layouts.count},), as there are layouts", f"{got} in {path}")
    return replace(layouts, best_cost=best.astype(np.float64))


def judged_page(trials: pd.DataFrame) -> str:
    """The page of one file's layouts: a row per solver, and a row per solver and layout."""
    summary, name = summarise(trials), str(trials["scenario"].iloc[0])
    rows = [[Cell(str(row["solver"])), *_cells(row, trials)] for _, row in summary.iterrows()]
    heads = [("solver", "as its file names it"), *RATED.items()]
    every = [("solver", "as its file names it"), ("layout", "its number in the file"), *EACH.items()]
    shown = trials.head(SHOWN)
    single = [[_text(row["solver"]), _number(row["layout"], "{:.0f}"), *_each(row)] for _, row in shown.iterrows()]
    cut = f"The first {SHOWN} of {len(trials)} rows of trials.parquet"
    title = "Every layout" if len(shown) == len(trials) else cut
    boards = [Board("Solvers", heads, rows), Board(title, every, single, keys=2)]
    return page(f"{name}: judged", f"{len(trials) // len(summary)} layouts.", boards, NOTES)


EACH = {
    "status": "FEASIBLE, INFEASIBLE, NON_FINITE, INCOMPLETE: stages are missing, ABSENT: no controls",
    "reached": "feasible, and within the goal's radius at the end",
    "cost": "of all stages and the end",
    "cost ratio": "cost over the best known one",
    "clearance": "m, to contact, between the knots, too",
    "violation": "the largest of a constraint, in its unit",
    "kkt": "residual of the optimality conditions, of feasible ones: 0 is a stationary point",
    "seconds": "as the entrant says",
}


def _each(row: pd.Series) -> list[Cell]:
    cost = "{:.6g}"
    ratio = row["cost"] / row["best_cost"] if row["best_cost"] > 0 else np.nan
    return [
        _text(row["status"]), _text("yes" if row["reached"] else "no"), _number(row["cost"], cost),
        _number(ratio, "{:.3f}"), _number(row["clearance"], "{:.3f}"), _number(row["violation"], "{:.2g}"),
        _number(row["kkt_residual"], "{:.1g}"), _number(row["seconds"], "{:.3g}"),
    ]  # fmt: skip


def _cells(row: pd.Series, trials: pd.DataFrame) -> list[Cell]:
    """The cells of RATED, from a row of a summary and the trials that it counts."""
    flights = trials[trials["solver"] == row["solver"]]
    shares = [Cell(rate(name)(row), float(row[f"{name}_rate"])) for name in ("success", "reached", "feasible")]
    median, most = row["cost_ratio_median"], row["cost_ratio_p90"]
    ratio = Cell("-" if np.isnan(median) else f"{median:.3f} ({most:.3f})", float(median))
    least = flights.loc[flights["reached"].astype(bool), "clearance"].min()
    return [*shares, ratio, _number(least, "{:.3f}"), _number(flights["seconds"].median(), "{:.3g}")]


def _number(value: Any, form: str) -> Cell:
    return Cell("-", np.nan) if pd.isna(value) else Cell(form.format(value), float(value))


def _text(value: Any) -> Cell:
    return Cell(str(value))


@dataclass(frozen=True)
class Leaderboard:
    """All entries of a folder, judged.

    Args:
        table: a row per layouts and entry: the texts of its card, and a summary.
        entries: those that were read.
        refused: by folder or file, why it was not.
        boards: of the page.
    """

    table: pd.DataFrame
    entries: Sequence[Entry]
    refused: Mapping[str, InputError]
    boards: Sequence[Board]

    @property
    def html(self) -> str:
        about = f"{len(self.entries)} entries, judged by torchgco-judge."
        return page("Leaderboard", about, self.boards, NOTES)


def leaderboard(
    folder: Path, words: Sequence[str] = (), trust: bool = False, say: Callable[[str], None] = lambda text: None
) -> Leaderboard:
    """Judge all entries of a folder; an entry, or a file of it, that can't be read is refused, and the others count.

    Raises:
        InputError: a folder without layouts or entries, or layouts that can't be read.
    """
    scenes = {path.stem: path for path in layouts_of(folder)}
    refused: dict[str, InputError] = {}
    entries, files = list[Entry](), dict[str, dict[str, Path]]()
    for entry_folder in entries_of(folder):
        try:
            entry = Entry.read(entry_folder)
            files[entry.id] = entry.files(list(scenes))
            entries.append(entry)
        except InputError as error:
            refused[entry_folder.name] = error
    rows, table, cards = list[list[Cell]](), list[dict[str, Any]](), {entry.id: entry for entry in entries}
    for name, path in scenes.items():
        say(name)
        entered = {entry: paths[name] for entry, paths in files.items() if entry in cards and name in paths}
        trials = _judged(Scene.read(path, words, trust=trust), entered, refused, trust)
        for _, row in (trials if trials.empty else summarise(trials)).iterrows():
            entry = cards[row["solver"]]
            rows.append([_text(name), _text(entry.name), *_cells(row, trials), *_said(entry)])
            counted = row.drop(["scenario", "solver", "seed"])
            table.append({"layouts": name, "entry": entry.id, **_card(entry), **counted})
    heads = [("layouts", "the file that is flown"), ("entry", "name of the solver"), *RATED.items(), *SAID.items()]
    boards = [Board("Results", heads, rows, keys=2), Board("Entries", CARD_HEADS, [_shown(entry) for entry in entries])]
    if refused:
        lines = [[_text(what), _text(error)] for what, error in refused.items()]
        boards.append(Board("Refused", [("entry", "folder or file"), ("why", "what was expected, and found")], lines))
    return Leaderboard(pd.DataFrame(table), entries, refused, boards)


def _judged(scene: Scene, files: Mapping[str, Path], refused: dict[str, InputError], trust: bool) -> pd.DataFrame:
    """The rows of all entries on some layouts, by their folders' names; no rows where there are none."""
    controls = list[Controls]()
    for entry, path in files.items():
        try:
            solvers = scene.controls(path, trust)
            if len(solvers) != 1:
                raise InputError("CONTROLS", "those of one solver in a file of an entry", len(solvers))
            controls.append(replace(solvers[0], name=entry))
        except InputError as error:
            refused[f"{entry}/{path.name}"] = error
    return scene.judged(controls) if controls else pd.DataFrame()


SAID = {"hardware": "as the entrant says", "seeds": "as the entrant says", "date": "of the flights"}
CARD_HEADS = [
    ("entry", "name of the solver"), ("who", "enters it"), ("what", "the method"), ("hardware", "as the entrant says"),
    ("seeds", "of all that is random"), ("seconds", "what they count"), ("date", "of the flights"),
    ("version", "of the code"),
]  # fmt: skip


def _said(entry: Entry) -> list[Cell]:
    return [_text(getattr(entry, name)) for name in SAID]


def _card(entry: Entry) -> dict[str, str]:
    names = ("name", "authors", "method", "hardware", "seeds", "time", "date", "version", "link")
    return {name: getattr(entry, name) for name in names}


def _shown(entry: Entry) -> list[Cell]:
    texts = [entry.authors, entry.method, entry.hardware, entry.seeds, entry.time, entry.date, entry.version]
    return [Cell(entry.name, link=entry.link or None), *map(_text, texts)]
