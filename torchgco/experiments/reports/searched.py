"""The search of some layouts of a study, for its page: they are solved again with a record, which changes no bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from torchgco.base.errors import InputError
from torchgco.experiments.reports.finished import Study
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers import AugmentedLagrangian
from torchgco.view.document import SearchPart
from torchgco.view.guides import Watched
from torchgco.view.searches import search_of


def searches(study: Study, numbers: Sequence[int]) -> dict[int, SearchPart]:
    """What each solver that keeps a record did on the layouts of these numbers, by number; of missions, on first plans.

    Args:
        numbers: ids of some layouts of the study.

    Raises:
        InputError: missions with a sensor, whose search is that for a path on the map.
    """
    found: dict[int, list[SearchPart]] = {number: [] for number in numbers}
    for name in study.manifest.solvers:
        solver, seen = study.solver(name).recording(), []
        if isinstance(solver, AugmentedLagrangian):
            if solver.guidance is None:
                continue
            watched = Watched(solver.guidance)
            solver, seen = replace(solver, guidance=watched), watched.seen
        for some in _alike(study, numbers):
            problem, solution = _solved(study, some, name, solver)
            for b, number in enumerate(some):
                part = search_of(solution, problem, b) or SearchPart([], [])
                own = [one for one in seen if one.number == number]
                guides = [(f"outer iteration {one.outer}", one.balls, one.sample) for one in own]
                if part.passes or part.rounds or guides:
                    found[number].append(_named(replace(part, guides=guides), name))
    return {number: _joined(parts) for number, parts in found.items() if parts}


def _alike(study: Study, numbers: Sequence[int]) -> list[list[int]]:
    """The numbers of layouts that were solved together, as they have as many stages."""
    ids = study.layouts.ids.tolist()
    places = study.layouts.take([ids.index(number) for number in numbers]).alike()
    return [[numbers[i] for i in some] for some in places]


def _solved(study: Study, numbers: Sequence[int], name: str, solver: Any) -> tuple[Problem, Solution]:
    """The problems of the layouts of some numbers, and the solutions; of missions, those of first plans."""
    places = [study.layouts.ids.tolist().index(number) for number in numbers]
    task, ids = study.vehicle.task(study.layouts.take(places)), torch.tensor(numbers)
    if not study.missions:
        return task.problem, solver.solve(task.problem, task.U0, seed=study.seed, ids=ids)
    mission = study.mission(name)
    if not mission.sees_all:
        expected = "missions that know all obstacles; with a sensor the page shows the path sought on the map"
        raise InputError("--search", expected, "missions with a sensor")
    planner = replace(mission.planner, solver=solver)
    return replace(mission, planner=planner).first_plans(task.problem, study.seed, ids)


def _named(part: SearchPart, solver: str) -> SearchPart:
    return SearchPart(
        [f"{solver}: {text}" for text in part.passes],
        [(f"{solver}: {text}", lines) for text, lines in part.rounds],
        [(f"{text}, {solver}", balls, sample) for text, balls, sample in part.guides],
    )


def _joined(parts: Sequence[SearchPart]) -> SearchPart:
    return SearchPart(
        [text for part in parts for text in part.passes],
        [one for part in parts for one in part.rounds],
        [one for part in parts for one in part.guides],
    )
