"""The history of every problem, a row per iteration; solves of candidates are not recorded."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchgco.kernels import measured
from torchgco.lagrangian.state import PassEnd, State
from torchgco.problem.problem import Problem

if TYPE_CHECKING:
    import pandas as pd


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

        columns = (
            {name: torch.cat([row[name] for row in self._passes]).cpu().numpy() for name in self._passes[0]}
            if self._passes
            else {}
        )
        frame = pd.DataFrame(columns)
        if self._passes:
            scale = unit.cpu().numpy()[frame["element"]]
            for name in ("cost", "merit", "regularisation"):
                frame[name] *= scale
            for name in ("cost", "merit"):
                frame[name] += constant.cpu().numpy()[frame["element"]]
        return frame.sort_values(["element", "attempt", "iteration"], ignore_index=True) if self._passes else frame
