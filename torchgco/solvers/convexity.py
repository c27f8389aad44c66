"""Drawn guesses of controls, and whether problems look convex: what is convex has one minimum, whatever the guess."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchgco.base.draws import uniform
from torchgco.base.shapes import MISTAKES
from torchgco.constraints.base import Constraint
from torchgco.problem.problem import Problem

KNOTS = 4  # of the noise: with 8, guesses are bent more often than optima are, and lead to fewer of them
STREAM = 1 << 21  # outer iteration that keys the noise: no solve makes so many


def half_ranges(problem: Problem, U: Tensor) -> Tensor:
    """Half the range of each control between its bounds, (B, 1, m); 1 or the largest control where it is unbounded."""
    size = U.abs().amax(1, keepdim=True).clamp(min=1.0)
    if problem.control_bounds is None:
        return size
    half = 0.5 * problem.control_bounds.range.unsqueeze(1)
    return torch.where(torch.isfinite(half), half, size)


def controls_of(problem: Problem, U: Tensor, noise: Tensor) -> Tensor:
    """Controls (B, N, m) within their bounds, by noise in units of half their range from the middle, else from U."""
    bounds, half = problem.control_bounds, half_ranges(problem, U)
    if bounds is None:
        return U + half * noise
    lower, upper = bounds.over(problem.N)
    middle = torch.where(torch.isfinite(upper - lower), 0.5 * (lower + upper), U)
    return torch.clamp(middle + half * noise, lower, upper)


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
