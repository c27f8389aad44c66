"""Published problems of several phases, as torchgco takes them and, by hand, as one program for IPOPT.

Equations of motion are written once, over components that may be PyTorch's or CasADi's; phases, jumps and links twice.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from benchmarks.families.phases_by_hand import Hand
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Jump,
    Phases,
    Problem,
    StateBounds,
)

Field = Callable[[Sequence[Any], Sequence[Any], Any], Sequence[Any]]  # of x, u and the module of functions: x'
Guess = list[
    tuple[np.ndarray, np.ndarray, float]
]  # of each phase states (N+1, n), controls (N, m) and the factor of time
NAN, INF = math.nan, math.inf


def model(field: Field, n: int, m: int, dt: float) -> FunctionDynamics:
    """A model of components, in steps of rk4."""
    rates = lambda x, u: torch.stack(tuple(field(x.unbind(-1), u.unbind(-1), torch)), dim=-1)
    return FunctionDynamics(rates, n=n, m=m, dt=dt, integrator="rk4")


def columns(field: Field) -> Callable[[Any, Any], Any]:
    """The same of CasADi's columns."""
    return lambda x, u: ca.vertcat(*field(ca.vertsplit(x), ca.vertsplit(u), ca))


def starts(x0: Sequence[float], B: int) -> Tensor:
    x = torch.tensor([x0], dtype=torch.float64)
    off = torch.rand(B, len(x0), dtype=torch.float64, generator=torch.Generator().manual_seed(7)) - 0.5
    off[0] = 0.0
    return x * (1.0 + 0.02 * off)


def at_end(function: Callable[[Tensor], Tensor], sense: Any = "equality") -> FunctionConstraint:
    return FunctionConstraint(function, sense, knots=[-1], name="end")


def ends(values: Sequence[float], places: Sequence[int]) -> FunctionConstraint:
    """Some states of the last knot."""
    there = torch.tensor(values, dtype=torch.float64)
    return at_end(lambda x: x[..., list(places)] - there)


NOTHING = FunctionCost(lambda x, u: 0.0 * x[..., 0])
IDLE = FunctionCost(lambda x, u: u[..., 0] ** 2)  # of a control that the model doesn't read


# A ball that falls, loses half its speed, and is pushed to height 1 with speed 1


def falling(x: Any, u: Any, M: Any) -> Any:
    return x[1], 0.0 * x[1] - 9.81


def pushed(x: Any, u: Any, M: Any) -> Any:
    return x[1], u[0] - 9.81


def ball(B: int) -> Phases:
    fall = Problem(model(falling, 2, 1, 0.025), IDLE, [ends([0.0], [0])], starts([1.0, 0.0], B), 20,
                   time=FreeTime(0.2, 4.0, weight=0.0, guess=1.0))  # fmt: skip
    effort = FunctionCost(lambda x, u: 0.0226 * u[..., 0] ** 2)
    rows = [ends([1.0, 1.0], [0, 1]), StateBounds([0.0, -INF], [1.0, INF])]
    push = Problem(model(pushed, 2, 1, 0.452 / 20), effort, rows, starts([0.0, 2.0], B), 20)
    return Phases([fall, push], [Jump(lambda x: torch.stack((x[..., 0], -0.5 * x[..., 1]), -1))])


def ball_by_hand(guess: Guess) -> Hand:
    hand = Hand()
    X, U, _ = hand.phase(columns(falling), *guess[0], 0.025, (0.2, 4.0), start=[1.0, 0.0])
    hand.cost += sum(u[0] ** 2 for u in U)
    hand.rows(X[-1][0])
    Y, V, _ = hand.phase(columns(pushed), *guess[1], 0.452 / 20)
    hand.cost += 0.0226 * sum(v[0] ** 2 for v in V)
    hand.rows(Y[0] - ca.vertcat(X[-1][0], -0.5 * X[-1][1]))
    hand.bound(Y[1:], [0.0, -INF], [1.0, INF])
    hand.rows(Y[-1] - ca.vertcat(1.0, 1.0))
    return hand


# Two impulses from a circle of radius 1 to one of radius 1.5, after a wait on the first


def orbiting(x: Any, u: Any, M: Any) -> Any:
    r3 = (x[0] ** 2 + x[1] ** 2) ** 1.5
    return x[2], x[3], -x[0] / r3, -x[1] / r3


def circular(x: Any, M: Any) -> Any:
    """Rows that a state of radius 1.5 on a circle keeps."""
    speed = 1.0 / 1.5**0.5
    return x[0] ** 2 + x[1] ** 2 - 2.25, x[0] * x[2] + x[1] * x[3], x[0] * x[3] - x[1] * x[2] - 1.5 * speed


def size(v: Any) -> Any:
    return (v[0] ** 2 + v[1] ** 2 + 1e-10) ** 0.5


def impulses(B: int) -> Phases:
    burn = Jump(
        lambda x, v: torch.cat((x[..., :2], x[..., 2:] + v), -1), controls=2, cost=lambda x, v: size(v.unbind(-1))
    )
    orbit = model(orbiting, 4, 1, 0.1)
    wait = Problem(orbit, IDLE, [], starts([1.0, 0.0, 0.0, 1.0], B), 5)
    transfer = Problem(
        orbit, IDLE, [], starts([0.9, 0.5, -0.5, 1.0], B), 50, time=FreeTime(0.2, 2.0, weight=0.0, guess=1.0)
    )
    on_circle = FunctionConstraint(lambda x: torch.stack(circular(x.unbind(-1), torch), -1), "equality", knots=[0])
    arrived = Problem(orbit, IDLE, [on_circle], starts([-0.75, 1.3, -0.7, -0.4], B), 5)
    return Phases([wait, transfer, arrived], [burn, burn])


def impulses_by_hand(guess: Guess) -> Hand:
    hand, f = Hand(), columns(orbiting)
    phases = [
        hand.phase(f, *guess[0], 0.1, start=[1.0, 0.0, 0.0, 1.0]),
        hand.phase(f, *guess[1], 0.1, (0.2, 2.0)),
        hand.phase(f, *guess[2], 0.1),
    ]
    for (X, _, _), (Y, _, _) in itertools.pairwise(phases):
        hand.rows(Y[0][:2] - X[-1][:2])
        hand.cost += size(ca.vertsplit(Y[0][2:] - X[-1][2:]))
    hand.cost += sum(u[0] ** 2 for _, U, _ in phases for u in U)
    hand.rows(ca.vertcat(*circular(ca.vertsplit(phases[2][0][0]), ca)))
    return hand


# An orbit raised from radius 1 to 3 by two burns of a weak engine, with the least change of velocity


def burning(x: Any, u: Any, M: Any) -> Any:
    r, _, vr, vt, a, _ = x
    along, up = a * M.cos(u[0]), a * M.sin(u[0])
    return vr, vt / r, vt * vt / r - 1.0 / r**2 + up, -vr * vt / r + along, a * a / 1.5, a


def coasting(x: Any, u: Any, M: Any) -> Any:
    r, _, vr, vt, a, _ = x
    return vr, vt / r, vt * vt / r - 1.0 / r**2, -vr * vt / r, 0.0 * a, 0.0 * a


RAISE = (0.05, (0.2, 4.0)), (0.25, (0.2, 4.0)), (0.05, (0.1, 4.0))  # dt and limits of the factor of time of each phase
DEGREES_90 = math.pi / 2


def orbit_raise(B: int) -> Phases:
    late = FunctionCost(lambda x, u: 0.0 * x[..., 0], lambda x: x[..., 5])
    end = ends([3.0, 0.0, 3.0**-0.5], [0, 2, 3])
    guesses = [1.0, 0.0, 0.0, 1.0, 0.1, 0.0], [1.3, 1.5, 0.2, 0.9, 0.12, 0.2], [2.9, 4.0, 0.1, 0.5, 0.12, 0.2]
    kinds = (burning, NOTHING, [ControlBounds(-DEGREES_90, DEGREES_90)]), (coasting, IDLE, []), (
        burning, late, [ControlBounds(-DEGREES_90, DEGREES_90), end],
    )  # fmt: skip
    problems = [
        Problem(model(field, 6, 1, dt), cost, rows, starts(x0, B), 40, time=FreeTime(*limits, weight=0.0, guess=1.0))
        for (field, cost, rows), (dt, limits), x0 in zip(kinds, RAISE, guesses, strict=True)
    ]
    return Phases(problems)


def orbit_raise_by_hand(guess: Guess) -> Hand:
    hand = Hand()
    end: Any = None
    for i, (field, (dt, limits)) in enumerate(zip((burning, coasting, burning), RAISE, strict=True)):
        start = [1.0, 0.0, 0.0, 1.0, 0.1, 0.0] if i == 0 else None
        X, U, _ = hand.phase(columns(field), *guess[i], dt, limits, start=start)
        if end is not None:
            hand.rows(X[0] - end)
        if i == 1:
            hand.cost += sum(u[0] ** 2 for u in U)
        else:
            hand.bound(U, [-DEGREES_90], [DEGREES_90])
        end = X[-1]
    hand.rows(end[[0, 2, 3]] - ca.vertcat(3.0, 0.0, 3.0**-0.5))
    hand.cost += end[5]
    return hand
