"""The layouts of a study that its solver failed on, explained in words."""

from __future__ import annotations

import textwrap
from dataclasses import replace

import numpy as np
import pandas as pd
import torch

from torchgco.base.status import Status
from torchgco.experiments.flying.tasks import Tasks
from torchgco.explaining.advice import Facts, advice
from torchgco.explaining.explain import LINE_WIDTH, explanation, map_facts

EXPLAINED = 8  # layouts at most


def advised(tasks: Tasks, trials: pd.DataFrame) -> str:
    """What to try for the layouts whose goal the solver under study didn't reach; "" where it reached all.

    As `Solution.explain` has it, without solving again: of the first layouts, each sentence with those that it is for.
    """
    setup = tasks.setup
    flown = trials[trials["solver"] == setup.solver_name]
    short = flown[~flown["reached"].astype("boolean").fillna(False).astype(bool)]
    if len(short) == 0:
        return ""
    shown = short.head(EXPLAINED)
    sentences: dict[str, list[str]] = {}
    for row in shown.to_dict("records"):
        problem, status = tasks.of([row["layout"]]).problem, Status[str(row["status"])]
        facts = Facts(
            status, setup.solver, hasattr(setup.solver, "passes"), bool(problem.obstacles), False, None,
            float(row["clearance"]), **map_facts(problem, status, False),
        )  # fmt: skip
        for sentence in [*facts.told[1:], *advice(facts)]:
            sentences.setdefault(sentence, []).append(str(row["layout"]))
    more = f", the first {len(shown)} of them here" if len(short) > len(shown) else ""
    lines = [f"\n{setup.solver_name} did not reach {len(short)} of {len(flown)} goals{more}. What to try:"]
    for sentence, places in sentences.items():
        layouts_told = f"layout{'s' if len(places) > 1 else ''} {', '.join(places)}: "
        lines.append(textwrap.fill(layouts_told + sentence, LINE_WIDTH, initial_indent="  ", subsequent_indent="    "))
    return "\n".join([*lines, "study.explain=true tells what was tried."])


def where_to_start(tasks: Tasks) -> str:
    """What a study needs all of whose layouts begin inside an obstacle."""
    if tasks.layouts.vehicles is not None:
        return "fleets of which one starts outside its obstacles"
    problem = tasks.of([0], exact=True).problem
    unknown = map_facts(problem, Status.INVALID_START, False)["in_unknown"]
    free = ", or scenario.unknown=free, as unknown cells count as occupied" if unknown else ""
    return f"a layout whose start is outside its obstacles{free}"


def explained(tasks: Tasks, trials: pd.DataFrame) -> str:
    """What happened to the first layouts that the solver under study failed on.

    Failed are those without success, where that is known, else those whose goal wasn't reached. They are solved again
    with a record, by which no bit of a result changes.
    """
    name = tasks.setup.solver_name
    flown = trials[trials["solver"] == name]
    failed = flown.loc[~flown["success"].fillna(flown["reached"]).astype(bool), "layout"].tolist()
    if not failed:
        return f"\n{name} failed on no layout: there is nothing to explain."
    shown = failed[:EXPLAINED]
    by_layout = dict[int, str]()
    for rows in tasks.layouts.take(shown).alike():
        by_layout |= _told(tasks, np.array(shown)[rows])
    texts = [by_layout[number] for number in shown]
    more = f", the first {len(shown)} of them here" if len(failed) > len(shown) else ""
    return "\n\n".join([f"\n{name} failed on {len(failed)} of {len(flown)} layouts{more}.", *texts])


def _told(tasks: Tasks, places: np.ndarray) -> dict[int, str]:
    """What happened to layouts with as many stages, by their numbers."""
    setup, task = tasks.setup, tasks.of(places)
    ids = torch.as_tensor(places, device=setup.device)
    solution = setup.solver.recording().solve(task.problem, task.U0, seed=setup.seed, ids=ids)
    solution = replace(solution, account=solution.account.asked(task.problem, setup.solver_name))
    return {number: explanation(solution, i, what=f"Layout {number}") for i, number in enumerate(places.tolist())}
