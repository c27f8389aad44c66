"""The search of some layouts of a study, for its page: they are solved again with a record, which changes no bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.draws import DrawKey
from torchgco.base.errors import InputError
from torchgco.experiments.reports.finished import Study
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.problem.problem import Problem
from torchgco.solution import Solution
from torchgco.solvers import AugmentedLagrangian
from torchgco.solvers.contracts import Advice, Guidance
from torchgco.view.document import SearchPart
from torchgco.view.searches import search_of


class Guided(NamedTuple):
    """The guide region of a problem after one outer iteration."""

    number: int  # the problem's id
    outer: int  # the outer iteration
    balls: np.ndarray  # (K, d + 1): centres and radii, m, at the guided knots
    sample: np.ndarray  # (N+1, d): the trajectory that the balls lie along, m


@dataclass(frozen=True)
class Watched:
    """Another guidance, whose advice is passed on as it is and noted in `seen`.

    Args:
        guidance: that advises.
        seen: what it advised, in the order of the calls.
    """

    guidance: Guidance
    seen: list[Guided] = field(default_factory=list)

    def suited(self, problem: Problem) -> Self | None:
        suited = self.guidance.suited(problem)
        return None if suited is None else replace(self, guidance=suited)

    def start(self, problem: Problem, X: Tensor) -> GuideRegion | None:
        return self.guidance.start(problem, X)

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: GuideRegion | None, key: DrawKey) -> Advice:
        advice = self.guidance.update(problem, X, U, penalty, key)
        region = advice.penalty
        if isinstance(region, GuideRegion):
            for row in region.is_active.nonzero().flatten().tolist():
                center, radius = (z[row].detach().cpu().double().numpy() for z in (region.center, region.radius))
                here = np.isfinite(radius)
                balls = np.column_stack((center[here], radius[here]))
                self.seen.append(Guided(int(key.ids[row]), int(key.outer[row]), balls, center))
        return advice


def searches(study: Study, numbers: Sequence[int]) -> dict[int, SearchPart]:
    """What each solver that keeps a record did on the layouts of these numbers, by number; of missions, on first plans.

    Args:
        numbers: ids of some layouts of the study.

    Raises:
        InputError: missions with a sensor, whose search is that for a path on the map.
    """
    by_number: dict[int, SearchPart] = {}
    for name in study.manifest.solvers:
        solver, seen = study.solver(name).recording(), []
        if isinstance(solver, AugmentedLagrangian):
            if solver.guidance is None:
                continue
            watched = Watched(solver.guidance)
            solver, seen = replace(solver, guidance=watched), watched.seen
        for group in _alike(study, numbers):
            problem, solution = _solved(study, group, name, solver)
            for b, number in enumerate(group):
                record = search_of(solution, problem, b) or SearchPart()
                guides = [g for g in seen if g.number == number]
                if record.passes or record.rounds or guides:
                    whole = by_number.setdefault(number, SearchPart())
                    whole.passes.extend(f"{name}: {text}" for text in record.passes)
                    whole.rounds.extend((f"{name}: {text}", lines) for text, lines in record.rounds)
                    whole.guides.extend((f"outer iteration {g.outer}, {name}", g.balls, g.sample) for g in guides)
    return by_number


def _alike(study: Study, numbers: Sequence[int]) -> list[list[int]]:
    """The numbers of layouts that were solved together, as they have as many stages."""
    ids = study.layouts.ids.tolist()
    places = study.layouts.take([ids.index(number) for number in numbers]).alike()
    return [[numbers[i] for i in group] for group in places]


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
