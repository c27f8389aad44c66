"""Whether problems look convex, by values on drawn segments: what is convex has one minimum, whatever the guess."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchgco.base.draws import uniform
from torchgco.base.shapes import MISTAKES
from torchgco.constraints.base import Constraint
from torchgco.problem.problem import Problem
from torchgco.solvers.drawn import controls_of

SEGMENTS = 4  # through all knots: a row that curves the wrong way does so along half of them or more
CURVES = 1e-9  # share of the largest value by which one in the middle may differ from the mean of the ends


def looks_convex(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """Whether problems whose time is held have affine models and equalities, and all else convex, (B,) bool.

    Args:
        X, U: trajectories (B, N+1, n), (B, N, m) in whose surroundings segments are drawn.
    """
    return _convex(problem, X, U, lambda X, U: _values(problem, X, U))


def looks_convex_row(problem: Problem, constraint: Constraint, X: Tensor, U: Tensor) -> Tensor:
    """Whether the rows of one constraint are, (B,) bool; see `looks_convex`."""
    return _convex(problem, X, U, lambda X, U: [(constraint.value(X, U), constraint.sense == "equality")])


def is_affine(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """Whether the steps of the model are affine, (B,) bool; see `looks_convex`."""
    return _convex(problem, X, U, lambda X, U: [(problem.along.step(X[:, :-1], U), True)])


def _convex(
    problem: Problem, X: Tensor, U: Tensor, values_of: Callable[[Tensor, Tensor], list[tuple[Tensor, bool]]]
) -> Tensor:
    """Whether values (B, ...) along segments around X, U are convex, or where they must be, affine, (B,) bool."""
    if len(X) == 0:
        return torch.zeros(0, dtype=torch.bool, device=X.device)
    size = X.amax(1, keepdim=True) - X.amin(1, keepdim=True)
    size = torch.where(size > 0, size, 1.0)
    convex = torch.isfinite(X).flatten(1).all(-1)
    for number in range(SEGMENTS):
        ends = [2.0 * uniform(2 * number + i, (problem.N + 1, problem.n + problem.m), X) - 1.0 for i in (0, 1)]
        states = [X + size * end[:, : problem.n] for end in ends]
        controls = [controls_of(problem, U, end[:-1, problem.n :]) for end in ends]
        try:
            values = [values_of(*z) for z in zip(states, controls, strict=True)]
            middle = values_of(0.5 * (states[0] + states[1]), 0.5 * (controls[0] + controls[1]))
        except MISTAKES:  # code that refuses such values
            return torch.zeros_like(convex)
        for pairs in zip(*values, middle, strict=True):
            a, b, m = (value.reshape(len(X), -1) for value, _ in pairs)
            if m.numel() == 0:
                continue
            most = CURVES * torch.maximum(a.abs().amax(-1), b.abs().amax(-1)).unsqueeze(-1)
            gap = 0.5 * (a + b) - m
            convex &= ((gap.abs() if pairs[-1][1] else -gap) <= most).all(-1)
    return convex


def _values(problem: Problem, X: Tensor, U: Tensor) -> list[tuple[Tensor, bool]]:
    """Values (B, ...) of model, cost and rows, and whether they must be affine."""
    cost = problem.cost
    with cost.precision(X.dtype):
        stages = cost.stage(X[:, :-1], U, torch.arange(problem.N, device=X.device)), cost.terminal(X[:, -1])
    rows = [(constraint.value(X, U), constraint.sense == "equality") for constraint in problem.constraints]
    return [(problem.dynamics.field(X[:, :-1], U), True), *((value, False) for value in stages), *rows]
