"""Trajectories from controls, and from feedback along a nominal trajectory."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.dynamics.base import Dynamics


def open_loop(dynamics: Dynamics, x0: Tensor, U: Tensor) -> Tensor:
    """X (B, N+1, n) from x0 (B, n) and U (B, N, m)."""
    x, knots = x0, [x0]
    for k, u in enumerate(U.unbind(1)):
        x = dynamics.at(k).step(x, u)
        knots.append(x)
    return torch.stack(knots, dim=1)


def closed_loop(dynamics: Dynamics, X: Tensor, U: Tensor, G: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Roll out u = u_old + K (x - x_old) + alpha d (Equation 47) around X (B, N+1, n), U (B, N, m).

    Args:
        G: gains [K d], stage first: (N, B, m, n+1).
        alpha: step lengths (B,).
    """
    x, knots, controls = X[:, 0], [X[:, 0]], []
    step = alpha.unsqueeze(-1)
    for k, (old_x, old_u, gains) in enumerate(zip(X[:, :-1].unbind(1), U.unbind(1), G.unbind(0), strict=True)):
        deviation = torch.cat((x - old_x, step), dim=-1).unsqueeze(-1)  # K and alpha d in one product
        u = old_u + torch.bmm(gains, deviation).squeeze(-1)
        x = dynamics.at(k).step(x, u)
        knots.append(x)
        controls.append(u)
    return torch.stack(knots, dim=1), torch.stack(controls, dim=1)
