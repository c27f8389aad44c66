"""What each pass of a search did for one problem, and each outer iteration of a recorded solve, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from torchgco.explaining.places import listed, number
from torchgco.explaining.record import Comparison, Fate, SearchRecord, Standing

if TYPE_CHECKING:
    import pandas as pd

FATES = {
    Fate.PROPOSED: "proposed",
    Fate.REFINED: "refined, but costs more",
    Fate.FAILED: "refined without a good end",
    Fate.RELAXED: "dropped as relaxed, others cost less",
    Fate.UNSOUND: "relaxed, but too deep in an obstacle or away from the goal",
    Fate.TRACKED: "dropped as tracked, others cost less",
}
TOLD_ITERATIONS = 12  # outer iterations that are told, the last ones


def passes_told(record: SearchRecord, b: int, problems: dict[int, str]) -> list[str]:
    """A line for each pass that worked on the problem at place b; of a second search, those of that one alone.

    Args:
        problems: by number of the pass, which problems it looks at.
    """
    lines, idle, before, kept = list[str](), list[int](), None, ""
    begun = _begun(record, b)
    again = begun > 0
    if again:
        lines.append("solved again with all obstacles, as the way found without the far ones touches one of these:")
    for i in range(begun, len(record.passes)):
        number_, name, worked = record.passes[i]
        standing = record.standings[i] if i < len(record.standings) else None
        after = None if standing is None else _Standing.of(standing, b)
        if b not in worked:
            idle.append(number_)
        else:
            of = f" ({problems[number_]})" if problems.get(number_) else ""
            told = _compared(record.comparisons, number_, b, again)
            told = told if told is not None else _gained(before, after)
            lines.append(f"{number_} {name}{of}: {told}")
            if after is not None and after != before:
                kept = f"{number_} ({name})"
        before = after or before
    if idle:
        lines.append(f"nothing to do for it: {listed(idle, 20)}")
    if kept:
        lines.append(f"returned is the trajectory of pass {kept}")
    return lines


def iterations_told(trace: pd.DataFrame, b: int) -> list[str]:
    """A line for each of the last outer iterations of the problem at place b, from the record of its iterations."""
    rows = trace[trace["element"] == b]
    if rows.empty:
        return []
    each = rows.groupby(["attempt", "outer"], sort=True)
    ends, counts = each.last(), each.size()
    lines = [
        f"outer iteration {outer + 1}{f' of attempt {attempt}' if ends.index[-1][0] > 1 else ''}: "
        f"{count} iteration{'s' if count > 1 else ''}, cost {number(end.cost)}, violation {number(end.violation)}"
        f"{', guided' if end.guided else ''}"
        for (attempt, outer), end, count in zip(ends.index, ends.itertuples(), counts, strict=True)
    ]
    left = len(lines) - TOLD_ITERATIONS
    return [f"{left} outer iterations before these", *lines[-TOLD_ITERATIONS:]] if left > 0 else lines


def is_pathless(record: SearchRecord, b: int) -> bool:
    """Whether paths were sought for the problem at place b, and none was found."""
    fates = [trial.fate[trial.rows == b] for trial in record.comparisons if bool((trial.rows == b).any())]
    return bool(fates) and all(bool((fate == Fate.ABSENT).all()) for fate in fates)


class _Standing(tuple[float, float, float, bool]):
    """Cost, violation, distance to the goal and arrival of one problem's best trajectory."""

    @classmethod
    def of(cls, standing: Standing, b: int) -> _Standing | None:
        index = (standing.rows == b).nonzero().flatten().tolist()
        if not index:
            return None
        parts = (standing.cost, standing.violation, standing.goal_distance, standing.arrived)
        return cls(values[index[0]].item() for values in parts)

    @property
    def told(self) -> str:
        cost, violation, away, arrived = self
        goal = "" if away != away else ", at the goal" if arrived else f", {number(away)} m from the goal"
        return f"cost {number(cost)}, violation {number(violation)}{goal}"


def _begun(record: SearchRecord, b: int) -> int:
    """Where the last search that worked on b begins among the passes."""
    begins = [i for i, (number_, _, _) in enumerate(record.passes) if number_ == 1]
    worked = [i for i, (_, _, rows) in enumerate(record.passes) if b in rows]
    last = max(worked, default=0)
    return max((begin for begin in begins if begin <= last), default=0)


def _gained(before: _Standing | None, after: _Standing | None) -> str:
    if after is None:
        return "no trajectory yet"
    if before is None:
        return after.told
    if tuple(after) == tuple(before):
        return "nothing better"
    return f"better: {after.told}"


def _compared(comparisons: list[Comparison], number_: int, b: int, again: bool) -> str | None:
    """What became of the candidates of a pass; None where it compared none."""
    lines = []
    for trial in comparisons:
        index = (trial.rows == b).nonzero().flatten().tolist()
        if trial.number == number_ and trial.again == again and index:
            lines.append(_fates(trial, index[0]))
    return ". Then ".join(lines) if lines else None


def _fates(trial: Comparison, i: int) -> str:
    followed = trial.fate[i] != Fate.ABSENT
    if not bool(followed.any()):
        return "found no path to the goal"
    paths, ways = trial.paths.shape[1], trial.path[i][followed].unique().numel()
    parts = []
    for fate, words in FATES.items():
        here = trial.fate[i] == fate
        if bool(here.any()):
            costs = trial.cost[i][here]
            costs = costs[torch.isfinite(costs)]
            ends = (costs.min(), costs.max()) if len(costs) else ()
            span = " to ".join(dict.fromkeys(number(float(cost)) for cost in ends))
            parts.append(f"{int(here.sum())} {words}{f' (cost {span})' if span else ''}")
    classes = f"{ways} homotopy class{'es' if ways > 1 else ''}"
    return f"{paths} paths, {classes}, {int(followed.sum())} candidates: {'; '.join(parts)}"
