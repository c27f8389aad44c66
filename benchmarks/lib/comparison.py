"""Solvers compared on the same problems: each flies all of them, one judge counts, and a table has a row per solver.

A flight is a table with a row per problem: `solver`, what the judge counts (`cost` and `violation` at least),
`iterations` and `seconds`, and what else a benchmark needs. A problem for which a solver did not return has NaN there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from torch import Tensor

from benchmarks.lib.page import markdown, share
from torchgco import Problem, Solution
from torchgco.base.clock import processor_seconds

T = TypeVar("T")
Column = Callable[[pd.DataFrame, pd.DataFrame], Any]  # a cell, from a flight and from that of the peer


@dataclass(frozen=True)
class Comparison:
    """What is counted, and how it is shown.

    Args:
        judge: columns of a flight from problems and controls (B, N, m); it shares no code with the solvers.
        columns: names and cells of the table's columns.
    """

    judge: Callable[[Problem, Tensor], Mapping[str, Any]]
    columns: Sequence[tuple[str, Column]]

    def fly(self, solver: str, problem: Problem, solve: Callable[[], Solution], **more: Any) -> pd.DataFrame:
        """The flight of one solver; set-up and compilation are to be done before.

        Args:
            solver: its name in the table.
            problem: all problems, as one batch.
            solve: solves them; its processor time counts, divided by their number.
            more: further columns of the flight.
        """
        solution, seconds = timed(solve)
        return self.judged(solver, problem, solution.U, solution.iterations, seconds / problem.B, **more)

    def judged(
        self, solver: str, problem: Problem, U: Tensor, iterations: Tensor, seconds: Any, **more: Any
    ) -> pd.DataFrame:
        """The flight of controls (B, N, m) that were returned after some seconds per problem."""
        held = {"iterations": iterations, "seconds": seconds, **self.judge(problem, U), **more}
        return pd.DataFrame({"solver": [solver] * problem.B} | {name: _plain(value) for name, value in held.items()})

    def rows(self, flights: Iterable[pd.DataFrame], peer: pd.DataFrame) -> list[list[Any]]:
        """A row per flight; where a column compares, with that of `peer`."""
        return [[column(flight, peer) for _, column in self.columns] for flight in flights]

    def table(self, rows: Sequence[Sequence[Any]]) -> str:
        """Rows in Markdown, below the names of the columns."""
        return markdown([name for name, _ in self.columns], rows)


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """The result of `work`, and its processor time, s, without tracing and compiling."""
    began = processor_seconds()
    result = work()
    return result, processor_seconds() - began


def _plain(value: Any) -> Any:
    return value.numpy() if isinstance(value, Tensor) else value


# Columns that several tables have.


def named(name: str) -> Column:
    """The same for all problems of a flight."""
    return lambda own, peer: own[name].iloc[0]


def count(own: pd.DataFrame, peer: pd.DataFrame) -> int:
    """The number of problems."""
    return len(own)


def within(limit: float) -> Column:
    """How many problems are within a violation."""
    return lambda own, peer: f"{(own.violation <= limit).sum()} of {len(own)}"


def share_within(limit: float, digits: int = 0) -> Column:
    """The same, with its interval."""
    return lambda own, peer: f"{share((own.violation <= limit).sum(), len(own), digits)} %"


def worst(name: str) -> Column:
    """The largest of all problems."""
    return lambda own, peer: f"{own[name].max():.0e}"


def mean(name: str, digits: int) -> Column:
    """Over the problems for which the solver returned."""
    return lambda own, peer: f"{own[name].mean():.{digits}f}" if own[name].notna().any() else "-"


def median(name: str, digits: int) -> Column:
    """As for `mean`."""
    return lambda own, peer: f"{own[name].median():.{digits}f}" if own[name].notna().any() else "-"


def cost_ratios(limit: float) -> Column:
    """Least, median and largest share of the peer's cost, where both are within a violation."""

    def cell(own: pd.DataFrame, peer: pd.DataFrame) -> str:
        same = peer.loc[own.index]
        ratio = (own.cost / same.cost)[(own.violation <= limit) & (same.violation <= limit)]
        return ", ".join(f"{x:.4f}" for x in np.quantile(ratio, (0, 0.5, 1))) if len(ratio) else "-"

    return cell
