"""The augmented Lagrangian: state, value, expansion, update, violation report (Equations 17-22)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchgco.base.errors import InputError
from torchgco.base.shapes import check_tensor
from torchgco.base.tree import Rows, copied, take
from torchgco.constraints.base import Sense
from torchgco.lagrangian.penalties import Penalty
from torchgco.problem.horizons import counted
from torchgco.problem.problem import Problem


def linearise(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """F (N, B, n+1, s) with [dx_{k+1}, 1] = F_k [dx_k, 1, du_k], around X (B, N+1, n), U (B, N, m).

    Stage first, as the backward pass reads it.
    """
    n, m, (B, N) = problem.n, problem.m, U.shape[:2]
    fx, fu = problem.along.jacobians(X[:, :-1], U)
    F = X.new_zeros(N, B, n + 1, n + 1 + m)
    F[..., :n, :n] = fx.transpose(0, 1)
    F[..., :n, n + 1 :] = fu.transpose(0, 1)
    F[..., n, n] = 1.0
    return F


def quadratise(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """H (B, N+1, s, s): gradient and Hessian of J_var at every knot; the last block has no control part."""
    s = problem.n + 1 + problem.m
    H = X.new_empty(*X.shape[:2], s, s)
    problem.cost.expand(X, U, H)
    return H


@dataclass(frozen=True)
class Multipliers:
    """The state of the outer loop: one lam (B, K, p) per constraint, and one penalty per problem."""

    lam: tuple[Tensor, ...]
    mu: Tensor  # (B,)

    blank: ClassVar[bool] = False  # whether they are `none`

    @classmethod
    def zero(cls, problem: Problem, mu: float) -> Multipliers:
        """lam = 0 and the same penalty for all."""
        lam = tuple(problem.x0.new_zeros(problem.B, *shape) for shape in problem.row_shapes)
        return cls(lam, problem.x0.new_full((problem.B,), mu))

    @classmethod
    def none(cls, problem: Problem, mu: Tensor) -> Multipliers:
        """lam = 0 that takes no memory and can't be written to, and penalties mu (B,)."""
        zero = problem.x0.new_zeros(())
        made = cls(tuple(zero.expand(problem.B, *shape) for shape in problem.row_shapes), mu)
        object.__setattr__(made, "blank", True)
        return made

    def scaled(self, factor: Tensor) -> Multipliers:
        """The multipliers and penalties of the same problems with their costs times `factor` (B,)."""
        return Multipliers(tuple(factor.view(-1, 1, 1) * lam for lam in self.lam), factor * self.mu)

    def shifted(self, steps: float = 1, problem: Problem | None = None) -> Multipliers:
        """Those of the same problems some stages later: every knot takes the values of a later one; see `shifted`.

        Args:
            problem: says at which knots the rows are, and the horizons; None: at knots that follow each other.
        """
        if problem is None:
            return Multipliers(tuple(shifted(lam, steps) for lam in self.lam), self.mu)
        all_knots, lam = torch.arange(problem.N + 1, device=problem.x0.device), []
        for values, constraint in zip(self.lam, problem.constraints, strict=True):
            knots = all_knots[constraint.knots]
            last = None
            if problem.horizon is not None:
                last = counted(constraint, problem.horizon, problem.N).long().cumprod(-1).sum(-1) - 1
            lam.append(shifted(values, steps, knots.tolist(), last))
        return Multipliers(tuple(lam), self.mu)

    def check(self, problem: Problem) -> None:
        """Raise InputError unless these multipliers belong to a problem of this form (a warm start)."""
        if not isinstance(self.lam, tuple) or not all(isinstance(values, Tensor) for values in (*self.lam, self.mu)):
            raise InputError("warm", "multipliers that are tensors", type(self.lam).__name__)
        want = [(problem.B, *shape) for shape in problem.row_shapes]
        for mine, expected in ((self.lam, want), ((self.mu,), [(problem.B,)])):
            got = [tuple(values.shape) for values in mine]
            if got != expected:
                raise InputError("warm", f"multipliers of shapes {expected}", got)
        for values in (*self.lam, self.mu):
            check_tensor(values, "warm", problem.x0)


def later(knots: Sequence[int], steps: int) -> list[int]:
    """The places of the knots `steps` stages later: the last one beyond the end, a knot's own where there is none."""
    index, last = {knot: i for i, knot in enumerate(knots)}, max(knots, default=0)
    return [index.get(knot + steps, index[last] if knot + steps > last else i) for i, knot in enumerate(knots)]


def shifted(values: Tensor, steps: float = 1, knots: Sequence[int] | None = None, last: Tensor | None = None) -> Tensor:
    """Values (B, K, ...) of knots some stages later: those beyond the last one are its own.

    Args:
        steps: at least 0; part of a stage takes the straight line between what whole stages give.
        knots: K of them, to which the values belong; where the later one isn't among them, a knot keeps its value.
            None: they follow each other.
        last: int64 (B,), the place of each problem's last knot; the values after it stay. None: K - 1.
    """
    K, whole = values.shape[1], int(steps)
    if whole != steps:
        values = shifted(values, whole, knots, last)
        return torch.lerp(values, shifted(values, 1, knots, last), steps - whole)
    if steps == 0:
        return values
    if knots is None and last is None and steps == 1:
        return torch.cat((values[:, 1:], values[:, -1:]), dim=1)
    at = torch.tensor(later(range(K) if knots is None else knots, whole), dtype=torch.int64, device=values.device)
    if last is None:
        return values[:, at]
    own, last = torch.arange(K, device=values.device), last.unsqueeze(-1)
    at = torch.where(own > last, own, torch.minimum(at, last))
    return values[torch.arange(len(values), device=values.device).unsqueeze(-1), at]


def penalty_weights(sense: Sense, c: Tensor, lam: Tensor, mu: Tensor, phr: bool) -> Tensor:
    """rho: mu where a row is active, else 0 (Equation 18).

    As printed, an inequality is inactive where c < 0 and lam = 0. With `phr` (Powell, Hestenes, Rockafellar) it is
    inactive where lam + mu c < 0: a multiplier pushes the trajectory away from an obstacle and never pulls it back.
    """
    rho = mu.view(-1, 1, 1)
    if sense == "equality":
        return rho.expand_as(c)
    idle = (lam + rho * c < 0) if phr else ((c < 0) & (lam == 0))
    return torch.where(idle, 0.0, rho)


def binding(sense: Sense, c: Tensor, lam: Tensor) -> Tensor:
    """The multipliers (B, K, p) of rows c that bind, 0 elsewhere: at a slack that exceeds them.

    An interior point's multipliers are above 0 on all inequalities: a row binds if its multiplier exceeds its slack.
    """
    return lam if sense == "equality" else torch.where(lam > -c, lam, 0.0)


def _penalty_value(sense: Sense, c: Tensor, lam: Tensor, mu: Tensor, phr: bool) -> Tensor:
    """The terms that a constraint's rows add to L_M, (B,)."""
    rho = penalty_weights(sense, c, lam, mu, phr)
    terms = (lam + 0.5 * rho * c) * c
    if phr and sense == "inequality":
        # Continued by its minimum over c where the row is inactive, so that L_M stays continuous.
        terms = torch.where(rho == 0, -0.5 * lam.square() / mu.view(-1, 1, 1), terms)
    # Two sums, knots last: one over both axes would be split among threads by batch size.
    return terms.sum(-1).sum(-1)


def _penalty_slopes(sense: Sense, c: Tensor, lam: Tensor, mu: Tensor, phr: bool) -> tuple[Tensor, Tensor]:
    """First and second derivative of `_penalty_value` with respect to c, (B, K, p) each."""
    rho = penalty_weights(sense, c, lam, mu, phr)
    g = lam + rho * c
    return (torch.where(rho == 0, 0.0, g) if phr and sense == "inequality" else g), rho


@dataclass(frozen=True)
class Lagrangian:
    """L_M = J_var + sum_k sum_i [lam c + rho/2 c^2] + J_gco for fixed multipliers (Equations 17, 64).

    With `phr` the terms of an inequality are the continuous ones of `penalty_weights`, else as printed.
    """

    problem: Problem
    multipliers: Multipliers
    penalty: Penalty | None
    phr: bool
    derived: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)  # of these very parts

    def take(self, index: Rows) -> Lagrangian:
        """The same for the problems in `index`."""
        return Lagrangian(self.problem.take(index), take(self.multipliers, index), take(self.penalty, index), self.phr)

    def value(self, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor]:
        """J_var (B,) and L_M (B,)."""
        cost = self.problem.cost.total(X, U)
        merit = cost
        for constraint, lam in zip(self.problem.constraints, self.multipliers.lam, strict=True):
            merit = merit + _penalty_value(constraint.sense, constraint.value(X, U), lam, self.multipliers.mu, self.phr)
        return cost, merit if self.penalty is None else merit + self.penalty.value(X)

    def expand(self, X: Tensor, U: Tensor) -> Tensor:
        """H (N+1, B, s, s) of L_M: first derivatives of the constraints only (Equations 31-37).

        Stage first, as the backward pass reads it.
        """
        H = quadratise(self.problem, X, U)
        for constraint, lam in zip(self.problem.constraints, self.multipliers.lam, strict=True):
            g, rho = _penalty_slopes(constraint.sense, constraint.value(X, U), lam, self.multipliers.mu, self.phr)
            constraint.accumulate(X, U, g, rho, H)
        if self.penalty is not None:
            self.penalty.accumulate(X, H)
        return H.transpose(0, 1)

    def expand_optimality(self, X: Tensor, U: Tensor) -> Tensor:
        """H (N+1, B, s, s) of J_var + lam'c, with the penalty's curvature on the rows that bind (see `binding`)."""
        H = quadratise(self.problem, X, U)
        for constraint, lam in zip(self.problem.constraints, self.multipliers.lam, strict=True):
            binds = binding(constraint.sense, constraint.value(X, U), lam) != 0
            constraint.accumulate(X, U, lam, torch.where(binds, self.multipliers.mu.view(-1, 1, 1), 0.0), H)
        return H.transpose(0, 1)

    def slack(self, X: Tensor, U: Tensor) -> Tensor:
        """Sum |lam c| (B,) over inequalities with c < 0, where complementarity asks for lam = 0."""
        slack = X.new_zeros(X.shape[0])
        for constraint, lam in zip(self.problem.constraints, self.multipliers.lam, strict=True):
            if constraint.sense == "inequality":
                slack = slack - (lam * constraint.value(X, U).clamp(max=0.0)).sum(-1).sum(-1)
        return slack


def update_and_raise_penalty(
    problem: Problem, X: Tensor, U: Tensor, multipliers: Multipliers, growth: Tensor | float, mu_max: float
) -> Multipliers:
    """lam + mu c, at least 0 for inequalities; mu times `growth`, at most mu_max (Equations 21, 22)."""
    lam = []
    for constraint, old in zip(problem.constraints, multipliers.lam, strict=True):
        new = old + multipliers.mu.view(-1, 1, 1) * constraint.value(X, U)
        lam.append(new if constraint.sense == "equality" else new.clamp(min=0.0))
    return Multipliers(tuple(lam), (multipliers.mu * growth).clamp(max=mu_max))


@dataclass(frozen=True)
class Iterate:
    """A trajectory with its multipliers, cost and violation."""

    X: Tensor  # (B, N+1, n)
    U: Tensor  # (B, N, m)
    multipliers: Multipliers
    cost: Tensor  # (B,): J_var
    violation: Tensor  # (B,)


@dataclass
class InnerState:
    """The state of inner solves; the first dimension of every tensor is the running batch, b problems."""

    rows: Tensor  # place in the batch
    X: Tensor  # (b, N+1, n)
    U: Tensor  # (b, N, m)
    cost: Tensor  # (b,): J_var
    merit: Tensor  # (b,): L_M
    regularisation: Tensor  # mu_r
    inner: Tensor  # iterations of this inner solve
    iterations: Tensor
    rung: Tensor  # int64: first rung of the next line search


@dataclass(frozen=True)
class PassEnd:
    """How a pass ended for every running problem, (B,)."""

    ended: Tensor  # bool: the inner solve has ended
    converged: Tensor  # bool
    stuck: Tensor  # bool: no step length was acceptable, and no regularisation is left to try
    status: Tensor  # int64: RUNNING, or why the whole solve of the problem ends here
    alpha: Tensor  # step length of the last iteration
    used: Tensor  # mu_r of the last iteration
    failed: Tensor  # bool: the backward pass failed, and no iteration was made


@dataclass
class State(InnerState):
    """The state of outer loops."""

    multipliers: Multipliers
    penalty: Penalty | None  # of guidance
    outer: Tensor  # inner solves ended
    guided: Tensor  # outer iterations with guidance on
    replaced: Tensor  # bool: guidance replaced the iterate, and isn't called again
    last_cost: Tensor  # J_var at the end of the previous inner solve
    best: Iterate  # best iterate that ended an inner solve; infinite violation before the first


@dataclass(frozen=True)
class SolveEnd:
    """How every problem of a call ended, (B, ...), in the units that the solver worked in."""

    best: Iterate  # the best that ended an inner solve, else the last
    last: Iterate
    status: Tensor  # int64: a Status, or STOPPED
    iterations: Tensor
    outer: Tensor
    guided: Tensor

    @classmethod
    def blank(cls, problem: Problem, U: Tensor) -> SolveEnd:
        """An end to be filled in, for controls like U (B, N, m)."""
        count = torch.zeros(problem.B, dtype=torch.int64, device=U.device)
        X, worth = U.new_zeros(problem.B, problem.N + 1, problem.n), U.new_zeros(problem.B)
        best = Iterate(X, U.clone(), Multipliers.zero(problem, 0.0), worth, worth.clone())
        return cls(best, copied(best), count, count.clone(), count.clone(), count.clone())
