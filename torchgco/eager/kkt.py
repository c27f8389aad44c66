"""Linear systems with the matrix of the KKT conditions in PyTorch: see `lagrangian.kkt`."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.eager.model import Derivatives, Model
from torchgco.eager.softness import gives_of
from torchgco.eager.step import Factors, factor, solve
from torchgco.lagrangian.kkt import CLOSING_ROUNDS, LEAST_PIVOT, SLIGHT, STIFF, KktSolve, RightSides


def kkt(
    model: Model, X: Tensor, U: Tensor, multipliers: tuple[Tensor, ...], active: Tensor, right: RightSides,
    give: Tensor | None = None, K: Tensor | None = None,
) -> KktSolve:  # fmt: skip
    """As `native.interior.InteriorEngine.kkt`."""
    lam = torch.cat([X.new_zeros(X.shape[0], 0), *(part.flatten(1) for part in multipliers)], dim=1)
    lam = torch.where(active, lam, 0.0)
    slopes = model.slopes(X, U)
    y = _costates(slopes, lam, K)
    found = model.expand(X, U, torch.ones_like(X[:, 0, 0]), y, lam)
    sigma = STIFF * found.H.diagonal(dim1=-2, dim2=-1).abs().flatten(1).amax(-1, keepdim=True)
    curvature = slopes.H.diagonal(dim1=-2, dim2=-1).abs()
    sigma = sigma / gives_of(model, slopes, curvature, SLIGHT / STIFF * sigma[:, 0], active)
    stays = torch.ones_like(lam) if give is None else torch.where(active, 1.0 + sigma * give, 1.0)
    H = found.with_squares(torch.where(active, sigma / stays, 0.0))
    factors = factor(found.F, H, torch.zeros_like(X[:, 0, 0]), LEAST_PIVOT, model.problem.free_start)
    sides = zip(right.a, right.b, right.c, strict=True)
    columns = [_solved(found, factors, active, sigma, stays, *side) for side in sides]
    none = (X.new_zeros(0, *shape.shape[1:]) for shape in (right.a, right.b, right.c, right.a[..., 0, 0]))
    z, v_of_gaps, v, left = (torch.stack(part) for part in zip(*columns, strict=True)) if columns else none
    return KktSolve(z, v_of_gaps, v, left, y, factors.good)


def _costates(slopes: Derivatives, lam: Tensor, K: Tensor | None) -> Tensor:
    """y (b, N+1, n) that makes the Lagrangian stationary in the states, along the feedback K; 0 at knot 0."""
    n = slopes.F.shape[-2]
    g = slopes.cost + slopes.pull(lam.unsqueeze(1)).squeeze(1)
    y = [g[:, -1, :n]]
    for k in range(slopes.F.shape[1] - 1, 0, -1):
        slope = g[:, k] + (slopes.F[:, k].mT @ y[-1].unsqueeze(-1)).squeeze(-1)
        fed_back = 0.0 if K is None else (K[:, k].mT @ slope[:, n:].unsqueeze(-1)).squeeze(-1)
        y.append(slope[:, :n] + fed_back)
    return torch.stack([torch.zeros_like(y[0]), *y[::-1]], dim=1)


def _solved(
    found: Derivatives, factors: Factors, active: Tensor, sigma: Tensor, stays: Tensor, a: Tensor, b: Tensor, c: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """z, y, v and what active rows leave open, for one right hand side; each round closes what the last one left."""
    n, F = b.shape[-1], found.F
    c, a = torch.where(active, c, 0.0), a.clone()
    a[:, -1, n:] = 0.0
    z, y, v = torch.zeros_like(a), torch.zeros_like(b), torch.zeros_like(c)
    for _ in range(CLOSING_ROUNDS):
        open_a = a + (found.H @ z.unsqueeze(-1)).squeeze(-1)
        open_a[:, :-1] += (F.mT @ y.unsqueeze(-1)).squeeze(-1)
        open_a[:, 1:, :n] -= y
        open_b = b + (F @ z[:, :-1].unsqueeze(-1)).squeeze(-1) - z[:, 1:, :n]
        pulled = found.pull((v + sigma / stays * c).unsqueeze(1)).squeeze(1)
        dx, du, dy = solve(factors, open_a + pulled, open_b)
        step = torch.cat((dx, torch.nn.functional.pad(du, (0, 0, 0, 1))), dim=-1)
        z, y, c = z + step, y + dy[:, 1:], (c + torch.where(active, found.push(step, c), 0.0)) / stays
        v = v + sigma * c
    return z, y, v, c.abs().amax(-1) if c.shape[1] > 0 else torch.zeros_like(z[:, 0, 0])
