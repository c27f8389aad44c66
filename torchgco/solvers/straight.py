"""States to begin with where the time is free: on straight lines, through gates, to what is asked of the last knot."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.base.products import product
from torchgco.base.shapes import MISTAKES
from torchgco.constraints.base import Constraint
from torchgco.constraints.gates import gates_of
from torchgco.obstacles.base import Obstacles
from torchgco.problem.problem import Problem

NEWTON_STEPS = 20  # of Gauss and Newton towards the rows of the last knot
ROUNDINGS = 4.0  # of the largest state: no smaller step is made
SOFT = 1e-12  # regularisation of a step, as a share of the largest entry of J J'


def straight_line(problem: Problem, towards: Tensor | None = None) -> Tensor:
    """States X (B, N+1, n), evenly from the start to `asked_of_the_end`; the position leads through the gates."""
    share = torch.linspace(0.0, 1.0, problem.N + 1, dtype=problem.x0.dtype, device=problem.x0.device).view(1, -1, 1)
    x0 = torch.where(torch.isfinite(problem.x0), problem.x0, 0.0).unsqueeze(1)
    X = (1.0 - share) * x0 + share * asked_of_the_end(problem, towards).unsqueeze(1)
    legs = Legs.of(problem, X[:, -1])
    if legs is not None:
        X[..., problem.position] = legs.positions(problem.N)
    settled = problem.dynamics.settled(X)
    return torch.where(torch.isfinite(settled), settled, X)


@dataclass(frozen=True)
class Legs:
    """The straight lines from the start through the gates to the end."""

    stops: Tensor  # (B, G+2, d), m
    knots: Tensor  # (B, G+2) int64: when each is passed

    @classmethod
    def of(cls, problem: Problem, end: Tensor) -> Legs | None:
        """Those of problems that end at states (B, n); None without gates."""
        gates, position = gates_of(problem), problem.dynamics.position
        if gates is None or position is None:
            return None
        first, last = torch.zeros_like(gates.places[:, :1]), torch.full_like(gates.places[:, :1], problem.N)
        stops = torch.cat((problem.x0[:, None, position], gates.centers, end[:, None, position]), dim=1)
        return cls(stops, torch.cat((first, gates.places, last), dim=1))

    @property
    def farthest(self) -> Tensor:
        """The stop (B, d) that is farthest from the start."""
        index = (self.stops - self.stops[:, :1]).norm(dim=-1).argmax(-1)
        return self.stops[torch.arange(len(index), device=index.device), index]

    def positions(self, N: int) -> Tensor:
        """(B, N+1, d): evenly along each leg from its knot to the next."""
        k = torch.arange(N + 1, device=self.knots.device).expand(len(self.knots), -1).contiguous()
        leg = self._leg(k)
        first, last = self.knots.gather(1, leg), self.knots.gather(1, leg + 1)
        share = ((k - first) / (last - first).clamp(min=1)).to(self.stops).unsqueeze(-1)
        index = leg.unsqueeze(-1).expand(-1, -1, self.stops.shape[-1])
        a, b = (self.stops.gather(1, index + shift) for shift in (0, 1))
        return (1.0 - share) * a + share * b

    def stage_factors(self, estimate: Tensor, N: int) -> Tensor:
        """Factors (B, N) of the stages, where the way to the farthest stop would take all in `estimate` (B, 1).

        As if the vehicle rested at each gate: times grow as the roots of lengths. That is long, and no leg is short.
        """
        far = (self.farthest - self.stops[:, 0]).norm(dim=-1, keepdim=True).clamp(min=1e-12)
        stages = self.knots.diff(dim=1).clamp(min=1)
        each = estimate * N * (self.stops.diff(dim=1).norm(dim=-1) / far).sqrt() / stages
        return each.gather(1, self._leg(torch.arange(N, device=self.knots.device).expand(len(each), -1).contiguous()))

    def _leg(self, k: Tensor) -> Tensor:
        """On which leg knots (B, K) are."""
        return (torch.searchsorted(self.knots, k, right=True) - 1).clamp(0, self.knots.shape[1] - 2)


def asked_of_the_end(problem: Problem, towards: Tensor | None = None) -> Tensor:
    """States (B, n) near the start that keep the rows of the last knot, as far as steps of Gauss and Newton find any.

    They begin at the state that the cost draws to, with the position of a stated goal, else at `towards` (B, n), or at
    the start. Obstacles don't count.
    """
    x0 = torch.where(torch.isfinite(problem.x0), problem.x0, 0.0)
    drawn = problem.cost.goal(problem.x0)
    near = x0 if towards is None else torch.where(torch.isfinite(towards), towards, x0)
    z = near.clone() if drawn is None else torch.where(torch.isfinite(drawn), drawn, near)
    if problem.goal is not None and not problem.goal.assumed:
        z[:, problem.position] = problem.goal.position
    parts = [c for c in problem.constraints if c.holds_at(problem.N) and not isinstance(c, Obstacles)]
    if not parts:
        return z
    rows = lambda z: torch.cat([last_rows(constraint, problem, z) for constraint in parts], dim=-1)
    for _ in range(NEWTON_STEPS):
        try:
            c, (J,) = rows(z), jacobian(rows, z)
        except MISTAKES:  # rows that PyTorch can't differentiate forwards: the guess stays where it is
            return z
        if not bool((c != 0).any()):
            return z
        A = product(J, J.mT)
        A = A + torch.diag_embed((SOFT * A.abs().amax((1, 2)) + 1e-300).unsqueeze(-1).expand_as(c))
        step = (J * torch.linalg.solve_ex(A, c.unsqueeze(-1)).result).sum(1)
        size = torch.maximum(z.abs(), x0.abs()).amax(-1)
        moves = step.abs().amax(-1) > ROUNDINGS * torch.finfo(z.dtype).eps * size  # which NaN isn't
        if not bool(moves.any()):
            return z
        z = torch.where((moves & torch.isfinite(step).all(-1)).unsqueeze(-1), z - step, z)
    return z


def last_rows(constraint: Constraint, problem: Problem, z: Tensor) -> Tensor:
    """The rows (B, p) of the last knot at z (B, n): of inequalities, by how much they are violated."""
    X = z.unsqueeze(1).expand(-1, problem.N + 1, -1)
    knots = torch.arange(problem.N + 1, device=z.device)[constraint.knots]
    index = int((knots == problem.N).nonzero()[0, 0])
    c = constraint.value(X, z.new_zeros(len(z), problem.N, problem.m))[:, index]
    return c if constraint.sense == "equality" else c.clamp(min=0.0)
