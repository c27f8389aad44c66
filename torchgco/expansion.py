"""Derivatives along a trajectory, all knots at once, in homogeneous form z = [x, 1, u]."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.problem import Problem

AT_ONCE = 64  # problems that are differentiated together on a CPU: what is at work stays in the cache


def linearise(problem: Problem, X: Tensor, U: Tensor, out: Tensor | None = None) -> Tensor:
    """F (N, B, n+1, s) with [dx_{k+1}, 1] = F_k [dx_k, 1, du_k], around X (B, N+1, n), U (B, N, m).

    Stage first, as the backward pass reads it; written into `out` where that is given.
    """
    n, m, B = problem.n, problem.m, problem.B
    F = X.new_empty(problem.N, B, n + 1, n + 1 + m) if out is None else out
    F[..., n, :] = 0.0
    F[..., n] = 0.0
    F[..., n, n] = 1.0
    for rows in torch.arange(B, device=X.device).split(AT_ONCE if X.device.type == "cpu" else B):
        part = problem.dynamics if rows.numel() == B else problem.dynamics.take(rows)
        fx, fu = part.jacobians(X[rows, :-1], U[rows])
        place = slice(int(rows[0]), int(rows[-1]) + 1)
        F[:, place, :n, :n] = fx.transpose(0, 1)
        F[:, place, :n, n + 1 :] = fu.transpose(0, 1)
    return F


def quadratise(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """H (B, N+1, s, s): gradient and Hessian of J_var at every knot; the last block has no control part."""
    s = problem.n + 1 + problem.m
    H = X.new_zeros(X.shape[0], X.shape[1], s, s)
    problem.cost.expand(X, U, H)
    return H
