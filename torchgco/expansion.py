"""Derivatives along a trajectory, all knots at once, in homogeneous form z = [x, 1, u]."""

from __future__ import annotations

import torch
from torch import Tensor

from torchgco.problem import Problem
from torchgco.shapes import pieces

AT_ONCE = 64  # problems that are differentiated together on a CPU: what is at work stays in the cache


def linearise(problem: Problem, X: Tensor, U: Tensor, out: Tensor | None = None) -> Tensor:
    """F (N, B, n+1, s) with [dx_{k+1}, 1] = F_k [dx_k, 1, du_k], around X (B, N+1, n), U (B, N, m).

    Stage first, as the backward pass reads it; written into `out` where that is given, which `standing` has made: a
    model that knows its zeros writes only what moves.
    """
    n, B = problem.n, problem.B
    F = standing(problem, B) if out is None else out
    places = torch.tensor([_place(problem, *at) for at in problem.dynamics.sparsity], device=X.device)
    for rows in pieces(B, AT_ONCE if X.device.type == "cpu" else B):
        part, x, u = problem.dynamics.take(rows), X[rows, :-1], U[rows]
        entries = part.step_entries(x, u)
        if entries is not None:
            F[:, rows].flatten(-2).index_copy_(-1, places, entries.transpose(0, 1))
            continue
        fx, fu = part.jacobians(x, u)
        F[:, rows, :n, :n] = fx.transpose(0, 1)
        F[:, rows, :n, n + 1 :] = fu.transpose(0, 1)
    return F


def standing(problem: Problem, B: int) -> Tensor:
    """F (N, B, n+1, s) of vehicles of a problem's form that stay where they are."""
    n, m = problem.n, problem.m
    F = problem.x0.new_zeros(problem.N, B, n + 1, n + 1 + m)
    F.diagonal(dim1=-2, dim2=-1).fill_(1.0)
    return F


def quadratise(problem: Problem, X: Tensor, U: Tensor, out: Tensor | None = None) -> Tensor:
    """H (B, N+1, s, s): gradient and Hessian of J_var at every knot; the last block has no control part."""
    s = problem.n + 1 + problem.m
    H = X.new_empty(X.shape[0], X.shape[1], s, s) if out is None else out
    problem.cost.expand(X, U, H)
    return H


def _place(problem: Problem, row: int, column: int) -> int:
    """Where an entry of [fx, fu] stands in a block of F that is read row by row."""
    n, m = problem.n, problem.m
    return row * (n + 1 + m) + (column if column < n else column + 1)
