"""References of states where the time is free: when the vehicle is at a knot is a matter of a state.

All stages last the same multiple tau of dt, so knot k is at k dt tau, where a reference that is given at the nominal
times j dt is between two of its rows. A natural cubic spline through all of them is what solvers need: its second
derivative is continuous, so that the cost has no kinks in tau.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.numbers import Number
from torchgco.base.tree import passed_on
from torchgco.costs.base import Cost, WrappedCost


@dataclass(frozen=True)
class QuadraticInFreeTime(WrappedCost):
    """A quadratic cost whose references of states follow a time that is free.

    Before its first and after its last row a reference goes on evenly. One that rests at all stages is where the
    trajectory is drawn to on its way; its last row then counts at the end, whenever that is.
    """

    cost: Any  # a BoundQuadratic, with the references at the nominal times
    along: Tensor  # (B|1, N+1, n): coefficients of the B-splines around the rows
    rests: Tensor  # (B|1,) bool: the reference is the same at all stages

    batched: ClassVar[tuple[str, ...]] = ("cost",)
    per_element: ClassVar[tuple[str, ...]] = ("along", "rests")

    stage, terminal = passed_on("cost", "stage", "terminal")

    @classmethod
    def of(cls, cost: Any) -> QuadraticInFreeTime | None:
        """That of a BoundQuadratic; None where no reference of states differs from stage to stage."""
        along, rests = _read(cost)
        return None if bool(rests.all()) else cls(cost, along, rests)

    def write(self) -> None:
        """Read the references of `cost` as they are, in this memory."""
        for old, new in zip((self.along, self.rests), _read(self.cost), strict=True):
            old.copy_(new)

    def numbers(self, where: str) -> list[Number]:
        return self.cost.numbers(where, self.write)

    @property
    def of_errors(self) -> Cost:
        """The cost of what states differ by from references."""
        zero = torch.zeros_like(self.cost.xf_ref[:1])
        return replace(self.cost, x_ref=zero.unsqueeze(1), xf_ref=zero)

    def stage_at(self, x: Tensor, u: Tensor, k: int | Tensor, tau: Tensor) -> Tensor:
        """`stage` where stages last tau (...) times as long."""
        return self.of_errors.stage(x - self.reference(k * tau), u, k)

    def terminal_at(self, x: Tensor, tau: Tensor) -> Tensor:
        """`terminal` where stages last tau (...) times as long."""
        count = self.along.shape[1] - 1
        rests, there = (_spread(row, x) for row in (self.rests, self.cost.xf_ref))
        return self.of_errors.terminal(x - torch.where(rests, there, self.reference(count * tau)))

    def reference(self, s: Tensor) -> Tensor:
        """References (B, ..., n) at times s (B, ...), in stages of dt."""
        c, last = self.along, self.along.shape[1] - 1
        within = torch.where(s < 0.0, 0.0, torch.where(s < last, s, float(last)))
        ends = (_spread(slope, s, 1) for slope in (c[:, 1] - c[:, 0], c[:, -1] - c[:, -2]))
        ahead = torch.where((s < 0.0).unsqueeze(-1), *ends)
        c = torch.cat((2.0 * c[:, :1] - c[:, 1:2], c, 2.0 * c[:, -1:] - c[:, -2:-1]), dim=1)
        places = torch.arange(-1, last + 2, dtype=s.dtype, device=s.device)
        weights = bump(within.unsqueeze(-1) - places).unsqueeze(-1)
        return (weights * _spread(c, s, 2)).sum(-2) + (s - within).unsqueeze(-1) * ahead


def _read(cost: Any) -> tuple[Tensor, Tensor]:
    """The fields `along` and `rests` of a BoundQuadratic."""
    rests = (cost.x_ref == cost.x_ref[:, :1]).flatten(1).all(-1)
    rows = torch.cat((cost.x_ref, cost.xf_ref.unsqueeze(1)), dim=1)
    still = cost.x_ref[:, :1].expand_as(rows)
    return torch.where(rests.view(-1, 1, 1), still, coefficients(rows)), rests


def bump(t: Tensor) -> Tensor:
    """The cubic B-spline around 0, which is 0 beyond 2 on either side."""
    a = t.abs()
    b = 2.0 - a
    return torch.where(a < 1.0, 2.0 / 3.0 - t * t * (1.0 - 0.5 * a), torch.where(a < 2.0, b * b * b / 6.0, 0.0))


def coefficients(rows: Tensor) -> Tensor:
    """Of the natural cubic spline through rows (B, N+1, n), one apart: coefficients of the B-splines around them.

    They obey c_{k-1} + 4 c_k + c_{k+1} = 6 r_k, with c = r at both ends, where the second derivative is 0. Solved row
    by row: a problem's bits don't depend on the batch.
    """
    r = rows.unbind(1)
    shares, forward = [0.0], [r[0]]  # c_k = forward_k - shares_k c_{k+1}
    for row in r[1:-1]:
        pivot = 4.0 - shares[-1]
        forward.append((6.0 * row - forward[-1]) / pivot)
        shares.append(1.0 / pivot)
    c = [r[-1]]
    for value, share in zip(forward[:0:-1], shares[:0:-1], strict=True):
        c.append(value - share * c[-1])
    return torch.stack([r[0], *c[::-1]] if len(r) > 1 else c, dim=1)


def _spread(values: Tensor, like: Tensor, more: int = 0) -> Tensor:
    """Values (B|1, ...) with axes of length 1 after the first, so that they have `more` axes than `like`."""
    missing = like.dim() + more - values.dim()
    return values.view(len(values), *([1] * missing), *values.shape[1:])
