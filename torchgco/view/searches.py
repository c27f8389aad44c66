"""The record of a search (`Solution.search`) as the page shows it on demand."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from torchgco.problem.problem import Problem
from torchgco.solution import Comparison, Fate, SearchRecord, Solution
from torchgco.view.document import Line, SearchPart, whole

SEARCH_STEPS = ("tracked", "relaxed", "refined")


def search_of(solution: Solution, problem: Problem, b: int) -> SearchPart | None:
    """What the search did for problem b; None where there is no record."""
    record = solution.search
    if record is None:
        return None
    passes = [name for _, name, rows in record.passes if b in rows]
    rounds = []
    for comparison in record.comparisons:
        for i in (comparison.rows == b).nonzero().flatten().tolist():
            lines = [*_caught(record, problem, b), *_paths(comparison, i), *_candidates(comparison, problem, i)]
            count = int((comparison.fate[i] != int(Fate.ABSENT)).sum())
            rounds.append((f"pass {comparison.number}, {count} candidates", lines))
    return SearchPart(passes, rounds)


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()


def _caught(record: SearchRecord, problem: Problem, b: int) -> list[Line]:
    if record.caught is None:
        return []
    rows, states = record.caught
    indices = (rows == b).nonzero().flatten().tolist()
    return [Line(whole(_array(states[i]))[:, problem.position], "caught", 0, "", "") for i in indices]


def _paths(comparison: Comparison, i: int) -> list[Line]:
    """The paths of the roadmap that are there, each in its homotopy class."""
    lines = []
    for path in range(comparison.paths.shape[1]):
        corners = whole(_array(comparison.paths[i, path]))
        if len(corners) > 1:
            group = int(comparison.classes[i, path])
            length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
            same = "" if group == path else f", of the class of path {group + 1}"
            lines.append(Line(corners, "path", group, "", f"path {path + 1}: {length:.2f} m{same}"))
    return lines


def _candidates(comparison: Comparison, problem: Problem, i: int) -> list[Line]:
    """The trajectories of each candidate after each step that it reached; its fate is said once, with the last."""
    lines = []
    for c in range(comparison.fate.shape[1]):
        fate = Fate(int(comparison.fate[i, c]))
        if fate == Fate.ABSENT:
            continue
        path, cost = int(comparison.path[i, c]), float(comparison.cost[i, c])
        steps = {step: whole(_array(getattr(comparison, step)[i, c]))[:, problem.position] for step in SEARCH_STEPS}
        reached = [step for step, points in steps.items() if len(points) > 1]
        told = f"candidate {c + 1} along path {path + 1}: {fate.name.lower()}"
        told += f", cost {cost:.6g}" if np.isfinite(cost) else ""
        for step in reached:
            text = told if step == reached[-1] else ""
            lines.append(Line(steps[step], step, int(comparison.classes[i, path]), fate.name.lower(), text))
    return lines
