"""The backward pass in homogeneous form (Algorithm 2, lines 4-13; Equations 31-45).

With z = [x, 1, u], F_k the dynamics and H_k the quadratic model of a stage, Q = H + F' V F holds gradient and Hessian
of the action value at once. With the Cholesky factor L of Quu + mu_r I and Y = L^-1 Quz, the gains are
G = [K d] = -L'^-1 Y, and V = Qzz - Y'Y - mu_r G'G, which is the general value recursion.
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
        """alpha sum Qu'd + alpha^2/2 sum d'Quu d, (B,), negative for a descent (line 18)."""
        return alpha * self.linear + 0.5 * alpha.square() * self.quadratic


def backward(F: Tensor, H: Tensor, regularisation: Tensor) -> BackwardPass:
    """Gains along a trajectory, and the change of L_M expected from them.

    Args:
        F: dynamics, (N, B, n+1, s).
        H: quadratic model, (N+1, B, s, s).
        regularisation: mu_r, (B,).
    """
    z, mu = F.shape[2], regularisation.view(-1, 1, 1)
    added = mu * torch.eye(F.shape[3] - z, dtype=F.dtype, device=F.device)
    linear, squares = torch.zeros_like(regularisation), torch.zeros_like(regularisation)
    failed = torch.zeros_like(regularisation, dtype=torch.bool)
    gains, V = [], H[-1, :, :z, :z]
    for F_k, H_k in zip(reversed(F.unbind(0)), reversed(H[:-1].unbind(0)), strict=True):
        Q = H_k + F_k.mT @ (V @ F_k)
        Qzz, Quz, Quu = Q[:, :z, :z], Q[:, z:, :z], Q[:, z:, z:]
        L, info = torch.linalg.cholesky_ex(Quu + added)
        positive = (L.diagonal(dim1=-2, dim2=-1) > 0).all(-1)  # on NaN some libraries report success
        failed = failed | (info != 0) | ~positive
        Y = torch.linalg.solve_triangular(L, Quz, upper=False)
        G = -torch.linalg.solve_triangular(L.mT, Y, upper=True)
        V = Qzz - Y.mT @ Y - mu * (G.mT @ G)
        V = 0.5 * (V + V.mT)
        gains.append(G)
        d = G[..., -1]
        linear, squares = linear + (Quz[..., -1] * d).sum(-1), squares + d.square().sum(-1)
    # d'Quu d = -Qu'd - mu_r d'd, as (Quu + mu_r I) d = -Qu.
    return BackwardPass(torch.stack(gains[::-1]), linear, -linear - regularisation * squares, failed)
