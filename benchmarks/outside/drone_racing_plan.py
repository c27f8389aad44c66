"""Plans in the least time through the gates that are left, among frames and poles, each from the plan before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.outside.drone_racing_model import (
    CONTROLS,
    GRAVITY,
    LIFT,
    POLE,
    POSITION,
    STATES,
    TALL,
    TILT,
    VELOCITY,
    frames,
    rates,
    turned,
)
from torchgco import (
    Boxes,
    Capsules,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Gates,
    InteriorPoint,
    NormBounds,
    Problem,
    StateBounds,
)
from torchgco.problem.in_time import guessing_times, in_time, states_in_time
from torchgco.solvers.timing import of_user

STAGES, STAGE = 24, 0.04  # of a leg; s, a stage where the factor of time is 1
WALLS = np.array([[-2.9, -2.9, 0.1], [2.9, 2.9, 2.4]])  # m
ADMITTED = 1e-3  # m, violation of a plan that is flown
# Level 2 moves gates by up to 0.15 m along x and y, 0.21 m in all, and shows them from 0.7 m on in the plane. At the
# careful speed these 0.7 m take 0.55 s, in which `MODEL` moves 0.21 m aside and stops there (within `Limits`). Where a
# gate that isn't seen may come into sight, the speed has to be careful already.
DISPLACED = 0.21  # m
CAREFUL_SPEED = 0.7 / 0.55  # m/s
SIGHT = 0.7 + DISPLACED  # m
DECELERATION = 9.1  # m/s^2, at the tilt of `Limits`
ROUNDING_AREA = 0.1  # m^2, of the corner where the bound begins
ANY_SPEED = 100.0  # m/s: bounds nothing
MODEL = FunctionDynamics(rates, STATES, CONTROLS, STAGE, "rk4", POSITION)


def smoothness(x: Tensor, u: Tensor) -> Tensor:
    """Cost per second of commands apart from the state: without it, controls that don't matter are anything."""
    off = (u[..., :2] - x[..., TILT]).square().sum(-1)
    return 0.05 * off + 0.002 * (u[..., 2] - x[..., LIFT]).square()


def haste(x: Tensor, near: Tensor, careful: Tensor) -> Tensor:
    """Rows (..., 1), m/s: how much faster than careful, (..., 1), m/s, within `SIGHT` of a gate at (..., 2), m.

    Farther away the bound on v^2 grows so that braking by `DECELERATION` keeps it; the corner between is rounded.
    """
    far = (x[..., :2] - near).square().sum(-1, keepdim=True) - SIGHT**2
    beyond = 0.5 * (far + (far.square() + ROUNDING_AREA**2).sqrt())
    slack = x[..., VELOCITY].square().sum(-1, keepdim=True) - careful.square() - DECELERATION / SIGHT * beyond
    return 0.5 * slack / careful


@dataclass(frozen=True)
class Track:
    """The gates and poles as they are known now."""

    gates: np.ndarray  # (G, 3), m
    turns: np.ndarray  # (G, 4), [x, y, z, w]
    poles: np.ndarray  # (P, 3), m: their tops
    seen: np.ndarray  # (P,) bool: poles that were measured; the others may be elsewhere
    met: np.ndarray  # (G,) bool: gates that were measured


@dataclass(frozen=True)
class Limits:
    """What a plan leaves to feedback, and how near it goes."""

    speed: float = 2.2  # m/s
    room: float = 0.14  # m, of the drone's middle from frames
    beside: float = 0.14  # m, from poles
    unseen: float = 0.06  # m, more from poles that aren't seen
    half: float = 0.05  # m, half the width of the squares in which gates are crossed
    tilt: float = 0.75  # rad, commanded and flown
    lift: tuple[float, float] = (0.35, 1.5)  # times the weight
    careful: float = CAREFUL_SPEED  # m/s, where a gate that isn't seen may come into sight


# What is tried where there is no plan within the usual limits, as where a gate is seen late.
EASED = (
    Limits(3.0, 0.12, 0.12, 0.03, 0.075, 0.9, (0.3, 1.6)),
    Limits(4.0, 0.10, 0.11, 0.0, 0.10, 1.0, (0.25, 1.7)),
)  # fmt: skip


@dataclass
class Plan:
    """States (N+1, n) and controls (N, m) at times t (N+1,), s."""

    t: np.ndarray
    X: np.ndarray
    U: np.ndarray
    passed: int  # gates before the first leg
    gates: np.ndarray  # (G, 3), m: where they were when it was made
    speed: float  # m/s, the most that its limits allow
    solution: torchgco.Solution | None = field(default=None, repr=False)

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (K, n) and controls (K, m) at times (K,), s; after the end the drone flies straight on."""
        inside = np.clip(times, self.t[0], self.t[-1])
        k = np.clip(np.searchsorted(self.t, inside, side="right") - 1, 0, len(self.t) - 2)
        h = (self.t[k + 1] - self.t[k])[:, None]
        s = (inside - self.t[k])[:, None] / h
        X = (1 - s) * self.X[k] + s * self.X[k + 1]
        (a, va), (b, vb) = ((self.X[at, POSITION], self.X[at, VELOCITY]) for at in (k, k + 1))
        X[:, POSITION] = (
            (1 + 2 * s) * (1 - s) ** 2 * a + s**2 * (3 - 2 * s) * b + s * (1 - s) * h * ((1 - s) * va - s * vb)
        )
        X[:, POSITION] += np.maximum(times - self.t[-1], 0.0)[:, None] * X[:, VELOCITY]
        return X, self.U[k]


def posed(track: Track, x: np.ndarray, passed: int, share: float, limits: Limits) -> Problem:
    """The race from a state x (n,) through the gates after the first `passed` ones.

    Args:
        share: of the nominal thrust that the drone has.
    """
    G = len(track.gates) - passed
    N, firsts = G * STAGES + 1, [i * STAGES for i in range(1, G)]
    low, high = (share * GRAVITY * factor for factor in limits.lift)
    states = np.array([[-np.inf] * STATES, [np.inf] * STATES])
    states[:, POSITION] = WALLS
    states[:, TILT] = [[-limits.tilt] * 2, [limits.tilt] * 2]
    states[0], states[1] = np.minimum(states[0], x - 1e-3), np.maximum(states[1], x + 1e-3)
    speed = max(limits.speed, 1.02 * float(np.linalg.norm(x[VELOCITY])))
    boxes, halves, rotations = frames(track.gates, track.turns)
    around = POLE + np.where(track.seen, 0.0, limits.unseen)
    centers = track.gates[passed:]
    rows = [
        ControlBounds([-limits.tilt, -limits.tilt, low], [limits.tilt, limits.tilt, high]),
        StateBounds(*states),
        NormBounds(("x", [3, 4, 5]), upper=speed),
        _careful(track, x, passed, limits),
        Gates(centers, normals=turned(track.turns[passed:])[..., 0], half_widths=limits.half,
              knots=[*firsts, N - 1]),
        Boxes(boxes, halves, limits.room, rotations),
        Capsules(track.poles, track.poles - [0.0, 0.0, TALL], around, limits.beside),
    ]  # fmt: skip
    time = FreeTime(0.01, 4.0, guess=1.0, segments=firsts or None)
    return Problem(MODEL, FunctionCost(smoothness), rows, [x.tolist()], N, time=time)


def _careful(track: Track, x: np.ndarray, passed: int, limits: Limits) -> FunctionConstraint:
    """The bound on the speed on the way to gates that aren't seen; in x (n,) the drone may be faster already."""
    centers, now = track.gates[passed:, :2], float(x[VELOCITY] @ x[VELOCITY])
    most = np.where(track.met[passed:], ANY_SPEED, limits.careful)
    beyond = max(float(((x[:2] - centers[0]) ** 2).sum()) - SIGHT**2, 0.0)
    most[0] = max(most[0], 1.02 * max(now - DECELERATION / SIGHT * beyond, 0.0) ** 0.5)
    knots = np.arange(len(centers) * STAGES + 2)
    legs = np.clip((knots - 1) // STAGES, 0, len(centers) - 1)
    values = {"near": centers[legs][None], "careful": most[legs][None, :, None]}
    return FunctionConstraint(haste, name="haste", knot_values=values)


# A way through the nominal track, m, leg by leg: the first guess of the first plan. Each leg ends in a gate.
WAY = (
    ((-1.5, 0.75, 0.05), (-1.3, 0.7, 0.4), (-0.5, 0.6, 0.7), (0.2, 0.5, 0.7), (0.5, 0.25, 0.7)),
    ((0.5, 0.25, 0.7), (0.71, 0.04, 0.75), (1.05, -0.1, 0.95), (1.4, 0.15, 1.1), (1.35, 0.45, 1.2), (1.05, 0.75, 1.2)),
    ((1.05, 0.75, 1.2), (0.8, 0.9, 1.15), (0.3, 0.6, 1.0), (-0.4, -0.15, 0.75), (-1.0, -0.25, 0.7)),
    ((-1.0, -0.25, 0.7), (-1.25, -0.35, 0.8), (-1.35, -0.65, 0.95), (-1.0, -0.95, 1.1), (-0.5, -0.95, 1.2),
     (0.0, -0.75, 1.2)),
)  # fmt: skip
PACE = 1.5  # m/s, of that guess


def first(track: Track, x: np.ndarray, limits: Limits) -> Plan:
    """A plan through all gates, from a way that passes the nominal poles where they are.

    Raises:
        RuntimeError: none is found.
    """
    X0, U0, times = _along(WAY)
    problem = posed(track, x, 0, 1.0, limits)
    problem = guessing_times(problem, torch.from_numpy(times)[None])
    X0[0] = x
    solver = InteriorPoint(tolerance=1e-5)
    found = torchgco.solve(problem, torch.from_numpy(U0)[None], solver, X0=torch.from_numpy(X0)[None])
    if not float(found.violation[0]) <= ADMITTED:
        raise RuntimeError(f"no plan through the nominal track: {found.statuses[0].name}, {found.violation}")
    return Plan(found.t[0].numpy(), found.X[0].numpy(), found.U[0].numpy(), 0, track.gates, limits.speed, found)


def _along(way: Sequence[Sequence[Sequence[float]]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, controls and times along straight lines at `PACE`, upright."""
    P, t = [], [0.0]
    for i, leg in enumerate(way):
        points = np.array(leg)
        reached = np.concatenate(([0.0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()))
        last = i == len(way) - 1
        share = np.linspace(0.0, reached[-1], STAGES + 1)[: STAGES + last]
        P.append(np.stack([np.interp(share, reached, points[:, j]) for j in range(3)], axis=-1))
        t += list(t[-1] + np.full(STAGES, reached[-1] / STAGES / PACE).cumsum())
    beyond = 2 * P[-1][-1:] - P[-1][-2:-1]
    p, t = np.concatenate((*P, beyond)), np.array([*t, 2 * t[-1] - t[-2]])
    X = np.zeros((len(p), STATES))
    X[:, POSITION], X[:, VELOCITY], X[:, LIFT] = p, np.gradient(p, t, axis=0), GRAVITY
    return X, np.tile([0.0, 0.0, GRAVITY], (len(p) - 1, 1)), t


def again(
    before: Plan, track: Track, x: np.ndarray, now: float, passed: int, share: float, limits: Limits
) -> Plan | None:
    """A plan from state x at a time, beginning with the plan before; None where none is found."""
    X0, U0, times = _left(before, x, now, passed)
    X0[:, POSITION] += _moved(track.gates[passed:] - before.gates[passed:])
    for bounds in (limits, *EASED):
        problem = posed(track, x, passed, share, bounds)
        problem = guessing_times(problem, torch.from_numpy(times - times[0])[None])
        found = _from_guess(problem, torch.from_numpy(X0)[None], torch.from_numpy(U0)[None])
        if float(found.violation[0]) <= ADMITTED:
            t, X, U = now + found.t[0].numpy(), found.X[0].numpy(), found.U[0].numpy()
            return Plan(t, X, U, passed, track.gates, bounds.speed, found)
    return None


def as_soon(found: Plan, before: Plan, now: float, slack: float) -> bool:
    """Whether a plan ends about when the plan before does, to a slack, s: what a solve ends with may be a detour.

    One within slower limits than the plan before may take as much longer as these are slower.
    """
    slower = max(before.speed / found.speed, 1.0)
    return bool(found.t[-1] - now <= slower * (before.t[-1] - now) + slack)


def _from_guess(problem: Problem, X0: Tensor, U0: Tensor, barrier: float = 1e-3) -> torchgco.Solution:
    """One solve from a guess and its times, as `torchgco.solve` makes it, but without others after one that fails."""
    assert problem.time is not None
    X, U = states_in_time(problem, X0, U0, problem.time.guess)
    solver = InteriorPoint(tolerance=1e-3, initial_barrier=barrier, max_iterations=100)
    return of_user(problem, solver.solve(in_time(problem), U, X0=X))


def _moved(by: np.ndarray) -> np.ndarray:
    """How far the knots (N+1, 3) of a guess move where the gates at the ends of its G legs have moved by (G, 3), m."""
    G = len(by)
    ends, knots = np.arange(G + 1) * STAGES, np.arange(G * STAGES + 2)
    moves = np.concatenate((np.zeros((1, 3)), by))
    return np.stack([np.interp(knots, ends, moves[:, j]) for j in range(3)], axis=-1)


def _left(before: Plan, x: np.ndarray, now: float, passed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, controls and times of what is left of a plan: what is left of its first leg on all of the leg's knots."""
    skip = (passed - before.passed) * STAGES
    last = skip + STAGES if skip + STAGES < len(before.t) - 2 else len(before.t) - 1
    end = before.t[last]
    count = last - skip
    times = now + max(end - now, 0.05) * np.arange(count) / count
    X, U = before.at(times)
    later = max(now + 0.05 - end, 0.0)
    X = np.concatenate((X, before.X[last:]))
    U = np.concatenate((U, before.U[last:]))
    times = np.concatenate((times, before.t[last:] + later))
    X[0] = x
    return X, U, times
