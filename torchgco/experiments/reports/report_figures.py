"""The figures of a report: what is drawn of trajectories and of missions, and under which names."""

from __future__ import annotations

from collections.abc import Callable

import pandas as pd
from matplotlib.figure import Figure

from torchgco.experiments.results.kinds import MISSION, Part
from torchgco.experiments.statistics.mission_statistics import summarise_missions
from torchgco.experiments.statistics.statistics import TASK, summarise, task_columns
from torchgco.plotting.distributions import clearance_figure, is_spread, violation_figure
from torchgco.plotting.missions import outcomes_figure
from torchgco.plotting.rates import rates_figure
from torchgco.plotting.sweeps import sweep_figure

Drawings = dict[str, Callable[[], Figure]]
FACETS = 6  # most tasks that have panels of their own; more are pooled over the swept variables


def drawings(part: Part) -> Drawings:
    """Functions that draw, by name: rates against every swept variable, then rates and distributions of each task.

    What would be empty isn't drawn: a distribution or shares of single trials.
    """
    mission = part.kind == MISSION
    named, again = ("outcomes", summarise_missions) if mission else ("rates", summarise)
    trials, summary, held = part.trials, part.summary, {}
    swept = task_columns(trials)[len(TASK) :]
    for name in swept:
        others = [other for other in swept if other != name]
        rows, table = trials[trials[name].notna()], summary[summary[name].notna()]
        if len(table[[*TASK, *others]].drop_duplicates()) > FACETS:
            table = again(rows.drop(columns=others))
        held[f"{named}-{name}"] = lambda table=table, name=name: sweep_figure(table, name)
    if len(summary[[*TASK, *swept]].drop_duplicates()) > FACETS:
        trials = trials.drop(columns=swept)
        summary = again(trials)
    if not mission:
        held["rates"] = lambda: rates_figure(summary)
    elif len(shown := several(trials)):
        held["outcomes"] = lambda: outcomes_figure(shown)
    return held | _distributions(trials, "missions-" if mission else "")


def several(trials: pd.DataFrame) -> pd.DataFrame:
    """The missions of those tasks in which a solver flew more than one: shares of a single mission say nothing."""
    tasks = task_columns(trials)
    counts = trials.groupby([*tasks, "solver"], sort=False, dropna=False, observed=True)["layout"].transform("size")
    most = trials.assign(_n=counts).groupby(tasks, sort=False, dropna=False, observed=True)["_n"].transform("max")
    return trials[most > 1]


def _distributions(trials: pd.DataFrame, prefix: str) -> Drawings:
    held: Drawings = {}
    if is_spread(trials, "clearance"):
        held[f"{prefix}clearance"] = lambda: clearance_figure(trials)
    if not prefix and is_spread(trials, "violation"):  # a mission's is that of its plans
        held["violation"] = lambda: violation_figure(trials)
    return held
