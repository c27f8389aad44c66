"""How a problem ended: one status per element, each with a sentence."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Ends of a solve; `sentence` says what each means for the user."""

    RUNNING = 0
    CONVERGED = 1
    MAX_ITERATIONS = 2
    LINE_SEARCH_FAILED = 3
    NOT_POSITIVE_DEFINITE = 4
    NON_FINITE = 5
    INFEASIBLE = 6
    INVALID_START = 7

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Status.RUNNING: "The solve has not ended.",
    Status.CONVERGED: "The solver's own test holds and the violation is under its tolerance.",
    Status.MAX_ITERATIONS: "The iteration limit was reached before the cost settled; try a higher limit.",
    Status.LINE_SEARCH_FAILED: "No step length gave an acceptable decrease; the problem may be badly scaled.",
    Status.NOT_POSITIVE_DEFINITE: "The regularised control Hessian stayed indefinite up to the largest regularisation.",
    Status.NON_FINITE: "A state, cost or derivative became NaN or infinite.",
    Status.INFEASIBLE: "The outer limit was reached and no iterate met the constraints; the least violated one is "
    "returned.",
    Status.INVALID_START: "The start lies inside an obstacle; nothing was solved.",
}
