"""Problems whose rows within stages keep a little more distance: a second solve is denser than the first."""

from __future__ import annotations

from typing import Any

from torchgco.base.errors import InputError
from torchgco.problem.in_time import at_times
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution


def tightened(problem: Problem, solution: Solution) -> Problem:
    """The problem whose `BetweenKnots` rows answer the excess of a solution between their points.

        solution = torchgco.solve(problem)
        for _ in range(5):
            problem = torchgco.tightened(problem, solution)
            solution = torchgco.solve(problem, warm=solution)

    A row's largest violations within each stage are sought at 65 instants. Between two points that hold the trajectory
    both keep it further by 1.05 times as much; elsewhere a point of the stage moves to where it is. What is left falls
    four times or more in each round. The first one compiles another form. The rows' multipliers are those of the
    tightened rows; `judge` of the first problem tells what is left.

    Raises:
        InputError: no `BetweenKnots` in the problem; a solution of another form.
    """
    problem = current_problem(problem)
    problem.check_controls(solution.U, "solution.U")
    whole, X, U = at_times(problem, solution.X, solution.U, solution.times)
    rows: list[Any] = list(problem.constraints)
    within = [i for i, row in enumerate(rows) if row.tightened is not None]
    if not within:
        raise InputError("problem", "one with BetweenKnots", "none among its constraints")
    for i in within:
        rows[i] = rows[i].tightened(whole.constraints[i].bare, X, U, solution.multipliers.lam[i])
    made = problem._with({"constraints": tuple(rows)})  # of the same code, with other numbers: nothing to check
    made._set(given=problem.given and problem.given.started(problem, problem.x0, rows, None, None))
    return made
