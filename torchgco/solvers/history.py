"""The history of every problem, a row per iteration; solves of candidates are not recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchgco.kernels import measured
from torchgco.lagrangian.lagrangian import PassEnd, State
from torchgco.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd


ORDER = ["element", "attempt", "iteration"]  # of a trace's rows


class Recorder:
    """Collects one small tensor per pass and column; the table is made once, at the end."""

    def __init__(self) -> None:
        self._passes: list[dict[str, Tensor]] = []
        self.attempt = 1

    def add(self, problem: Problem, rows: Tensor, state: State, end: PassEnd) -> None:
        """Record the iteration just made by the problems `rows` of the batch, except where the backward pass failed."""
        guided = state.penalty.is_active if state.penalty is not None else torch.zeros_like(end.failed)
        row = {
            "element": rows,
            "attempt": torch.full_like(rows, self.attempt),
            "iteration": state.iterations - 1,
            "outer": state.outer,
            "inner": state.inner - 1,
            "cost": state.cost,
            "merit": state.merit,
            "alpha": end.alpha,
            "regularisation": end.used,
            "violation": measured(problem, state.X, state.U),
            "guided": guided,
        }
        self._passes.append({name: value[~end.failed].clone() for name, value in row.items()})

    def frame(self, unit: Tensor, constant: Tensor) -> pd.DataFrame:
        """The table, sorted by element (the problem), attempt and iteration.

        By place in the batch, `unit` is the unit that costs were divided by, `constant` what was subtracted from them
        before; the table holds the costs as they were.
        """
        import pandas as pd

        if not self._passes:
            return pd.DataFrame()
        columns = {name: torch.cat([row[name] for row in self._passes]).cpu().numpy() for name in self._passes[0]}
        return in_units(pd.DataFrame(columns), unit, constant).sort_values(ORDER, ignore_index=True)


def in_units(trace: pd.DataFrame, unit: Tensor, constant: Tensor) -> pd.DataFrame:
    """A trace with costs times a unit, plus a constant, both by place in the batch."""
    if trace.empty:
        return trace
    scale, more = unit.cpu().numpy()[trace["element"]], constant.cpu().numpy()[trace["element"]]
    costs = {name: trace[name] * scale for name in ("cost", "merit", "regularisation")}
    return trace.assign(**costs | {name: costs[name] + more for name in ("cost", "merit")})


def appended(trace: pd.DataFrame | None, later: pd.DataFrame | None) -> pd.DataFrame | None:
    """Two traces as one, in which each problem's attempts of the later one are numbered on."""
    if trace is None or later is None or trace.empty or later.empty:
        return later if trace is None or trace.empty else trace
    import pandas as pd

    before = trace.groupby("element")["attempt"].max()
    numbered = later.assign(attempt=later["attempt"] + later["element"].map(before).fillna(0).astype(int))
    return pd.concat((trace, numbered)).sort_values(ORDER, ignore_index=True)
