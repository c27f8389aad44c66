"""The two forms of the algorithm, as the paper prints it and as it runs by default: what differs around inner solves.

What differs in these, `ilqr.descent` says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.solvers.contracts import Call


@dataclass(frozen=True)
class Rules:
    """What differs between the two forms.

    Attributes:
        in_cost_units: costs are in units of `Problem.cost_unit`, so that scaling all weights changes no iterate; else
            in their own.
        phr: the terms of an inequality are those of Powell, Hestenes and Rockafellar; else as printed (see
            `lagrangian.penalty_weights`).
        ends: a solve ends where it has converged, and mu grows only while the violation is over its tolerance; else
            only the outer limit ends it, and mu always grows.
    """

    in_cost_units: bool
    phr: bool
    ends: bool

    def in_units(self, call: Call) -> tuple[Call, Tensor]:
        """The call in the units of cost that the solver works in, and these units (B,)."""
        return call.in_cost_units() if self.in_cost_units else (call, torch.ones_like(call.problem.x0[:, 0]))


PRINTED = Rules(in_cost_units=False, phr=False, ends=False)
STANDARD = Rules(in_cost_units=True, phr=True, ends=True)
RAW = replace(STANDARD, in_cost_units=False)
