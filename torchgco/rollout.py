"""Trajectories from controls, and from feedback along a nominal one."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.dynamics.base import Dynamics
from torchgco.kernels import compiling, kernel

STAGES = 5  # compiled into one kernel


def open_loop(dynamics: Dynamics, x0: Tensor, U: Tensor) -> Tensor:
    """X (B, N+1, n) from x0 (B, n) and U (B, N, m)."""
    if compiling():
        return _open_loop_rows(dynamics, x0, U)
    x, knots = x0, [x0]
    for u in U.unbind(1):
        x = dynamics.step(x, u)
        knots.append(x)
    return torch.stack(knots, dim=1)


def closed_loop(dynamics: Dynamics, X: Tensor, U: Tensor, G: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Roll out u = u_old + K (x - x_old) + alpha d (Equation 47) around X (B, N+1, n), U (B, N, m).

    Args:
        G: gains [K d], stage first: (N, B, m, n+1).
        alpha: step lengths (B,).
    """
    if compiling():
        return _closed_loop_rows(dynamics, X, U, G, alpha)
    x, knots, controls = X[:, 0], [X[:, 0]], []
    step = alpha.unsqueeze(-1)
    for old_x, old_u, gains in zip(X[:, :-1].unbind(1), U.unbind(1), G.unbind(0), strict=True):
        deviation = torch.cat((x - old_x, step), dim=-1).unsqueeze(-1)  # K and alpha d in one product
        u = old_u + torch.bmm(gains, deviation).squeeze(-1)
        x = dynamics.step(x, u)
        knots.append(x)
        controls.append(u)
    return torch.stack(knots, dim=1), torch.stack(controls, dim=1)


def _open_loop_rows(dynamics: Dynamics, x0: Tensor, U: Tensor) -> Tensor:
    """The same, components first and some stages at a time: the form that compiles into few kernels."""
    controls, x = U.permute(1, 2, 0).contiguous(), x0.mT.contiguous()
    knots = [x.unsqueeze(0)]
    for k in range(0, U.shape[1], STAGES):
        knots.append(_roll(dynamics, knots[-1][-1], controls[k : k + STAGES]))
    return torch.cat(knots).permute(2, 0, 1).contiguous()


@kernel
def _roll(dynamics: Dynamics, x: Tensor, controls: Tensor) -> Tensor:
    """States (c, n, B) of c stages from x (n, B) under controls (c, m, B)."""
    states = []
    for u in controls.unbind(0):
        x = dynamics.step_rows(x.unsqueeze(-1), u.unsqueeze(-1)).squeeze(-1)
        states.append(x)
    return torch.stack(states)


def _closed_loop_rows(dynamics: Dynamics, X: Tensor, U: Tensor, G: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """`closed_loop` in that form."""
    states, controls, gains = X.permute(1, 2, 0).contiguous(), U.permute(1, 2, 0).contiguous(), G.permute(0, 2, 3, 1)
    gains, x = gains.contiguous(), states[0]
    knots, inputs = [x.unsqueeze(0)], []
    for k in range(0, U.shape[1], STAGES):
        part = slice(k, k + STAGES)
        x_part, u_part = _follow(dynamics, x, states[part], controls[part], gains[part], alpha)
        x = x_part[-1]
        knots.append(x_part)
        inputs.append(u_part)
    return torch.cat(knots).permute(2, 0, 1).contiguous(), torch.cat(inputs).permute(2, 0, 1).contiguous()


@kernel
def _follow(
    dynamics: Dynamics, x: Tensor, states: Tensor, controls: Tensor, gains: Tensor, alpha: Tensor
) -> tuple[Tensor, Tensor]:
    """States and controls (c, n, B), (c, m, B) of c stages from x (n, B), with gains (c, m, n+1, B)."""
    new_x, new_u = [], []
    for k in range(controls.shape[0]):
        deviation = torch.cat((x - states[k], alpha.unsqueeze(0)))
        u = controls[k] + (gains[k] * deviation).sum(1)
        x = dynamics.step_rows(x.unsqueeze(-1), u.unsqueeze(-1)).squeeze(-1)
        new_x.append(x)
        new_u.append(u)
    return torch.stack(new_x), torch.stack(new_u)
