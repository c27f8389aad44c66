"""python -m benchmarks.speed.guesses: how long eight guesses take beside one, and how often they find less.

Problems are drawn from general families that have several local optima. The first guess is the solver's own; in the
others each control goes from a drawn value to another, within half of its bounds.
"""

from __future__ import annotations

import time

import torch
from torch import Tensor

import torchgco
from benchmarks.families.general_problems import FAMILIES
from benchmarks.families.general_problems_base import Draws
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown
from torchgco import Guess, Problem, Solution, Status

NAMES = "pendulum", "cartpole", "double_pendulum", "acrobot", "bicycle_discs", "di2_clutter", "parallel_park"
LESS = 1e-3  # share of the cost
SOLVED = torch.tensor([int(Status.CONVERGED), int(Status.FEASIBLE)])


def guesses_of(problem: Problem, count: int, draw: Draws) -> list[Guess]:
    """The solver's own guess, and drawn ones."""
    bounds = problem.control_bounds
    assert bounds is not None
    low, high = (bound[:, 0] for bound in bounds.over(problem.N))
    low, high = low.clamp(min=-10.0), high.clamp(max=10.0)
    share = torch.linspace(0.0, 1.0, problem.N, dtype=low.dtype).view(1, -1, 1)
    middle, half = 0.5 * (low + high), 0.25 * (high - low)
    ends = lambda: (middle + half * draw(-1.0, 1.0, problem.m)).unsqueeze(1)
    return [Guess(), *(Guess(U0=(1.0 - share) * ends() + share * ends()) for _ in range(count - 1))]


def timed(problem: Problem, repeats: int, **how: object) -> tuple[float, Solution]:
    """Least processor seconds of so many solves, after one that compiles."""
    solve = lambda: torchgco.solve(problem, verbose=False, **how)  # type: ignore[call-overload]
    found, seconds = solve(), []
    for _ in range(repeats):
        began = time.process_time()
        found = solve()
        seconds.append(time.process_time() - began)
    return min(seconds), found


def worth(found: Solution) -> Tensor:
    """The cost (B,), infinite where nothing feasible was found."""
    return torch.where(torch.isin(found.status, SOLVED), found.cost, torch.inf)


def text(count: int, guesses: int, seed: int, repeats: int, solver: str) -> str:
    """The table."""
    rows = []
    for name in NAMES:
        draw = Draws(count, seed)
        problem = FAMILIES[name].make(draw).problem
        one, alone = timed(problem, repeats, solver=solver)
        several, best = timed(problem, repeats, solver=solver, guesses=guesses_of(problem, guesses, draw))
        before, after = worth(alone), worth(best)
        scale = before.abs().nan_to_num(0.0, 1.0)
        less, more = (after < before - LESS * scale).sum(), (after > before + LESS * scale).sum()
        solved = f"{int(torch.isfinite(before).sum())}, {int(torch.isfinite(after).sum())} of {count}"
        times = f"{1e3 * one / count:.1f}", f"{1e3 * several / count:.1f}", f"{several / one:.1f}"
        rows.append([name, problem.N, solved, int(less), int(more), *times])
    head = ["family", "stages", "solved by one, by all", "cheaper", "dearer", "ms of one", "ms of all", "ratio"]
    return markdown(head, rows)


main = Command(
    __doc__,
    "guesses",
    text,
    "{count} problems of each, seed {seed}, {guesses} guesses by `{solver}`, the least of {repeats} runs",
    count=(32, "problems of a family"),
    guesses=(8, "for each problem"),
    seed=(2718, "of problems and guesses"),
    repeats=(3, "runs, of which the fastest counts"),
    solver=("interior_point", "a preset"),
)

if __name__ == "__main__":
    raise SystemExit(main())
