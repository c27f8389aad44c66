"""Forces between vehicles that are in balance: where they move the vehicles of one fleet, to first order.

Each vehicle's trajectory is the minimum of its own cost under the forces of others, and answers to a change of these by
a linear response. Forces push apart, and only pairs that touch. The forces are then the multipliers of a quadratic
programme: find l >= 0 with M l - q >= 0 and l'(M l - q) = 0, M the response of gaps to forces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchgco.base.tree import is_users
from torchgco.costs.base import Cost
from torchgco.kernels import interior_of
from torchgco.problem.problem import Problem
from torchgco.sensitivity.points import gains_of, rows_in_barrier
from torchgco.solution import Solution

TINY = 1e-9  # m, below which two places are one
SOFT = 1e-6  # share of the responses by which pairs give way: rows that depend on each other have no unique forces
STEPS = 40  # of the interior point on forces, at most
ENOUGH = 1e-8  # product of force and gap at its end, as a share of the first one
SHORT = 0.99  # share of the way to where a force or a gap would be 0


@dataclass(frozen=True)
class Pulled(Cost):
    """A cost with forces on the position, and springs: cost - force . p + weight / 2 |p - target|^2 at all knots."""

    cost: Cost
    pull: Tensor  # (B, N+1, d): force + weight target
    weight: Tensor  # (B, 1)
    position: slice

    batched: ClassVar[tuple[str, ...]] = ("cost", "pull", "weight")
    calls_function = property(lambda self: is_users(self.cost))

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        at = slice(k, k + 1) if isinstance(k, int) and x.dim() == 3 else k  # samples of one knot have an axis, too
        pull = self.pull[:, at]
        return self.cost.stage(x, u, k) + self._more(x, pull)

    def terminal(self, x: Tensor) -> Tensor:
        pull = self.pull[:, -1] if x.dim() == 2 else self.pull[:, -1:]
        return self.cost.terminal(x) + self._more(x, pull)

    def _more(self, x: Tensor, pull: Tensor) -> Tensor:
        p = x[..., self.position]
        weight = self.weight if x.dim() == 2 else self.weight.unsqueeze(1)
        return ((0.5 * weight * p - pull) * p).sum(-1)

    def rest_controls(self, like: Tensor) -> Tensor:
        return self.cost.rest_controls(like)


def balancing_forces(
    normals: Tensor, gaps: Tensor, needed: Tensor, forces: Tensor, responses: Tensor, near: float
) -> tuple[Tensor, Tensor]:
    """Where V vehicles go, as changes of their places (V, K, d), m, and the forces (V, K, d) that move them there.

    Args:
        normals: along which two push each other, from vehicle j to vehicle i, (V, V, K, d).
        gaps: how far apart they are along these, (V, V, K), m.
        needed: the gaps that pairs need, (V, V, K), m; 0 of those that need none.
        forces: that act on the vehicles now, (V, K, d).
        responses: of places at knots 1..N to forces there, (V, N d, N d).
        near: by how many times the gap that they need others may be farther apart.
    """
    V, K, d = forces.shape
    if not bool(torch.isfinite(responses).all()):
        return torch.zeros_like(forces), forces
    freed = -(responses @ forces[:, 1:].flatten(1).unsqueeze(-1)).view(V, K - 1, d)
    gap, keep = gaps[:, :, 1:], needed[:, :, 1:]
    close = (keep > 0) & (gap < (1.0 + near) * keep) & torch.ones(V, V, dtype=torch.bool).triu(1).unsqueeze(-1)
    i, j, k = close.nonzero(as_tuple=True)
    if len(i) == 0:
        return torch.cat((torch.zeros_like(freed[:, :1]), freed), dim=1), torch.zeros_like(forces)
    normal = normals[:, :, 1:][i, j, k]
    M = forces.new_zeros(len(i), len(i))
    R = responses.view(V, K - 1, d, K - 1, d)
    for v in range(V):
        mine = ((i == v) | (j == v)).nonzero().flatten()
        along = torch.where(i[mine] == v, 1.0, -1.0).unsqueeze(-1) * normal[mine]
        at = k[mine]
        between = R[v][at][:, :, at]  # (r, d, r, d)
        M[mine.unsqueeze(1), mine] += torch.einsum("ra,rasb,sb->rs", along, between, along)
    q = keep[i, j, k] - gap[i, j, k] - (normal * (freed[i, k] - freed[j, k])).sum(-1)
    size = balanced(M, q)
    push = torch.zeros_like(freed)
    push.index_put_((i, k), size.unsqueeze(-1) * normal, accumulate=True)
    push.index_put_((j, k), -size.unsqueeze(-1) * normal, accumulate=True)
    moved = freed + (responses @ push.flatten(1).unsqueeze(-1)).view(V, K - 1, d)
    return torch.cat((torch.zeros_like(moved[:, :1]), moved), dim=1), torch.cat(
        (torch.zeros_like(push[:, :1]), push), dim=1
    )


def balanced(M: Tensor, q: Tensor) -> Tensor:
    """The l >= 0 (R,) with M l - q >= 0 and l'(M l - q) = 0, M (R, R) symmetric and positive semidefinite.

    By the primal-dual method of S. Mehrotra (1992).
    """
    M = 0.5 * (M + M.T) + SOFT * M.diagonal().mean() * torch.eye(len(q), dtype=M.dtype)
    most = q.abs().max().clamp(min=TINY)
    l, w = torch.full_like(q, float(most / M.diagonal().mean())), torch.full_like(q, float(most))
    first = float(l @ w) / len(q)
    for _ in range(STEPS):
        left, mean = M @ l - q - w, float(l @ w) / len(q)
        if mean < ENOUGH * first and float(left.abs().max()) < TINY:
            break
        factor, failed = torch.linalg.cholesky_ex(M + torch.diag(w / l))
        if int(failed) != 0:
            break
        dl, dw = _step(factor, left, l, w, torch.zeros_like(l))
        t = min(_most(l, dl), _most(w, dw))
        center = (float((l + t * dl) @ (w + t * dw)) / len(q) / mean) ** 3 * mean
        dl, dw = _step(factor, left, l, w, center - dl * dw)
        t = min(1.0, SHORT * min(_most(l, dl), _most(w, dw)))
        l, w = l + t * dl, w + t * dw
    return l


def _step(factor: Tensor, left: Tensor, l: Tensor, w: Tensor, aim: Tensor) -> tuple[Tensor, Tensor]:
    """The step of l and w to where, to first order, no gap is left and the products l w are `aim`."""
    right = -left + (aim - l * w) / l
    dl = torch.cholesky_solve(right.unsqueeze(-1), factor).squeeze(-1)
    return dl, (aim - l * w - w * dl) / l


def _most(z: Tensor, change: Tensor) -> float:
    """The step up to which z stays at least 0, at most 1 / SHORT."""
    ratio = torch.where(change < 0, -z / change, torch.inf)
    return min(float(ratio.min()), 1.0 / SHORT)


def between_two(p: Tensor) -> tuple[Tensor, Tensor]:
    """Normals (c, V, V, K, d) of planes between any two of the places p (c, V, K, d), and how far apart these are along
    them, (c, V, V, K), m.

    At each knot the shortest way between the two, then or in the stages beside it: so who passes whom on which side
    stays as it is, however fast they are.
    """
    away = p.unsqueeze(2) - p.unsqueeze(1)
    a, along = away[..., :-1, :], away.diff(dim=-2)
    share = -(a * along).sum(-1) / along.square().sum(-1).clamp(min=torch.finfo(p.dtype).tiny)
    nearest = a + share.clamp(0.0, 1.0).unsqueeze(-1) * along
    before = torch.cat((nearest[..., :1, :], nearest), dim=-2)
    after = torch.cat((nearest, nearest[..., -1:, :]), dim=-2)
    nearer = (before.norm(dim=-1) < after.norm(dim=-1)).unsqueeze(-1)
    way = torch.where(nearer, before, after)
    size = way.norm(dim=-1, keepdim=True)
    v, aside = torch.arange(p.shape[1]), torch.zeros_like(away)
    aside[..., 0] = (v.unsqueeze(1) - v).sign().view(1, len(v), len(v), 1).to(away)  # of two at one place
    normals = torch.where(size > TINY, way / size.clamp(min=TINY), aside)
    return normals, (normals * away).sum(-1)


def stiffness(cost: Tensor, kept: Tensor, N: int) -> Tensor:
    """Of springs at N knots that, where they lead a vehicle away by the distance that it keeps, cost as much as its way
    does."""
    return cost.abs() / (N * kept.square().clamp(min=1e-12))


def under(problem: Problem, forces: Tensor, springs: Tensor, target: Tensor) -> Problem:
    """A problem with forces (B, N+1, d) on its position, and springs (B,) to a target (B, N+1, d)."""
    pull = forces + springs.view(-1, 1, 1) * target
    cost = Pulled(problem.cost, pull, springs.unsqueeze(-1), problem.position)
    return problem._with({"cost": cost}, known=problem.known.of_lifted("pulled"))


def responses(problem: Problem, solution: Solution, forces: Tensor, springs: Tensor) -> tuple[Tensor, Tensor]:
    """Of places at knots 1..N to forces there, (B, N d, N d), m per unit, at minima of a problem under forces
    (B, N+1, d) by the interior point, whose barrier stays.

    Forces belong to it: where dynamics aren't linear, the costates that they change are part of the curvature. What
    springs (B,) or walls have held may be no strict minimum without them. There springs to the present places stay;
    which, (B,), is the second result. NaN where even these don't do.
    """
    found, strict = _responses(problem, solution, forces, torch.zeros_like(springs))
    loose = (~strict).nonzero().flatten()
    if len(loose):
        parts = problem.take(loose), solution.take(loose), forces[loose], springs[loose]
        found[loose], holds = _responses(*parts)
        found[loose[~holds]] = torch.nan
    return found, torch.where(strict, 0.0, springs)


def _responses(problem: Problem, solution: Solution, forces: Tensor, springs: Tensor) -> tuple[Tensor, Tensor]:
    """Responses with springs to the present places, and whether minima are strict, (B,)."""
    held = under(problem, forces, springs, solution.X[..., problem.position])
    active, give, _ = rows_in_barrier(held, solution, 0.0)
    point = solution.X, solution.U, solution.multipliers.lam
    return interior_of(held).responses(held, *point, active, give, gains_of(held, solution), held.position)
