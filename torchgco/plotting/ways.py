"""Trajectories as they are drawn: along the path of the model's own integrator between knots, as it is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from torchgco.judging.gates import crossings, passages
from torchgco.problem.problem import Problem
from torchgco.problem.times import curves


@dataclass(frozen=True, eq=False)
class Way:
    """A trajectory in pieces of each stage."""

    t: np.ndarray  # (T,), of unit steps from knot to knot before `until`
    clock: np.ndarray  # (T,) s, by which obstacles move; 0 of models without a time step
    X: np.ndarray  # (T, n)
    paths: tuple[np.ndarray, ...]  # (T, d) each: of the position, and of further ones that keep apart
    pieces: int  # of each stage: T = N pieces + 1
    crossings: np.ndarray  # (C, d), m: where gates are passed

    def until(self, t: np.ndarray) -> Way:
        """The way from the first to the last knot of times t (K,)."""
        T = self.pieces * (len(t) - 1) + 1
        moments = np.interp(self.t[:T], np.arange(len(t)), t)
        paths = tuple(path[:T] for path in self.paths)
        return replace(self, t=moments, clock=self.clock[:T], X=self.X[:T], paths=paths)


Ways = Mapping[str, Sequence[Way]]  # by solver, one for each layout


def ways_along(
    problem: Problem, X: Tensor, U: Tensor, times: Tensor | None, positions: Sequence[Sequence[int]]
) -> list[Way]:
    """The ways of trajectories X (B, N+1, n), U (B, N, m), whose chords paths leave by at most 1e-3 m.

    Args:
        times: of the knots (B, N+1), s, where the time is free.
        positions: the states of each path.
    """
    ways, along = dict[int, Way](), curves(problem, X, U, times)
    gates = passages(problem, X, U, along).values()
    knots, dt = np.arange(problem.N + 1), getattr(problem.dynamics, "dt", None) or 0.0
    for part in along:
        for row, x in zip(part.rows.tolist(), part.X.detach().cpu().double().numpy(), strict=True):
            t, seconds = np.arange(len(x)) / part.pieces, dt * knots if times is None else times[row].cpu().numpy()
            paths = tuple(x[:, list(states)] for states in positions)
            ways[row] = Way(t, np.interp(t, knots, seconds), x, paths, part.pieces, crossings(gates, row))
    return [ways[row] for row in range(len(X))]
