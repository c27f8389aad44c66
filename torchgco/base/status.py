"""How a problem ended, and whether its solution has derivatives: one status or reason per problem, with a sentence."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from torch import Tensor


class Explained(IntEnum):
    """Whole numbers with a sentence each, for the user."""

    sentence: str

    def __new__(cls, number: int, sentence: str) -> Self:
        """A member, as it is written in its class: its number and sentence."""
        member = int.__new__(cls, number)
        member._value_, member.sentence = number, sentence
        return member


class Status(Explained):
    """How a solve ended; `sentence` explains each status to the user."""

    RUNNING = 0, "The solve has not ended."
    CONVERGED = 1, ("The violation is under the tolerance, and the trajectory is stationary, or costs at most 0.1 % "
        "more to keep clear of an obstacle between two knots.")  # fmt: skip
    MAX_ITERATIONS = 2, ("The solve ended, by an iteration limit or its tolerance, before the trajectory was "
        "stationary; try a higher limit or a smaller tolerance.")  # fmt: skip
    LINE_SEARCH_FAILED = 3, ("No step length gave an acceptable decrease before the trajectory was stationary; the "
        "problem may be badly scaled, or its constraints contradict each other.")  # fmt: skip
    NOT_POSITIVE_DEFINITE = 4, "The regularised control Hessian stayed indefinite up to the largest regularisation."
    NON_FINITE = 5, "A state, cost or derivative became NaN or infinite."
    INFEASIBLE = 6, ("No iterate met the constraints, and nothing that was tried lowers the violation further; the "
        "least violated trajectory is returned. `solution.explain` says what may help.")  # fmt: skip
    INVALID_START = 7, "The start lies inside an obstacle, or touches another vehicle of the fleet; nothing was solved."
    FEASIBLE = 8, "The violation is under the tolerance, but the trajectory is not stationary: its cost can be lowered."
    TIME_LIMIT = 9, "The time limit ended the solve before the trajectory was stationary or feasible."
    UNBOUNDED = 10, ("The cost falls without end, so there is no optimum; bound the controls or states that grow, or "
        "add a cost that keeps them small.")  # fmt: skip


# Within a solve, users never see these.
STOPPED = -1  # ended by guidance, for another attempt
STALLED = -2  # neither the violation nor the cost of a feasible trajectory falls any more
SOLVED = -3  # the optimality conditions hold to the solver's own tolerance
UNMOVED = -4  # the same but for violated rows that no variable moves: nothing that is tried could repair them


def is_over(status: Tensor) -> Tensor:
    """Whether nothing is left to solve, by statuses within a solve, of any shape."""
    return (status == SOLVED) | (status == UNMOVED)


class Differentiability(Explained):
    """Why a problem's solution is differentiable or isn't; `sentence` explains each to the user."""

    DIFFERENTIABLE = 0, "The trajectory is a strict minimum, and rows that hold there stay so nearby."
    NOT_ASKED = 1, "Nothing that the problem depends on asked for gradients when it was solved."
    NOT_SOLVED = 2, "The solve found no feasible trajectory; its status says why."
    MOVED = 3, "The solver's trajectory is no minimum: iterations from there lead to another one."
    NOT_STATIONARY = 4, "The optimality conditions can't be met to the precision that derivatives need."
    NOT_STRICT = 5, "The minimum isn't strict: along some direction the cost is flat, or falls."
    DEPENDENT_ROWS = 6, "Constraints that hold depend on each other, so their multipliers aren't unique."
    WEAKLY_ACTIVE = 7, "A constraint is on the edge of holding, and derivatives differ on its two sides."
    LEAVES_GOAL = 8, ("The solver's trajectory reaches the goal, but the minimum nearby doesn't: terminal weights are "
        "too small for it.")  # fmt: skip
    ROWS_CHANGE = 9, "The change is too large for first order: on the way a constraint begins or ceases to hold."
    NOT_SMOOTHED = 10, "From the solver's trajectory, which is returned, no solution with this smoothing was found."
