"""A study as one number, for sweepers that steer keys by it."""

from __future__ import annotations

from difflib import get_close_matches

import pandas as pd

from torchgco.base.errors import InputError
from torchgco.experiments.results.kinds import parts_of
from torchgco.experiments.statistics.missions import MEANS, MEDIANS
from torchgco.experiments.statistics.statistics import EFFORT, OUTCOMES, PAPER_OUTCOME
from torchgco.missions.outcome import Outcome

QUANTILES = [f"{name}_{suffix}" for name in ("cost_ratio", *EFFORT) for suffix in ("median", "p90")]
OF_TRAJECTORIES = (
    *(f"{name}_rate" for name in (*OUTCOMES, PAPER_OUTCOME)), "cost_median_reached", "cost_median", "violation_median",
    *QUANTILES,
)  # fmt: skip
OF_MISSIONS = (*(f"{outcome.name.lower()}_rate" for outcome in Outcome), *MEDIANS, *MEANS)


def check_objective(name: object, missions: bool) -> None:
    """Check that a study has a number of this name for its solver: a column of the summary.

    Raises:
        InputError: it has none.
    """
    names = OF_MISSIONS if missions else OF_TRAJECTORIES
    if name not in names:
        near = get_close_matches(str(name), names, n=1)
        expected = f"a number of the summary, such as {', '.join(near or names[:2])}"
        raise InputError("study.objective", expected, name)


def objective_of(trials: pd.DataFrame, name: str, solver: str) -> float:
    """The number of a solver in a study's trials.

    Raises:
        InputError: it isn't defined for these trials, as success is without a best cost.
    """
    value = float(parts_of(trials)[0].summary.set_index("solver")[name][solver])
    if value != value:
        raise InputError("study.objective", "a number that these trials define", f"{name}, which is undefined")
    return value
