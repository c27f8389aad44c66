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
    gains, slopes, lowest = F.new_empty(N, B, s - z, z), F.new_empty(N, B, s - z), F.new_full((B,), torch.inf)
    work, any_mu = _Stage(F), bool((regularisation > 0).any())
    # Slices of all stages at once: taken one by one, they would cost as much as the arithmetic of a small batch.
    Fs, transposed, Hs, Gs = F.unbind(0), F.mT.unbind(0), H.unbind(0), gains.unbind(0)
    V = H[N, :, :z, :z]
    for k in range(N - 1, -1, -1):
        # Written into the same memory at every stage: fresh pages would cost as much as the products.
        torch.bmm(V, Fs[k], out=work.VF)
        torch.baddbmm(Hs[k], transposed[k], work.VF, out=work.Q)
        slopes[k] = work.Qu
        V, pivot = work.eliminate(regularisation if any_mu else None, Gs[k])
        lowest = torch.minimum(lowest, pivot)
    d = gains[..., z - 1]
    linear, squares = _over_stages(slopes * d), _over_stages(d.square())
    # d'Quu d = -Qu'd - mu_r d'd, as (Quu + mu_r I) d = -Qu.
    return BackwardPass(gains, linear, -linear - regularisation * squares, ~(lowest > 0))


def _over_stages(terms: Tensor) -> Tensor:
    """Sum of (N, B, m) over controls and stages, (B,), in an order that doesn't depend on B."""
    return terms.sum(-1).mT.contiguous().sum(-1)


class _Stage:
    """The memory in which every stage works, and the parts of it that it reads and writes."""

    def __init__(self, F: Tensor) -> None:
        _, B, z, s = F.shape
        m = s - z
        self.VF, self.Q = F.new_empty(B, z, s), F.new_empty(B, s, s)
        self.Qzz, self.Quz, self.Qu = self.Q[:, :z, :z], self.Q[:, z:, :z], self.Q[:, z:, z - 1]
        self.T, self.half, self.V = F.new_empty(B, m, s), F.new_empty(B, z, z), F.new_empty(B, z, z)
        self.Quu = self.T[:, :, z:].diagonal(dim1=-2, dim2=-1)
        self.row, self.columns = F.new_empty(B, 1, s), F.new_empty(m, B, m, 1)
        self.pivots = self.columns[..., 0].diagonal(dim1=0, dim2=2)  # (B, m)
        # One control after the other: its row of T, its column, a place for that, and the pivot there.
        self.steps = [
            (self.T[:, j : j + 1], self.T[:, :, z + j : z + j + 1], self.columns[j], self.columns[j, :, j : j + 1])
            for j in range(m)
        ]

    def eliminate(self, mu: Tensor | None, G: Tensor) -> tuple[Tensor, Tensor]:
        """From Q of a stage its gains, written to G (B, m, z), and V (B, z, z) and the smallest pivot (B,).

        T = [Quz, Quu + mu_r I] becomes [-G, I]. For so few controls that is far faster than a library's factorisation
        of every small matrix.
        """
        z = G.shape[-1]
        self.T.copy_(self.Q[:, z:])
        if mu is not None:
            self.Quu.add_(mu.unsqueeze(-1))
        for own, beside, column, pivot in self.steps:
            column.copy_(beside)
            torch.div(own, pivot, out=self.row)
            self.T.addcmul_(column, self.row, value=-1.0)
            own.copy_(self.row)
        torch.neg(self.T[..., :z], out=G)
        torch.baddbmm(self.Qzz, self.Quz.mT, G, out=self.half)
        if mu is not None:
            # Elements with mu_r = 0 subtract an exact zero: their bits don't depend on who else is regularised.
            self.half.sub_(mu.view(-1, 1, 1) * torch.bmm(G.mT, G))
        torch.add(self.half, self.half.mT, out=self.V).mul_(0.5)
        return self.V, self.pivots.amin(-1)
