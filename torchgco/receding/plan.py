"""What a loop flies: trajectories of several vehicles with feedback, sampled at any time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

from torchgco.base.errors import InputError, shown
from torchgco.base.numbers import measured
from torchgco.base.shapes import CPU, computing_on
from torchgco.base.tree import Rows, copied, put, take
from torchgco.constraints.bounds import Bounds
from torchgco.dynamics.base import Dynamics
from torchgco.lagrangian.lagrangian import shifted
from torchgco.problem.times import between

KNOT_ROUNDING = 1e-9  # of a stage: a time this close before a knot is the knot's
STAGE_ROUNDING = 1e-6  # of the stages between two steps: times are sums of periods


class Instant(NamedTuple):
    """A plan at one time."""

    x: Tensor  # (B, n)
    u: Tensor  # (B, m)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Trajectories with feedback u = U + K (x - X), each from a time of its own on.

    Args:
        X, U, K: (B, N+1, n), (B, N, m), (B, N, m, n).
        start: times of the first knots (B,), s.
        dt: of a stage, s.
        dynamics: lead from knot to knot.
        bounds: that controls with feedback keep; None: none.
        knots: times of the knots from `start` on, (B, N+1), s, where the time is free; None: dt apart.
    """

    X: Tensor
    U: Tensor
    K: Tensor
    start: Tensor
    dt: float
    dynamics: Dynamics
    bounds: Bounds | None = None
    knots: Tensor | None = None

    trajectory: ClassVar[tuple[str, ...]] = ("X", "U", "K", "start", "knots")  # what `put` gives to other vehicles

    @property
    def t(self) -> Tensor:
        """Times of the knots, (B, N+1), s."""
        return self.start.unsqueeze(-1) + (self._from_start if self.knots is None else self.knots)

    @property
    def _from_start(self) -> Tensor:
        """Times of knots dt apart from `start` on, (1, N+1), s."""
        return self.dt * torch.arange(self.X.shape[1], dtype=self.start.dtype).unsqueeze(0)

    @property
    def end(self) -> Tensor:
        """Times of the last knots, (B,), s."""
        return self.t[:, -1]

    def take(self, rows: Rows) -> Self:
        """The plans of some vehicles (b,)."""
        return take(self, rows)

    def put(self, rows: Tensor, other: Self) -> None:
        """Give some vehicles (b,) the trajectories of other plans (b, ...), in place."""
        for name in self.trajectory:
            put(getattr(self, name), rows, getattr(other, name))

    def with_rows(self, rows: Tensor, other: Self) -> Self:
        """The same, but for some vehicles (b,) with the trajectories of other plans (b, ...)."""
        plan = replace(self, **{name: copied(getattr(self, name)) for name in self.trajectory})
        plan.put(rows, other)
        return plan

    def moved_to(self, now: float) -> Self:
        """The plans from a time on, s: every knot as many stages later as are over by then; see `shifted`."""
        X, U, K = self.X.clone(), self.U.clone(), self.K.clone()
        for start in self.start.unique().tolist():
            rows, stages = self.start == start, stages_between((now - start) / self.dt)
            for series in (X, U, K):
                series[rows] = shifted(series[rows], stages)
        return replace(self, X=X, U=U, K=K, start=torch.full_like(self.start, now))

    def at(self, t: float, x: Any = None) -> Instant:
        """States (B, n) and controls (B, m) at a time, s.

        Controls are those of their stage, states are integrated from the knot before (`times.between`). Before its
        start a plan is at its first knot; after its end at its last one, with its last control.

        Args:
            x: states (B, n), or (n,) of one vehicle, that are measured then: controls get the feedback on the
                difference from the plan, within the bounds of controls.

        Raises:
            InputError: a time or states that are no finite numbers, or states of another shape.
        """
        if isinstance(t, bool) or not isinstance(t, int | float) or not np.isfinite(t):
            raise InputError("t", "a time in seconds", shown(t))
        with computing_on(CPU):
            return self._at(t, None if x is None else self._states(x))

    def mean(self, t: float, seconds: float, x: Any = None) -> Tensor:
        """The mean controls (B, m) from a time on, s, for so many seconds; x as in `at`.

        Stages may be shorter than the period for which a vehicle holds its controls.
        """
        with computing_on(CPU):
            knots = (self._from_start if self.knots is None else self.knots).numpy()
            since = t - self.start.numpy()[:, None]  # a loop's bits don't depend on when it began
            u = mean_controls(self.U, knots, since, seconds)
            return self._at(t, None if x is None else self._states(x), u).u

    def _at(self, t: float, measured_x: Tensor | None, u: Tensor | None = None) -> Instant:
        """`at`; with other controls u (B, m) than those of the stage, where they are given."""
        B, N, m = self.U.shape
        stages = self._stages(t)
        k = np.minimum(np.floor(stages + KNOT_ROUNDING), N - 1).astype(int)
        share = np.clip(stages - k, 0.0, 1.0)
        share[share < KNOT_ROUNDING] = 0.0
        rows = torch.arange(B)
        states = self._states_at(k, share)
        u = self.U[rows, k].clone() if u is None else u
        if measured_x is not None:
            u += (self.K[rows, k] @ (measured_x - states).unsqueeze(-1)).squeeze(-1)
            if self.bounds is not None:
                lower, upper = (bound.expand(B, N, m)[rows, k] for bound in self.bounds.over(N))
                u = torch.minimum(torch.maximum(u, lower), upper)
        return Instant(states, u)

    def _stages(self, t: float) -> np.ndarray:
        """How many stages are over at a time, s, (B,) from 0 to N."""
        N = self.U.shape[1]
        if self.knots is None:
            return np.asarray(np.clip((t - self.start.numpy()) / self.dt, 0.0, N))
        over = []
        for since, knots in zip(t - self.start.numpy(), self.knots.numpy(), strict=True):
            k = int(np.clip(np.searchsorted(knots, since, side="right") - 1, 0, N - 1))
            over.append(k + np.clip((since - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0))
        return np.array(over)

    def _states(self, x: Any) -> Tensor:
        B, _, n = self.X.shape
        return torch.from_numpy(measured(x, B, n)).expand(B, n)

    def _states_at(self, k: np.ndarray, share: np.ndarray) -> Tensor:
        """The states (B, n) after shares (B,) of the stages k (B,)."""
        rows = torch.arange(len(k))
        states = self.X[rows, k].clone()
        lengths = np.full(len(k), self.dt) if self.knots is None else self.knots.diff(dim=1)[rows, k].numpy()
        for stage, gone, length in sorted(set(zip(k.tolist(), share.tolist(), lengths.tolist(), strict=True))):
            if gone > 0:
                instant = torch.tensor([stage]), self.X.new_tensor([gone * length]), self.X.new_tensor([length])
                alike = torch.from_numpy((k == stage) & (share == gone) & (lengths == length))
                states[alike] = between(self.dynamics, self.X, self.U, *instant)[alike, 0]
        return states if self.knots is None else self.dynamics.settled(states)


def stages_between(count: float) -> float:
    """A number of stages, whole where it is but for rounding."""
    whole = round(count)
    return whole if abs(count - whole) <= STAGE_ROUNDING * max(1.0, count) else count


def mean_controls(U: Tensor, knots: np.ndarray, since: np.ndarray, seconds: float) -> Tensor:
    """The means (B, m) of controls U (B, N, m) from times `since` (B|1, 1) on, s, for so many seconds.

    Before the first of the knots' times (B|1, N+1) the first control holds, after the last one the last.
    """
    knots = np.repeat(knots, len(since) // len(knots), axis=0)
    knots[:, 0], knots[:, -1] = np.minimum(knots[:, 0], since[:, 0]), np.maximum(knots[:, -1], since[:, 0] + seconds)
    shares = torch.from_numpy(np.diff(np.clip(knots, since, since + seconds), axis=1) / seconds)
    # In the order of the stages, as exported C adds them: a product of matrices has another on each processor.
    return (shares.unsqueeze(-1) * U).cumsum(1)[:, -1]
