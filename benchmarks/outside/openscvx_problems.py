"""Three published examples of OpenSCvx (commit 815902c), stated for torchgco, with their rows and fields in NumPy.

Numbers are those of `examples/car/dubins_car.py`, `examples/drone/obstacle_avoidance.py` and
`examples/drone/drone_racing.py`, gravity of 9.18 m/s^2 included. The ellipsoids' matrices are what the second of these
draws, in single precision.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as field_of
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchgco import (
    BetweenKnots,
    Constraint,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    StateBounds,
)

D = torch.float64
GRAVITY = 9.18  # m/s^2
THRUST, TORQUE = 4.179446268 * 9.81, (18.665, 18.665, 0.55562)
CENTERS = np.array([[-5.1, 0.1, 2.0], [0.1, 0.1, 2.0], [5.1, 0.1, 2.0]])
ELLIPSOIDS = np.array([
    [[0.46003813, -0.03103311, -0.07250269], [-0.03103312, 0.48162603, 0.0031473245],
     [-0.07250269, 0.0031473273, 0.63770455]],
    [[0.41918752, -0.044198256, 0.056656014], [-0.04419823, 0.52937937, -0.03646444],
     [0.056656018, -0.036464445, 0.2978796]],
    [[0.49077967, -0.30442742, -0.15649691], [-0.30442742, 0.9781422, -0.111167036],
     [-0.1564969, -0.11116704, 0.93507]],
])  # fmt: skip
GATES = np.array([
    [61.936, 0.0, 22.5], [95.464, -23.75, 28.024], [95.464, -29.274, 22.5], [95.464, -23.75, 22.5],
    [132.65, -23.75, 22.5], [154.9, -73.152, 22.5], [95.464, -75.08, 22.5], [95.464, -68.556, 22.5],
    [61.936, -81.358, 22.5], [24.75, -42.672, 22.5],
])  # fmt: skip
WINDOW = np.array([1e-4, 2.5, 2.5])  # m, half sides of a gate
INF = np.inf
NO_COST = FunctionCost(lambda x, u: 0.0 * u[..., 0])  # time alone costs


@dataclass(frozen=True)
class Example:
    """One of them.

    Args:
        n, m: states and controls.
        field: x' of states (..., n) and controls (..., m), arrays or tensors.
        rows: by name how far states (..., n), an array, exceed what holds all the time, (...).
        most: bounds of controls, (2, m).
        start: given in its finite components; `guess_start` says where the others begin.
        goal: position at the end, m.
        nominal: duration, s, and the longest.
        within: rows that curve between knots.
        box: bounds of states, (2, n).
        intervals: between the nodes of the published example.
        stages: of ours.
        gates: centres that are passed at every second node.
        guess: positions along which the states begin, (K, d).
    """

    n: int
    m: int
    field: Callable[[Any, Any], Any]
    rows: Callable[[np.ndarray], Mapping[str, np.ndarray]]
    most: np.ndarray
    start: np.ndarray
    goal: np.ndarray
    nominal: tuple[float, float]
    within: Sequence[FunctionConstraint]
    box: np.ndarray
    intervals: int
    stages: int
    guess: np.ndarray
    gates: np.ndarray = field_of(default_factory=lambda: np.zeros((0, 3)))

    @property
    def gate_knots(self) -> list[int]:
        """Of our stages, of which each interval has as many."""
        return [2 * (i + 1) * self.stages // self.intervals for i in range(len(self.gates))]

    def problem(self, between: bool) -> Problem:
        """The example for torchgco, with rows between the knots or at these alone."""
        d, N, (seconds, longest) = len(self.goal), self.stages, self.nominal
        model = FunctionDynamics(self.field, self.n, self.m, seconds / N, "rk4", position=slice(0, d))
        rest = [INF] * (self.n - d)
        there = StateBounds([*self.goal, *(-v for v in rest)], [*self.goal, *rest], knots=[-1])
        parts: list[Constraint] = [ControlBounds(*self.most), StateBounds(*self.box), there, *self.within]
        parts += [BetweenKnots(row) for row in self.within] if between else []
        for k, center in zip(self.gate_knots, self.gates, strict=True):
            parts.append(StateBounds([*(center - WINDOW), *(-v for v in rest)], [*(center + WINDOW), *rest], knots=[k]))
        free = ~np.isfinite(self.start)
        if free.any():  # an attitude of any size is the same one
            size = lambda x: (x[..., 6:10] * x[..., 6:10]).sum(-1, keepdim=True) - 1.0
            parts += [FunctionConstraint(size, "equality", knots=[0]), StateBounds(*self._spin, knots=[0])]
        begins = np.where(free, [0.0] * 6 + [1.0] + [0.0] * 6 if self.n == 13 else 0.0, self.start)
        time = FreeTime(0.01, longest / seconds, weight=1.0, segments=self.gate_knots or None)
        x0 = torch.tensor(begins[None], dtype=D)
        return Problem(model, NO_COST, parts, x0, N, time=time, free_start=free.tolist() if free.any() else None)

    @property
    def _spin(self) -> np.ndarray:
        """Bounds of what is free in the start."""
        return np.where(np.isfinite(self.start), [[-INF], [INF]], self.box)

    def states(self) -> Tensor:
        """What ours begins with, (1, N+1, n): positions along the guess, the rest as at the start."""
        problem, share = self.problem(False), np.linspace(0.0, 1.0, self.stages + 1)
        knots = [0, *self.gate_knots, self.stages] if len(self.gates) else np.linspace(0, self.stages, len(self.guess))
        X = problem.x0.repeat(self.stages + 1, 1).numpy()
        for i, way in enumerate(self.guess.T):
            X[:, i] = np.interp(share * self.stages, knots, way)
        return torch.from_numpy(X[None])


def _lib(x: Any) -> Any:
    return torch if isinstance(x, Tensor) else np


def driving(x: Any, u: Any) -> Any:
    """[x, y, heading from y] of a car with speed and turn rate."""
    lib = _lib(x)
    return lib.stack((u[..., 0] * lib.sin(x[..., 2]), u[..., 0] * lib.cos(x[..., 2]), u[..., 1]), -1)


def flying(x: Any, u: Any) -> Any:
    """[p, v, q, w] of a drone of 1 kg and 1 kg m^2 with thrust and torques; q counts by its direction."""
    lib = _lib(x)
    q, w, T = x[..., 6:10], x[..., 10:13], u[..., 0]
    q = q / (q * q).sum(-1)[..., None] ** 0.5
    (a, b, c, d), (wx, wy, wz) = ([z[..., i] for i in range(z.shape[-1])] for z in (q, w))
    push = (2 * (b * d + a * c) * T, 2 * (c * d - a * b) * T, (1 - 2 * (b * b + c * c)) * T - GRAVITY)
    turn = (-wx * b - wy * c - wz * d, wx * a + wz * c - wy * d, wy * a - wz * b + wx * d, wz * a + wy * b - wx * c)
    rates = [x[..., 3 + i] for i in range(3)] + list(push) + [0.5 * part for part in turn]
    return lib.stack([*rates, *(u[..., i] for i in (1, 2, 3))], -1)


def beyond(x: np.ndarray, box: np.ndarray) -> np.ndarray:
    """How far states (..., n) are out of a box (2, n), in their units."""
    return np.asarray(np.maximum(box[0] - x, x - box[1]).max(-1))


def car(center: tuple[float, float], guess: np.ndarray) -> Example:
    """The car past a disc of 1 m."""
    size = np.array([5.0, 5.0, 2.0 * np.pi])
    box = np.stack((-size, size))
    disc = lambda x: 1.0 - ((x[..., 0] - center[0]) ** 2 + (x[..., 1] - center[1]) ** 2) ** 0.5
    return Example(
        3, 2, driving, lambda x: {"disc": disc(x), "box": beyond(x, box)}, np.array([[0.0, -5.0], [10.0, 5.0]]),
        np.array([0.0, -2.0, 0.0]), np.array([0.0, 2.0]), (1.2, 20.0),
        [FunctionConstraint(lambda x: disc(x)[..., None], name="disc")], box, 7, 28, guess,
    )  # fmt: skip


def drone_box(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    more = np.array([100.0] * 3 + [INF] * 4 + [10.0] * 3)
    return np.stack((np.concatenate((low, -more)), np.concatenate((high, more))))


def drone(
    low: Sequence[float], high: Sequence[float], place: Sequence[float], goal: Sequence[float], **more: Any
) -> Example:
    box = drone_box(low, high)
    rows, ellipsoids = more.pop("rows"), more.pop("ellipsoids")
    return Example(
        13, 4, flying, lambda x: {**ellipsoids(x), "box": beyond(x, box)},
        np.array([[0.0, *(-v for v in TORQUE)], [THRUST, *TORQUE]]),
        np.array([*place, *[0.0] * 3, *[np.nan] * 7]), np.array(goal), within=rows, box=box, **more,
    )  # fmt: skip


def past_ellipsoids() -> Example:
    def inside(x: Any) -> Any:
        parts = []
        for center, A in zip(CENTERS, ELLIPSOIDS, strict=True):
            d = [x[..., i] - center[i] for i in range(3)]
            parts.append(1.0 - sum(d[i] * float(A[i, j]) * d[j] for i in range(3) for j in range(3)))
        return _lib(x).stack(parts, -1)

    return drone(
        [-200.0, -100.0, 0.0], [200.0, 10.0, 20.0], [10.0, 0.0, 2.0], [-10.0, 0.0, 2.0],
        rows=[FunctionConstraint(inside, name="ellipsoids")], ellipsoids=lambda x: {"ellipsoids": inside(x).max(-1)},
        nominal=(4.0, 4.0), intervals=5, stages=40, guess=np.array([[10.0, 0.0, 2.0], [-10.0, 0.0, 2.0]]),
    )  # fmt: skip


def race() -> Example:
    above = FunctionConstraint(lambda x: 15.0 - x[..., 2:3], name="height")
    return drone(
        [-200.0, -100.0, 15.0], [200.0, 100.0, 200.0], [10.0, 0.0, 20.0], [10.0, 0.0, 20.0], rows=[above],
        ellipsoids=lambda x: {}, nominal=(24.0, 24.0), intervals=21, stages=210, gates=GATES,
        guess=np.array([[10.0, 0.0, 20.0], *GATES, [10.0, 0.0, 20.0]]),
    )  # fmt: skip


STRAIGHT = np.array([[0.0, -2.0], [0.0, 2.0]])
EXAMPLES = {
    "car, disc aside": car((-2.01, 0.0), STRAIGHT),
    "car, disc in the way": car((0.5, 0.0), np.array([[0.0, -2.0], [-0.6, 0.0], [0.0, 2.0]])),
    "drone past ellipsoids": past_ellipsoids(),
    "race through ten gates": race(),
}
