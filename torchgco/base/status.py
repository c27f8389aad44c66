"""How a problem ended: one status per problem, each with a sentence."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


class Status(IntEnum):
    """How a solve ended; `sentence` explains each status to the user."""

    RUNNING = 0
    CONVERGED = 1
    MAX_ITERATIONS = 2
    LINE_SEARCH_FAILED = 3
    NOT_POSITIVE_DEFINITE = 4
    NON_FINITE = 5
    INFEASIBLE = 6
    INVALID_START = 7
    FEASIBLE = 8
    TIME_LIMIT = 9
    UNBOUNDED = 10

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


# Within a solve, users never see these.
STOPPED = -1  # ended by guidance, for another attempt
STALLED = -2  # neither the violation nor the cost of a feasible trajectory falls any more
SOLVED = -3  # the optimality conditions hold to the solver's own tolerance
UNMOVED = -4  # the same but for violated rows that no variable moves: nothing that is tried could repair them

_SENTENCES = {
    Status.RUNNING: "The solve has not ended.",
    Status.CONVERGED: "The violation is under the tolerance, and the trajectory is stationary, or costs at most 0.1 % "
    "more to keep clear of an obstacle between two knots.",
    Status.FEASIBLE: "The violation is under the tolerance, but the trajectory is not stationary: its cost can be "
    "lowered.",
    Status.MAX_ITERATIONS: "The solve ended, by an iteration limit or its tolerance, before the trajectory was "
    "stationary; try a higher limit or a smaller tolerance.",
    Status.LINE_SEARCH_FAILED: "No step length gave an acceptable decrease before the trajectory was stationary; the "
    "problem may be badly scaled.",
    Status.NOT_POSITIVE_DEFINITE: "The regularised control Hessian stayed indefinite up to the largest regularisation.",
    Status.NON_FINITE: "A state, cost or derivative became NaN or infinite.",
    Status.INFEASIBLE: "No iterate met the constraints, and nothing that was tried lowers the violation further; the "
    "least violated trajectory is returned. `solution.explain` says what may help.",
    Status.TIME_LIMIT: "The time limit ended the solve before the trajectory was stationary or feasible.",
    Status.UNBOUNDED: "The cost falls without end, so there is no optimum; bound the controls or states that grow, or "
    "add a cost that keeps them small.",
    Status.INVALID_START: "The start lies inside an obstacle; nothing was solved.",
}


def is_over(status: Tensor) -> Tensor:
    """Whether nothing is left to solve, by statuses within a solve, of any shape."""
    return (status == SOLVED) | (status == UNMOVED)
