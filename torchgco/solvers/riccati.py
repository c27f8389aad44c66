"""The backward pass in homogeneous form (Algorithm 2, lines 4-13; Equations 31-45).

With z = [x, 1, u], F_k the dynamics and H_k the quadratic model of a stage, Q = H + F' V F holds gradient and Hessian
of the action value at once. Eliminating the controls from [Quz, Quu + mu_r I] by the steps of Gauss and Jordan gives
the gains G = [K d] = -(Quu + mu_r I)^-1 Quz; the pivots are positive exactly where a Cholesky factorisation succeeds.
Then V = Qzz + Quz' G - mu_r G'G, which is the general value recursion.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchgco.kernels import compiling, kernel


class BackwardPass(NamedTuple):
    gains: Tensor  # G = [K d], stage first: (N, B, m, n+1)
    linear: Tensor  # sum_k Qu' d, (B,)
    quadratic: Tensor  # sum_k d' Quu d, (B,)
    failed: Tensor  # (B,) bool: Quu + mu_r I was not positive definite at some stage

    def expected_change(self, alpha: Tensor) -> Tensor:
        """alpha sum Qu'd + alpha^2/2 sum d'Quu d, negative for a descent (line 18)."""
        return alpha * self.linear + 0.5 * alpha.square() * self.quadratic


def backward(F: Tensor, H: Tensor, regularisation: Tensor) -> BackwardPass:
    """Gains along a trajectory.

    Args:
        F: (N, B, n+1, s) dynamics, H: (N+1, B, s, s) quadratic model, regularisation: mu_r (B,).
    """
    N, B, z, s = F.shape
    gains = F.new_empty(N, B, s - z, z)
    linear, quadratic = F.new_zeros(B), F.new_zeros(B)
    lowest = torch.full_like(linear, torch.inf)
    VF, Q, T = F.new_empty(B, z, s), F.new_empty(B, s, s), F.new_empty(B, s - z, s)
    any_mu, fused = bool((regularisation > 0).any()), compiling()
    V = H[N, :, :z, :z]
    for k in range(N - 1, -1, -1):
        # Written into the same memory at every stage: fresh pages would cost as much as the products.
        torch.bmm(V, F[k], out=VF)
        torch.baddbmm(H[k], F[k].mT, VF, out=Q)
        if fused:
            gains[k], V, slope, curvature, pivot = _fused_stage(Q, regularisation, gains[k])
        else:
            V, slope, curvature, pivot = _stage(Q, regularisation, any_mu, T, gains[k])
        linear += slope
        quadratic += curvature
        lowest = torch.minimum(lowest, pivot)
    return BackwardPass(gains, linear, quadratic, ~(lowest > 0))


def _stage(Q: Tensor, mu: Tensor, any_mu: bool, T: Tensor, G: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """From Q (B, s, s) of a stage its gains, written to G (B, m, z), and V, Qu'd, d'Quu d and the smallest pivot."""
    z, n = G.shape[-1], G.shape[-1] - 1
    T.copy_(Q[:, z:])
    if any_mu:
        T.diagonal(offset=z, dim1=-2, dim2=-1).add_(mu.unsqueeze(-1))
    pivot = _eliminate(T, z)
    torch.neg(T[..., :z], out=G)
    Quz, d = Q[:, z:, :z], G[..., n]
    V = torch.baddbmm(Q[:, :z, :z], Quz.mT, G)
    slope = (Quz[..., n] * d).sum(-1)
    curvature = -slope
    if any_mu:
        # Elements with mu_r = 0 subtract an exact zero: their bits don't depend on who else is regularised.
        V -= mu.view(-1, 1, 1) * torch.bmm(G.mT, G)
        curvature = curvature - mu * d.square().sum(-1)
    return (V + V.mT).mul_(0.5), slope, curvature, pivot


@partial(kernel, dynamic=None)
def _fused_stage(Q: Tensor, mu: Tensor, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The same in the form that compiles into few kernels, the gains first; `like` (B, m, z) tells their shape."""
    m, z = like.shape[1:]
    quu = [[Q[:, z + i, z + j] + (mu if i == j else 0.0) for j in range(m)] for i in range(m)]
    quz, pivots = [Q[:, z + i, :z] for i in range(m)], []
    for j in range(m):
        pivots.append(quu[j][j])
        quz[j], quu[j] = quz[j] / pivots[j].unsqueeze(-1), [entry / pivots[j] for entry in quu[j]]
        for i in range(m):
            if i != j:
                quz[i] = quz[i] - quu[i][j].unsqueeze(-1) * quz[j]
                quu[i] = [a - quu[i][j] * b for a, b in zip(quu[i], quu[j], strict=True)]
    G = -torch.stack(quz, dim=1)
    d, Quz, V = G[..., z - 1], Q[:, z:, :z], Q[:, :z, :z]
    for i in range(m):
        V = V + (Quz[:, i] - mu.unsqueeze(-1) * G[:, i]).unsqueeze(-1) * G[:, i].unsqueeze(-2)
    slope = (Quz[..., z - 1] * d).sum(-1)
    curvature = -slope - mu * d.square().sum(-1)
    return G, 0.5 * (V + V.mT), slope, curvature, torch.stack(pivots).amin(0)


def _eliminate(T: Tensor, z: int) -> Tensor:
    """T = [Quz, Quu] (B, m, z+m) becomes [Quu^-1 Quz, I], in place; returns the smallest pivot (B,).

    Control by control: for so few of them, far faster than a library's factorisation of every small matrix.
    """
    pivots = []
    for j in range(T.shape[1]):
        pivot = T[:, j, z + j].clone()
        row = T[:, j] / pivot.unsqueeze(-1)
        T -= T[:, :, z + j].unsqueeze(-1) * row.unsqueeze(1)
        T[:, j] = row
        pivots.append(pivot)
    return torch.stack(pivots).amin(0)
