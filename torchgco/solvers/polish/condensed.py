"""One problem linearised along a trajectory, its states eliminated: the parts of a Newton step in the controls alone.

With dx_0 = 0 the linearised dynamics give dX = G dU, which leaves v = N m unknowns. G and the reduced Hessian are
dense: for some hundred stages they cost less than the bookkeeping of a sparse factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchgco.base.autodiff import gradients
from torchgco.constraints.base import Constraint
from torchgco.lagrangian.expansion import linearise, quadratise
from torchgco.problem.problem import Problem

LAST = 0, 0, 0, 1  # one more stage of zeros: the last knot has no controls


@dataclass(frozen=True)
class Condensed:
    """A batch of one problem, linearised around X (1, N+1, n), U (1, N, m). A row is one scalar of one constraint."""

    problem: Problem
    X: Tensor
    U: Tensor
    F: Tensor  # (N, n, n + m): dx_{k+1} = F_k [dx_k, du_k]
    G: Tensor  # (N+1, n, v): dx_k = G_k dU
    local: Tensor  # (N+1, n + m): gradient of J_var w.r.t. the x and u of each knot
    gradient: Tensor  # (v,): gradient of J_var w.r.t. U
    c: Tensor  # (r,): values of all rows, constraint by constraint, c <= 0 or c = 0
    slopes: Tensor  # (r, n + m): their derivatives w.r.t. the x and u of their knot
    knots: Tensor  # (r,) int64
    equality: Tensor  # (r,) bool

    @classmethod
    def around(cls, problem: Problem, X: Tensor, U: Tensor) -> Condensed:
        """Linearise one problem along X (1, N+1, n), U (1, N, m)."""
        n, m, N = problem.n, problem.m, problem.N
        homogeneous = linearise(problem, X, U)[:, 0, :n]
        F = torch.cat((homogeneous[..., :n], homogeneous[..., n + 1 :]), dim=-1)
        G = X.new_zeros(N + 1, n, N * m)
        for k in range(N):
            past, here = slice(0, k * m), slice(k * m, (k + 1) * m)
            torch.mm(F[k, :, :n], G[k, :, past], out=G[k + 1, :, past])
            G[k + 1, :, here] = F[k, :, n:]
        column = quadratise(problem, X, U)[0, :, :, n]
        local = torch.cat((column[:, :n], column[:, n + 1 :]), dim=-1)
        return cls(problem, X, U, F, G, local, _reduced(G, local), *_rows(problem, X, U))

    def dense(self, rows: Tensor) -> Tensor:
        """A (q, v): derivatives of the rows (q,) w.r.t. U."""
        n, m, N = self.problem.n, self.problem.m, self.problem.N
        slopes, knots = self.slopes[rows], self.knots[rows]
        A = torch.bmm(slopes[:, None, :n], self.G[knots])[:, 0]
        own = A.new_zeros(rows.numel(), N + 1, m)
        own[torch.arange(rows.numel(), device=rows.device), knots] = slopes[:, n:]
        return A + own[:, :N].flatten(1)

    def change(self, step: Tensor) -> Tensor:
        """A dU (r,) of all rows for a step dU (v,)."""
        z = torch.cat((self.G @ step, pad(step.view(self.problem.N, -1), LAST)), dim=-1)
        return (self.slopes * z[self.knots]).sum(-1)

    def lagrangian_gradient(self, lam: Tensor) -> Tensor:
        """Gradient (v,) of J_var + lam'c w.r.t. U, for multipliers lam (r,)."""
        return _reduced(self.G, self.local.index_add(0, self.knots, lam.unsqueeze(-1) * self.slopes))

    def hessian(self, lam: Tensor | None) -> Tensor:
        """Hessian (v, v) of J_var + lam'c w.r.t. U: exact for multipliers lam (r,), that of the cost alone for None.

        The exact one holds the curvature of the constraints and of the dynamics, the latter weighted by the costates.
        """
        n, m, N = self.problem.n, self.problem.m, self.problem.N
        B = self._cost_curvature() if lam is None else self._curvature(lam)
        H = self.G.new_zeros(N * m, N * m)
        # Backwards, S_k dU is the change of the costate at k; the lower triangle needs controls up to stage k only.
        S = torch.mm(B[N, :n, :n], self.G[N])
        for k in range(N - 1, -1, -1):
            done, here = slice(0, (k + 1) * m), slice(k * m, (k + 1) * m)
            G, S = self.G[k, :, done], S[:, done]
            H[here, done] = torch.mm(self.F[k, :, n:].mT, S) + torch.mm(B[k, n:, :n], G)
            H[here, here] += B[k, n:, n:]
            S = torch.mm(self.F[k, :, :n].mT, S) + torch.mm(B[k, :n, :n], G)
            S[:, here] += B[k, :n, n:]
        return H.tril() + H.tril(-1).mT

    def _cost_curvature(self) -> Tensor:
        n, m = self.problem.n, self.problem.m
        keep = [i for i in range(n + 1 + m) if i != n]
        return quadratise(self.problem, self.X, self.U)[0][:, keep][:, :, keep]

    def _curvature(self, lam: Tensor) -> Tensor:
        """Blocks (N+1, s, s), s = n + m: second derivatives of the Lagrangian w.r.t. the x and u of each knot.

        The problem is repeated once per direction, so that one pass gives the derivatives along all s of them.
        """
        n, N, s = self.problem.n, self.problem.N, self.F.shape[-1]
        local = self.local.index_add(0, self.knots, lam.unsqueeze(-1) * self.slopes)
        costates = [local[N, :n]]
        for k in range(N - 1, 0, -1):
            costates.append(local[k, :n] + costates[-1] @ self.F[k, :, :n])
        costate = torch.stack(costates[::-1])
        twins = self.problem.take(torch.zeros(s, dtype=torch.int64, device=lam.device))
        directions = torch.eye(s, dtype=lam.dtype, device=lam.device).unsqueeze(1)
        weights = self.by_constraint(lam)

        def value(z: Tensor) -> Tensor:
            X, U = z[..., :n], z[:, :-1, n:]
            total = twins.cost.total(X, U).sum() + (costate * twins.along.step(X[:, :-1], U)).sum()
            for constraint, weight in zip(twins.constraints, weights, strict=True):
                total = total + (weight * constraint.value(X, U)).sum()
            return total

        z = torch.cat((self.X, pad(self.U, LAST)), dim=-1).repeat(s, 1, 1)
        (blocks,) = gradients(lambda z: gradients(value, z)[0] * directions, z)
        return blocks.movedim(0, 1)

    def by_constraint(self, rows: Tensor) -> tuple[Tensor, ...]:
        """Values (r,) of all rows, split into one (1, K, p) per constraint."""
        shapes = [c.value(self.X, self.U).shape for c in self.problem.constraints]
        parts = rows.split([shape.numel() for shape in shapes])
        return tuple(part.view(shape) for part, shape in zip(parts, shapes, strict=True))


def _reduced(G: Tensor, local: Tensor) -> Tensor:
    """The gradient (v,) w.r.t. U of what has gradients `local` (N+1, n + m) w.r.t. the x and u of each knot."""
    n = G.shape[1]
    return (G * local[:, :n, None]).flatten(0, 1).sum(0) + local[:-1, n:].flatten()


def _rows(problem: Problem, X: Tensor, U: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Values, slopes, knots and senses of all rows."""
    every = torch.arange(problem.N + 1, device=X.device)
    z = torch.cat((X, pad(U, LAST)), dim=-1)
    values, slopes, knots, senses = [X.new_zeros(0)], [z.new_zeros(0, z.shape[-1])], [every[:0]], [every[:0].bool()]
    for constraint in problem.constraints:
        c, slope = _slopes(constraint, z, problem.n)
        values.append(c.flatten())
        slopes.append(slope.flatten(0, 1))
        knots.append(every[constraint.knots].repeat_interleave(c.shape[-1]))
        senses.append(torch.full_like(knots[-1], constraint.sense == "equality", dtype=torch.bool))
    return torch.cat(values), torch.cat(slopes), torch.cat(knots), torch.cat(senses)


def _slopes(constraint: Constraint, z: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """c (K, p) and its derivatives (K, p, n + m) w.r.t. the x and u of each knot.

    The problem is repeated p times, and row j is differentiated in repetition j: a row depends on its own knot alone.
    """
    c = constraint.value(z[..., :n], z[:, :-1, n:])[0]
    p = c.shape[-1]
    if p == 0:
        return c, z.new_zeros(*c.shape, z.shape[-1])
    twins = constraint.take(torch.zeros(p, dtype=torch.int64, device=z.device))
    (slopes,) = gradients(lambda z: twins.value(z[..., :n], z[:, :-1, n:]).diagonal(dim1=0, dim2=2), z.repeat(p, 1, 1))
    return c, slopes[:, constraint.knots].transpose(0, 1)
