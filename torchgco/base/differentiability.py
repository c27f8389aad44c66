"""Whether a solution has derivatives: one reason per problem, each with a sentence."""

from __future__ import annotations

from enum import IntEnum


class Differentiability(IntEnum):
    """Why a problem's solution is differentiable or isn't; `sentence` explains each to the user."""

    DIFFERENTIABLE = 0
    NOT_ASKED = 1
    NOT_SOLVED = 2
    MOVED = 3
    NOT_STATIONARY = 4
    NOT_STRICT = 5
    DEPENDENT_ROWS = 6
    WEAKLY_ACTIVE = 7
    LEAVES_GOAL = 8
    ROWS_CHANGE = 9
    NOT_SMOOTHED = 10

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Differentiability.DIFFERENTIABLE: "The trajectory is a strict minimum, and rows that hold there stay so nearby.",
    Differentiability.NOT_ASKED: "Nothing that the problem depends on asked for gradients when it was solved.",
    Differentiability.NOT_SOLVED: "The solve found no feasible trajectory; its status says why.",
    Differentiability.MOVED: "The solver's trajectory is no minimum: iterations from there lead to another one.",
    Differentiability.LEAVES_GOAL: "The solver's trajectory reaches the goal, but the minimum nearby doesn't: terminal "
    "weights are too small for it.",
    Differentiability.NOT_STATIONARY: "The optimality conditions can't be met to the precision that derivatives need.",
    Differentiability.NOT_STRICT: "The minimum isn't strict: along some direction the cost is flat, or falls.",
    Differentiability.DEPENDENT_ROWS: "Constraints that hold depend on each other, so their multipliers aren't unique.",
    Differentiability.ROWS_CHANGE: "The change is too large for first order: on the way a constraint begins or ceases "
    "to hold.",
    Differentiability.NOT_SMOOTHED: "From the solver's trajectory, which is returned, no solution with this smoothing "
    "was found.",
    Differentiability.WEAKLY_ACTIVE: "A constraint is on the edge of holding, and derivatives differ on its two sides.",
}
