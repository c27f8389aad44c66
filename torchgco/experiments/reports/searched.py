"""The search of some layouts of a study, for its page: they are solved again with a record, which changes no bit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from torchgco.experiments.config.build import solver_from
from torchgco.scenarios import Layouts, Vehicle
from torchgco.solvers import AugmentedLagrangian
from torchgco.view.document import SearchPart
from torchgco.view.guides import Watched
from torchgco.view.searches import search_of


def searches(
    vehicle: Vehicle, layouts: Layouts, solvers: Mapping[str, Mapping[str, Any]], seed: int, numbers: Sequence[int]
) -> dict[int, SearchPart]:
    """What each solver that keeps a record did on the layouts of these numbers, by number.

    Args:
        layouts: of the study; numbers: some of their ids.
        solvers: settings by name, as study.json holds them.
    """
    places = [layouts.ids.tolist().index(number) for number in numbers]
    task, ids = vehicle.task(layouts.take(places)), torch.tensor(numbers)
    found: dict[int, list[SearchPart]] = {number: [] for number in numbers}
    for name, settings in solvers.items():
        solver, seen = solver_from(settings).recording(), []
        if isinstance(solver, AugmentedLagrangian):
            if solver.guidance is None:
                continue
            watched = Watched(solver.guidance)
            solver, seen = replace(solver, guidance=watched), watched.seen
        solution = solver.solve(task.problem, task.U0, seed=seed, ids=ids)
        for b, number in enumerate(numbers):
            part = search_of(solution, task.problem, b) or SearchPart([], [])
            own = [one for one in seen if one.number == number]
            guides = [(f"outer iteration {one.outer}", one.balls, one.sample) for one in own]
            if part.passes or part.rounds or guides:
                found[number].append(_named(replace(part, guides=guides), name))
    return {number: _joined(parts) for number, parts in found.items() if parts}


def _named(part: SearchPart, solver: str) -> SearchPart:
    return SearchPart(
        [f"{solver}: {text}" for text in part.passes],
        [(f"{solver}: {text}", lines) for text, lines in part.rounds],
        [(f"{solver}: {text}", balls, sample) for text, balls, sample in part.guides],
    )


def _joined(parts: Sequence[SearchPart]) -> SearchPart:
    return SearchPart(
        [text for part in parts for text in part.passes],
        [one for part in parts for one in part.rounds],
        [one for part in parts for one in part.guides],
    )
