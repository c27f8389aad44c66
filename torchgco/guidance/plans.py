"""Several plans for every problem of a batch: solved side by side, counted, and put in order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchgco.constraints.guides import Guide
from torchgco.lagrangian import Lagrangian, Multipliers
from torchgco.native.dispatch import open_loop, value
from torchgco.problem import Problem
from torchgco.shapes import take
from torchgco.solvers.ilqr import ILQR

AT_ONCE = 1536  # plans solved at once: memory stays bounded, however large the batch


@dataclass(frozen=True)
class Plans:
    """Some plans for each of B problems, those of one problem next to each other.

    Every tensor but `iterations` has a row for each plan.
    """

    problem: Problem
    U: Tensor
    R: Tensor  # m
    unit: Tensor  # q0 / R^4
    live: Tensor  # bool: the others are left as they are, and come last
    count: int  # plans of each problem
    iterations: Tensor  # (B,) int64: of all solves of a problem's plans so far, of plans dropped since, too

    def pick(self, order: Tensor) -> Plans:
        """The plans at the places `order` (B, c) among those of their problem."""
        rows = self.rows(order).flatten()
        U, R, unit, live = (t[rows] for t in (self.U, self.R, self.unit, self.live))
        return Plans(self.problem.take(rows), U, R, unit, live, order.shape[1], self.iterations)

    def rows(self, order: Tensor) -> Tensor:
        """Rows (B, c) of the plans at the places `order` (B, c)."""
        return torch.arange(order.shape[0], device=order.device).unsqueeze(-1) * self.count + order

    def duals(self, penalty: float) -> Multipliers:
        """No multipliers yet, and a penalty in q0 / R^4."""
        return replace(Multipliers.zero(self.problem, 0.0), mu=penalty * self.unit)

    def solved(self, inner: ILQR, penalty: float, guide: Guide | None = None) -> Plans:
        """The plans after one inner solve of every live one, with a penalty in q0 / R^4."""
        U, duals, iterations = self.U.clone(), self.duals(penalty), self.iterations
        for rows in self.live.nonzero().flatten().split(AT_ONCE):
            if rows.numel() > 0:
                warm, drawn = take(duals, rows), take(guide, rows)
                end = inner.solve(self.problem.take(rows), U[rows], warm=warm, guide=drawn)
                U[rows] = end.U
                iterations = iterations.index_add(0, rows // self.count, end.iterations)
        return replace(self, U=U, iterations=iterations)

    def order(self, penalty: float, first: Tensor, alike: float | None = None) -> Tensor:
        """Each problem's plans as places in their order, (B, count).

        Those in `first` come before the others; then the cost with a penalty in q0 / R^4 decides. Of those in `first`
        whose costs differ by at most `alike`, as a share, all but the cheapest are put behind.
        """
        rows = self.live.nonzero().flatten()
        problem, U, duals = self.problem.take(rows), self.U[rows], take(self.duals(penalty), rows)
        X = open_loop(problem, U)
        merit, first = torch.full_like(self.unit, torch.inf), first & self.live
        merit[rows] = value(Lagrangian(problem, duals, None, True), X, U)[1]
        merit, order = merit.nan_to_num(torch.inf).view(-1, self.count).sort(dim=-1, stable=True)
        later = (~first).view(-1, self.count).gather(1, order).to(torch.int8)
        later, again = later.sort(dim=-1, stable=True)
        merit, order = merit.gather(1, again), order.gather(1, again)
        if alike is not None:
            same = merit[:, 1:] - merit[:, :-1] <= alike * merit[:, :-1].abs()
            later[:, 1:] += same & (later[:, 1:] == 0)
            order = order.gather(1, later.argsort(dim=-1, stable=True))
        return order
