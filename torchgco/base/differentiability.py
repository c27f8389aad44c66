"""Whether a solution has derivatives: one reason per problem, each with a sentence."""

from __future__ import annotations

from torchgco.base.status import Explained


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
