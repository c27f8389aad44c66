"""Trajectories as they are drawn: along the path of the model's own integrator between knots, as it is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from torchgco.problem.problem import Problem
from torchgco.problem.times import curves


@dataclass(frozen=True, eq=False)
class Way:
    """A trajectory in pieces of each stage."""

    t: np.ndarray  # (T,), of unit steps from knot to knot before `until`
    X: np.ndarray  # (T, n)
    paths: tuple[np.ndarray, ...]  # (T, d) each: of the position, and of further ones that keep apart
    pieces: int  # of each stage: T = N pieces + 1

    def until(self, t: np.ndarray) -> Way:
        """The way from the first to the last knot of times t (K,)."""
        T = self.pieces * (len(t) - 1) + 1
        moments = np.interp(self.t[:T], np.arange(len(t)), t)
        return replace(self, t=moments, X=self.X[:T], paths=tuple(path[:T] for path in self.paths))


def ways_along(
    problem: Problem, X: Tensor, U: Tensor, times: Tensor | None, positions: Sequence[Sequence[int]]
) -> list[Way]:
    """The ways of trajectories X (B, N+1, n), U (B, N, m), whose chords paths leave by at most 1e-3 m.

    Args:
        times: of the knots (B, N+1), s, where the time is free.
        positions: the states of each path.
    """
    ways = dict[int, Way]()
    for part in curves(problem, X, U, times):
        for row, x in zip(part.rows.tolist(), part.X.detach().cpu().double().numpy(), strict=True):
            t = np.arange(len(x)) / part.pieces
            ways[row] = Way(t, x, tuple(x[:, list(states)] for states in positions), part.pieces)
    return [ways[row] for row in range(len(X))]
