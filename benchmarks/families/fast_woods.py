"""python -m benchmarks.families.fast_woods: woods at 5.3 m/s, with goals stated and required, fixed and free times.

The layouts are those of `torchgco scenario=woods`, with 80 stages of 0.05 s for 21 m. Costs grow with the time that is
spent away from the goal, so that a free time is short without a price of its own. It is guessed as 4 and as 8 s.
"""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import chosen, crossed, filed, markdown, share
from torchgco import FreeTime, Goal, Problem

STAGES = 80
DENSITIES = 0.05, 0.1, 0.15, 0.2
GUESSES = 1.0, 2.0  # multiples of 4 s
TIMES = FreeTime(least=0.5, most=4.0, weight=0.0)
NEAR = 1e-2  # share of the cost
HEAD = ("trunks per m^2", "goal", "reached", "duration, s", "cost", "s a wood",
        "both within 1 % of the cost, of what either solves")  # fmt: skip


def variants(problem: Problem) -> dict[str, Problem]:
    """The same woods, by what is asked for."""
    assert problem.goal is not None
    required = replace(problem, goal=Goal(problem.goal.position, problem.goal.radius, required=True))
    free = {f"required, free time from {4 * g:g} s": replace(required, time=replace(TIMES, guess=g)) for g in GUESSES}
    return {"stated, 4 s": problem, "required, 4 s": required, **free}


def text(count: int, seed: int) -> str:
    """The filed table; how many woods are crossed, and what a free time gives."""
    rows = []
    for density in DENSITIES:
        setup = torchgco.compose(["scenario=woods", f"scenario.density={density}", f"scenario.stages={STAGES}"])
        task = setup.task(setup.scenario.draw(range(count), seed))
        costs = list[Tensor]()
        for name, problem in variants(task.problem).items():
            began = time.process_time()
            found = torchgco.solve(problem, verbose=False)
            spent = (time.process_time() - began) / count
            times = None if problem.time is None else found.t
            verdict = torchgco.judge(problem, found.U, task.goal, task.goal_radius, times=times)
            arrived = verdict.reached
            costs.append(torch.where(arrived, found.cost, torch.inf))
            cells = [f"{float(part.median()):.{d}f}" for part, d in ((found.duration, 2), (found.cost[arrived], 0))]
            rows.append([f"{density:g}", name, share(int(arrived.sum()), count), *cells, f"{spent:.2f}"])
        low, high = torch.stack(costs[-len(GUESSES) :]).aminmax(dim=0)
        alike = high.isfinite() & (high <= (1.0 + NEAR) * low)
        rows[-1].append(f"{int(alike.sum())} of {int(low.isfinite().sum())}")
    table = markdown(HEAD, [row + [""] * (len(HEAD) - len(row)) for row in rows])
    free = chosen(table, (HEAD[0], *HEAD[3:6]), goal=("required, free time from 4 s",))
    return filed("free_time-woods", table, crossed(table, "goal", HEAD[0], HEAD[2]), free)


main = Command(
    __doc__, "free_time", text, "{count} drawn woods of each density, seed {seed}", mark="fast_woods",
    count=(32, "woods of each density"), seed=(0, "of the woods"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
