"""The backward pass in homogeneous form (Algorithm 2, lines 4-13; Equations 31-45).

With z = [x, 1, u], F_k the dynamics and H_k the quadratic model of a stage, Q = H + F' V F holds gradient and Hessian
of the action value at once. From the Cholesky factor L L' = Quu + mu_r I and Y = L^-1 Quz follow the gains
G = [K d] = -L'^-1 Y and V = Qzz - Y'Y - mu_r G'G, which is the general value recursion.
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
        F: (B, N, n+1, s) dynamics, H: (B, N+1, s, s) quadratic model, regularisation: mu_r (B,).
    """
    B, N, z, s = F.shape
    n, m = z - 1, s - z
    mu = regularisation.view(B, 1, 1)
    mu_eye = mu * torch.eye(m, dtype=F.dtype, device=F.device)
    any_mu = bool((regularisation > 0).any())
    gains = F.new_empty(N, B, m, z)
    linear, quadratic = F.new_zeros(B), F.new_zeros(B)
    bad = torch.zeros(B, dtype=torch.int32, device=F.device)
    V = H[:, N, :z, :z]
    for k in range(N - 1, -1, -1):
        Fk = F[:, k]
        Q = torch.baddbmm(H[:, k], Fk.mT, torch.bmm(V, Fk))
        L, info = torch.linalg.cholesky_ex(Q[:, z:, z:] + mu_eye)
        Y = torch.linalg.solve_triangular(L, Q[:, z:, :z], upper=False)
        G = torch.linalg.solve_triangular(L.mT, Y, upper=True).neg_()
        V = Q[:, :z, :z] - torch.bmm(Y.mT, Y)
        y, d = Y[..., n], G[..., n]
        decrease = y.square().sum(-1)
        linear = linear - decrease
        quadratic = quadratic + decrease
        if any_mu:
            # Elements with mu_r = 0 subtract an exact zero: their bits don't depend on who else is regularised.
            V = V - mu * torch.bmm(G.mT, G)
            quadratic = quadratic - mu[:, 0, 0] * d.square().sum(-1)
        V = 0.5 * (V + V.mT)
        gains[k] = G
        bad = bad | info
    return BackwardPass(gains, linear, quadratic, bad != 0)
