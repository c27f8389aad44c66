"""Nine starts for solvers of the general families, and the judge of what they return."""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import sha256
from math import pi

import torch
from torch import Tensor

from benchmarks.families.general_problems_base import Drawn
from torchgco import ControlBounds, Problem, solve

STARTS = ("rest", "held", "line", "left", "right", *(f"random{i}" for i in range(1, 5)))
Start = tuple[Tensor, Tensor]  # states (B, N+1, n), controls (B, N, m)


def rollout(problem: Problem, U: Tensor) -> Tensor:
    """States (B, N+1, n) along controls (B, N, m), step by step."""
    X = [problem.x0]
    for k in range(problem.N):
        X.append(problem.dynamics.step(X[-1], U[:, k]))
    return torch.stack(X, dim=1)


def cost_along(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """J_var (B,), summed stage by stage."""
    stages = [problem.cost.stage(X[:, k], U[:, k], k) for k in range(problem.N)]
    return torch.stack(stages).sum(0) + problem.cost.terminal(X[:, -1])


def violation_along(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """The largest violation of any row (B,), in the units of the problem; metres from obstacles. Infinite for NaN."""
    rows = [part.violation(X, U).flatten(1).amax(-1) for part in problem.constraints]
    return torch.stack(rows).nan_to_num(nan=torch.inf).amax(0)


def judged(problem: Problem, U: Tensor) -> dict[str, Tensor]:
    """Cost and violation (B,) along a rollout of the controls alone."""
    X = rollout(problem, U)
    return {"cost": cost_along(problem, X, U), "violation": violation_along(problem, X, U)}


def digest(problem: Problem) -> list[str]:
    """A name for each problem that changes with its numbers: from its start, step, cost and rows at a trajectory."""
    U = torch.full((problem.B, problem.N, problem.m), 0.3, dtype=problem.x0.dtype)
    X = problem.x0.unsqueeze(1) + 0.01 * torch.arange(problem.N + 1).view(1, -1, 1)
    step, cost = problem.dynamics.step(problem.x0, U[:, 0]), cost_along(problem, X, U)
    rows = [part.value(X, U).flatten(1) for part in problem.constraints]
    numbers = torch.cat((problem.x0, step, cost.unsqueeze(1), *rows), dim=1)
    shown = [" ".join(f"{value:.6g}" for value in row) for row in numbers.tolist()]
    return [sha256(f"{problem.N} {row}".encode()).hexdigest()[:8] for row in shown]


def starts(drawn: Drawn, seed: int) -> Iterator[tuple[str, Start]]:
    """All starts by name, "rest" first: that of `torchgco.solve`, with the states that its controls lead to."""
    problem = drawn.problem
    rest = solve(problem, solver="hold").U
    yield "rest", (_finite(problem, rollout(problem, rest)), rest)
    held = problem.x0.unsqueeze(1).expand(-1, problem.N + 1, -1)
    yield "held", (held.contiguous(), rest)
    share = torch.linspace(0, 1, problem.N + 1, dtype=rest.dtype).view(1, -1, 1)
    line = held + share * (drawn.end - problem.x0).unsqueeze(1)
    yield "line", (line, rest)
    for name, side in (("left", 0.4), ("right", -0.4)):
        yield name, (line + side * (pi * share).sin() * _across(drawn), rest)
    for name in STARTS[5:]:
        U = _smooth(problem, rest, 10 * seed + int(name[-1]))
        yield name, (_finite(problem, rollout(problem, U)), U)


def _finite(problem: Problem, X: Tensor) -> Tensor:
    return torch.where(torch.isfinite(X), X, problem.x0.unsqueeze(1))


def _across(drawn: Drawn) -> Tensor:
    """From start to end, turned by a right angle in the plane of the first two states, (B, 1, n)."""
    way = drawn.end - drawn.problem.x0
    turned = torch.zeros_like(way)
    turned[:, 0], turned[:, 1] = -way[:, 1], way[:, 0]
    return turned.unsqueeze(1)


def _smooth(problem: Problem, rest: Tensor, seed: int) -> Tensor:
    """Controls around rest or the middle of their bounds, random at eight knots and interpolated."""
    middle, spread = rest, torch.ones_like(rest)
    for bounds in problem.constraints:
        if isinstance(bounds, ControlBounds):
            middle = bounds.middle(rest)
            spread = torch.where(torch.isfinite(bounds.range), 0.25 * bounds.range, 1.0).unsqueeze(1).expand_as(rest)
    draws = torch.randn(problem.B, problem.m, 8, dtype=rest.dtype, generator=torch.Generator().manual_seed(seed))
    U = middle + spread * torch.nn.functional.interpolate(draws, problem.N, mode="linear", align_corners=True).mT
    for bounds in problem.constraints:
        if isinstance(bounds, ControlBounds):
            U = torch.clamp(U, bounds.lower.unsqueeze(1), bounds.upper.unsqueeze(1))
    return U
