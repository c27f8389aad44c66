"""States between the knots: those that the model's own integrator leads to within a stage."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchgco.dynamics.base import Dynamics
from torchgco.dynamics.integrators import INTEGRATORS
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem

PIECES_AT_MOST = 16  # of a stage: their chords are 256 times as close to a path as the stage's own


class Paths(NamedTuple):
    """Trajectories of some problems by shorter steps, whose chords are as good as their paths."""

    rows: Tensor  # (b,): which problems
    pieces: int  # of each stage
    X: Tensor  # (b, N pieces + 1, n)


def between(dynamics: Dynamics, X: Tensor, U: Tensor, k: Tensor, h: Tensor, lengths: Tensor) -> Tensor:
    """The states (B, T, n) at times h (T,), s, after the knots k (T,), on trajectories X (B, N+1, n), U (B, N, m).

    A model that integrates a derivative is integrated over h in place of its time step: after a whole stage the state
    is that of the next knot, to rounding. Models with a step alone have the straight line between two knots.

    Args:
        k: stages, int64 within 0..N-1.
        lengths: of these stages, (T,), s.
    """
    x, u = X[:, k], U[:, k]
    model = dynamics.at(k)
    if not model.stretches:
        return x + (h / lengths).unsqueeze(-1) * (X[:, k + 1] - x)
    # The field times h, over a unit of time: integrators take one time step for all states.
    x = INTEGRATORS[model.integrator](lambda z: h.unsqueeze(-1) * model.field(z, u), x, 1.0)
    return x if model.is_integrated else model.settled(x)  # as its own steps are


def bends(problem: Problem) -> bool:
    """Whether positions may leave the straight lines between their knots: by Euler's steps they don't."""
    return problem.dynamics.stretches and problem.dynamics.integrator != "euler"


def bulge(problem: Problem, X: Tensor, U: Tensor) -> Tensor:
    """How far what is measured leaves the chords of trajectories X (B, N+1, n), U (B, N, m), halfway, (B,), m.

    Of a body that is where its balls are, of pairs that keep a distance the vector between them.
    """
    off = torch.zeros_like(X[:, 0, 0])
    parts: list[Any] = [row.bare for row in problem.constraints if row.bare.on_the_way(X) is not None]
    if not parts or len(X) == 0:
        return off
    middle, even = states_within(problem, X, U, 2)[:, :, 0], 0.5 * (X[:, :-1] + X[:, 1:])
    for row in parts:
        apart = row.on_the_way(middle) - row.on_the_way(even)
        off = torch.maximum(off, apart.norm(dim=-1).flatten(1).amax(-1))
    return off


def paths(problem: Problem, X: Tensor, U: Tensor, off: Tensor | None = None) -> list[Paths]:
    """Trajectories X (B, N+1, n), U (B, N, m) in pieces so short that paths leave their chords by at most 1e-3 m.

    A quarter of the bulge is left where a piece is half as long; no stage has more than `PIECES_AT_MOST`. Problems with
    as many pieces are together.

    Args:
        off: their bulges (B,), m, where these are known.
    """
    every = torch.arange(len(X), device=X.device)
    if len(X) == 0 or not bends(problem):
        return [Paths(every, 1, X)]
    off = bulge(problem, X, U) if off is None else off
    pieces = (off / ADMITTED).nan_to_num(1.0, 1.0, 1.0).sqrt().ceil().clamp(1, PIECES_AT_MOST)
    polylines = []
    for count in pieces.unique().int().tolist():
        rows = (pieces == count).nonzero().flatten()
        if count == 1:
            polylines.append(Paths(rows, 1, X[rows]))
            continue
        subset = problem.take(rows)
        fine = torch.cat((X[rows, :-1].unsqueeze(2), states_within(subset, X[rows], U[rows], count)), dim=2).flatten(
            1, 2
        )
        polylines.append(Paths(rows, count, torch.cat((fine, X[rows, -1:]), dim=1)))
    return polylines


def states_within(problem: Problem, X: Tensor, U: Tensor, count: int) -> Tensor:
    """States (B, N, count - 1, n) at the ends of all but the last of `count` pieces of each stage."""
    N, dt = X.shape[1] - 1, float(problem.dynamics.dt)
    k = torch.arange(N, device=X.device).repeat_interleave(count - 1)
    h = dt / count * torch.arange(1, count, dtype=X.dtype, device=X.device).repeat(N)
    inner = between(problem.dynamics, X, U, k, h, torch.full_like(h, dt)).unflatten(1, (N, count - 1))
    if problem.horizon is None:
        return inner
    return torch.where(problem.running[..., None, None], inner, X[:, :-1].unsqueeze(2))  # at rest after the last knot
