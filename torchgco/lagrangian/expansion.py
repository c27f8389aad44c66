"""Derivatives along a trajectory, all knots at once, in homogeneous form z = [x, 1, u]."""

from __future__ import annotations

from torch import Tensor

from torchgco.problem.problem import Problem


def linearise(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """F (N, B, n+1, s) with [dx_{k+1}, 1] = F_k [dx_k, 1, du_k], around X (B, N+1, n), U (B, N, m).

    Stage first, as the backward pass reads it.
    """
    n, m, (B, N) = problem.n, problem.m, U.shape[:2]
    fx, fu = problem.along.jacobians(X[:, :-1], U)
    F = X.new_zeros(N, B, n + 1, n + 1 + m)
    F[..., :n, :n] = fx.transpose(0, 1)
    F[..., :n, n + 1 :] = fu.transpose(0, 1)
    F[..., n, n] = 1.0
    return F


def quadratise(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """H (B, N+1, s, s): gradient and Hessian of J_var at every knot; the last block has no control part."""
    s = problem.n + 1 + problem.m
    H = X.new_empty(*X.shape[:2], s, s)
    problem.cost.expand(X, U, H)
    return H
