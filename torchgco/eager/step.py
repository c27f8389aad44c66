"""A Riccati recursion over the stages, batched over problems: factors, and the steps that they give.

With the curvature H, the slopes F of the dynamics and a shift delta_w on the diagonal,

    Q = H + delta_w I + F' P F,    Quu = L L',    P = Qxx - Y'Y,    Y = L^-1 Qux,    K = -L'^-1 Y,

from the last knot to the first. One factorisation serves several right hand sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Factors:
    """Stage first."""

    F: Tensor  # (N, b, n, S)
    P: Tensor  # (N+1, b, n, n)
    L: Tensor  # (N, b, m, m)
    K: Tensor  # (N, b, m, n)
    closed: Tensor  # (N, b, n, n): fx + fu K
    start: Tensor | None  # (b, n, n): factor of P_0 in the free components of the start
    free: Tensor | None  # (b, n) bool
    good: Tensor  # (b,) bool: positive definite at every stage


def factor(F: Tensor, H: Tensor, shift: Tensor, pivot: float, free: Tensor | None) -> Factors:
    """Factors along all stages.

    Args:
        F: (b, N, n, S).
        H: (b, N+1, S, S).
        shift: delta_w (b,).
        pivot: least pivot, as a share of its entry.
        free: which components of the start are variables (b, n); None: none.
    """
    n, S = F.shape[-2:]
    H = H.clone()
    H.diagonal(dim1=-2, dim2=-1).add_(shift.view(-1, 1, 1))
    F, H = F.transpose(0, 1).contiguous(), H.transpose(0, 1).contiguous()
    P, Ps, Ls, Ys, infos = H[-1, :, :n, :n], [], [], [], []
    for f, h in zip(reversed(F.unbind(0)), reversed(H[:-1].unbind(0)), strict=True):
        Ps.append(P)
        Q = torch.baddbmm(h, f.mT, torch.bmm(P, f))
        Qx, Qu = Q.split((n, S - n), dim=-1)
        L, info = torch.linalg.cholesky_ex(Qu[:, n:])
        Y = torch.linalg.solve_triangular(L, Qx[:, n:], upper=False)
        P = torch.baddbmm(Qx[:, :n], Y.mT, Y, alpha=-1.0)
        P = P.add(P.mT).mul_(0.5)
        Ls.append(L)
        Ys.append(Y)
        infos.append(info)
    Ps.append(P)
    P_all, L, Y = torch.stack(Ps[::-1]), torch.stack(Ls[::-1]), torch.stack(Ys[::-1])
    fu = F[..., n:]
    whole = H[:-1].diagonal(dim1=-2, dim2=-1)[..., n:] + (fu * (P_all[1:] @ fu)).sum(-2)
    pivots = L.diagonal(dim1=-2, dim2=-1).square()
    good = ((pivots > pivot * whole.abs()) & torch.isfinite(pivots)).all(-1).all(0) & (torch.stack(infos) == 0).all(0)
    K = -torch.linalg.solve_triangular(L.mT, Y, upper=True)
    start = None
    if free is not None:
        start, positive = _factor_start(P, free, pivot)
        good = good & positive
    return Factors(F, P_all, L, K, F[..., :n] + fu @ K, start, free, good)


def _factor_start(P: Tensor, free: Tensor, pivot: float) -> tuple[Tensor, Tensor]:
    """The factor of P (b, n, n) in the free components, of the unit matrix in the others; and where it exists."""
    both, eye = free.unsqueeze(-1) & free.unsqueeze(-2), torch.eye(P.shape[-1], dtype=P.dtype, device=P.device)
    whole = torch.where(both, P, eye)
    L, info = torch.linalg.cholesky_ex(whole)
    pivots = L.diagonal(dim1=-2, dim2=-1).square()
    good = (pivots > pivot * whole.diagonal(dim1=-2, dim2=-1).abs()) & torch.isfinite(pivots)
    return L, good.all(-1) & (info == 0)


def put(factors: Factors, rows: Tensor, new: Factors) -> None:
    """Write the factors of some problems into those of all, in place."""
    for name in ("F", "P", "L", "K", "closed"):
        getattr(factors, name)[:, rows] = getattr(new, name)
    factors.good[rows] = new.good
    if factors.start is not None and new.start is not None:
        factors.start[rows] = new.start


def take(factors: Factors, rows: Tensor) -> Factors:
    """The factors of the problems `rows`."""
    if rows.numel() == factors.good.numel():
        return factors
    parts: dict[str, Any] = {name: getattr(factors, name)[:, rows] for name in ("F", "P", "L", "K", "closed")}
    start, free = (None if part is None else part[rows] for part in (factors.start, factors.free))
    return Factors(**parts, start=start, free=free, good=factors.good[rows])


def solve(factors: Factors, g: Tensor, aim: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The step for slopes g (b, N+1, S) and gaps `aim` (b, N, n) to close: dx (b, N+1, n), du (b, N, m) and the
    costates of a full step y (b, N+1, n), of which the first is 0.
    """
    F, P, K, closed = factors.F, factors.P, factors.K, factors.closed
    n = P.shape[-1]
    g, aim = g.transpose(0, 1).unsqueeze(-1), aim.transpose(0, 1).unsqueeze(-1)
    across = P[1:] @ aim  # of the slopes of the cost-to-go
    w = g[:-1, :, :n] + K.mT @ g[:-1, :, n:] + closed.mT @ across
    p = [g[-1, :, :n]]
    for A, add in zip(reversed(closed.unbind(0)), reversed(w.unbind(0)), strict=True):
        p.append(torch.baddbmm(add, A.mT, p[-1]))
    slopes = torch.stack(p[::-1])
    q = F[..., n:].mT @ (slopes[1:] + across) + g[:-1, :, n:]
    d = -torch.cholesky_solve(q, factors.L)
    x = torch.zeros_like(slopes[0])
    if factors.start is not None and factors.free is not None:
        x = -torch.cholesky_solve(torch.where(factors.free.unsqueeze(-1), slopes[0], 0.0), factors.start)
    dx = [x]
    for A, add in zip(closed.unbind(0), (F[..., n:] @ d + aim).unbind(0), strict=True):
        dx.append(torch.baddbmm(add, A, dx[-1]))
    X = torch.stack(dx)
    du = d + K @ X[:-1]
    y = P @ X + slopes
    y[0] = 0.0
    return tuple(part.squeeze(-1).transpose(0, 1) for part in (X, du, y))  # type: ignore[return-value]
