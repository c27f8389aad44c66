"""The backward pass in homogeneous form (Algorithm 2, lines 4-13; Equations 31-45).

With z = [x, 1, u], F_k the dynamics and H_k the quadratic model of a stage, Q = H + F' V F holds gradient and Hessian
of the action value at once. Eliminating the controls from [Quz, Quu + mu_r I] by the steps of Gauss and Jordan gives
the gains G = [K d] = -(Quu + mu_r I)^-1 Quz; the pivots are positive exactly where a Cholesky factorisation succeeds.
Then V = Qzz + Quz' G - mu_r G'G, which is the general value recursion.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


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
    n, m = z - 1, s - z
    mu = regularisation.view(B, 1, 1)
    any_mu = bool((regularisation > 0).any())
    gains = F.new_empty(N, B, m, z)
    linear, quadratic = F.new_zeros(B), F.new_zeros(B)
    lowest = torch.full_like(linear, torch.inf)
    VF, Q, T = F.new_empty(B, z, s), F.new_empty(B, s, s), F.new_empty(B, m, s)
    V = H[N, :, :z, :z]
    for k in range(N - 1, -1, -1):
        # Written into the same memory at every stage: fresh pages would cost as much as the products.
        torch.bmm(V, F[k], out=VF)
        torch.baddbmm(H[k], F[k].mT, VF, out=Q)
        T.copy_(Q[:, z:])
        if any_mu:
            T.diagonal(offset=z, dim1=-2, dim2=-1).add_(regularisation.unsqueeze(-1))
        lowest = torch.minimum(lowest, _eliminate(T, z))
        G = torch.neg(T[..., :z], out=gains[k])
        Quz = Q[:, z:, :z]
        V = torch.baddbmm(Q[:, :z, :z], Quz.mT, G)
        d = G[..., n]
        change = (Quz[..., n] * d).sum(-1)
        linear += change
        quadratic -= change
        if any_mu:
            # Elements with mu_r = 0 subtract an exact zero: their bits don't depend on who else is regularised.
            V -= mu * torch.bmm(G.mT, G)
            quadratic -= mu[:, 0, 0] * d.square().sum(-1)
        V = (V + V.mT).mul_(0.5)
    return BackwardPass(gains, linear, quadratic, ~(lowest > 0))


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
