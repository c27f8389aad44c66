"""Published problems of several phases, continued: a launch, a car's gears, a take-off, an arm; see phases_problems."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import torch

from benchmarks.families.phases_by_hand import Hand
from benchmarks.families.phases_problems import INF, NOTHING, Field, Guess, at_end, columns, ends, model, starts
from torchgco import ControlBounds, FreeTime, FunctionConstraint, FunctionCost, Jump, Phases, Problem, StateBounds

# A Delta III to a transfer orbit with the largest mass: lengths in radii of the Earth, masses in that of the start

LENGTH, MASS, MU = 6378145.0, 301454.0, 3.986012e14
SPEED = math.sqrt(MU / LENGTH)
TIME = LENGTH / SPEED
FORCE = MASS * LENGTH / TIME**2
SPIN, DENSITY, HEIGHT = 7.29211585e-5 * TIME, 1.225 * LENGTH**3 / MASS, 7200.0 / LENGTH
DRAG = 0.5 * 0.5 * 4 * math.pi / LENGTH**2 * DENSITY
BOOSTER, MAIN, UPPER = 628500.0, 1083100.0, 110094.0  # thrust, N
BOOSTER_FLOW, MAIN_FLOW, UPPER_FLOW = 17010.0 / 75.2, 95550.0 / 261.0, 16820.0 / 700.0  # kg/s
BURNS = (
    (6 * BOOSTER + MAIN, 6 * BOOSTER_FLOW + MAIN_FLOW, 75.2), (3 * BOOSTER + MAIN, 3 * BOOSTER_FLOW + MAIN_FLOW, 75.2),
    (MAIN, MAIN_FLOW, 110.6), (UPPER, UPPER_FLOW, 700.0),
)  # fmt: skip
DROPPED = 6 * 2280.0 / MASS, 3 * 2280.0 / MASS, 8830.0 / MASS
LATITUDE = math.radians(28.5)
LAUNCH_STAGES = 20


def thrusting(thrust: float, flow: float) -> Field:
    thrust, flow = thrust / FORCE, flow * TIME / MASS

    def field(x: Any, u: Any, M: Any) -> Any:
        r = (x[0] ** 2 + x[1] ** 2 + x[2] ** 2) ** 0.5
        wind = x[3] + SPIN * x[1], x[4] - SPIN * x[0], x[5]
        drag = DRAG * M.exp((1.0 - r) / HEIGHT) * (wind[0] ** 2 + wind[1] ** 2 + wind[2] ** 2 + 1e-12) ** 0.5
        pulls = ((thrust * u[i] - drag * wind[i]) / x[6] - x[i] / r**3 for i in range(3))
        return x[3], x[4], x[5], *pulls, 0.0 * x[6] - flow

    return field


def elements(x: Any) -> Any:
    """Angular momentum, and two components of the vector of eccentricity, which are constant on an orbit."""
    h = x[1] * x[5] - x[2] * x[4], x[2] * x[3] - x[0] * x[5], x[0] * x[4] - x[1] * x[3]
    r = (x[0] ** 2 + x[1] ** 2 + x[2] ** 2) ** 0.5
    return *h, x[4] * h[2] - x[5] * h[1] - x[0] / r, x[5] * h[0] - x[3] * h[2] - x[1] / r


def on_orbit(anomaly: float) -> np.ndarray:
    """Position and velocity on the target orbit."""
    a, e, i, node, perigee = 24361140.0 / LENGTH, 0.7308, LATITUDE, math.radians(269.8), math.radians(130.5)
    p = a * (1.0 - e * e)
    turn = lambda t, j, k: np.eye(3) + _turned(t, j, k)
    frame = turn(node, 0, 1) @ turn(i, 1, 2) @ turn(perigee, 0, 1)
    along = np.array([math.cos(anomaly), math.sin(anomaly), 0.0]) * p / (1.0 + e * math.cos(anomaly))
    speed = np.array([-math.sin(anomaly), e + math.cos(anomaly), 0.0]) / math.sqrt(p)
    return np.concatenate((frame @ along, frame @ speed))


def _turned(t: float, j: int, k: int) -> np.ndarray:
    turned = np.zeros((3, 3))
    turned[j, j] = turned[k, k] = math.cos(t) - 1.0
    turned[j, k], turned[k, j] = -math.sin(t), math.sin(t)
    return turned


TARGET = elements(on_orbit(0.3))
PAD = [math.cos(LATITUDE), 0.0, math.sin(LATITUDE), 0.0, SPIN * math.cos(LATITUDE), 0.0, 1.0]


def launch_guesses() -> list[list[float]]:
    """Where the phases begin, evenly from the pad to a place on the orbit."""
    there, begins, masses = on_orbit(-0.46), np.cumsum([0.0, 75.2, 75.2, 110.6]) / 961.0, [1.0]
    for (_, flow, seconds), dropped in zip(BURNS, DROPPED, strict=False):
        masses.append(masses[-1] - flow * seconds / MASS - dropped)
    return [[*((1.0 - s) * np.array(PAD[:6]) + s * there), mass] for s, mass in zip(begins, masses, strict=True)]


def launch(B: int) -> Phases:
    unit = FunctionConstraint(lambda u: u.square().sum(-1, keepdim=True) - 1.0, "equality", of="u", name="direction")
    target = torch.tensor(TARGET, dtype=torch.float64)
    reached = at_end(lambda x: torch.stack(elements(x.unbind(-1)), -1) - target)
    heaviest = FunctionCost(lambda x, u: 0.0 * x[..., 0], lambda x: -x[..., 6] * MASS / 1e3)
    problems = []
    for i, ((thrust, flow, seconds), x0) in enumerate(zip(BURNS, launch_guesses(), strict=True)):
        dynamics, last = model(thrusting(thrust, flow), 7, 3, seconds / TIME / LAUNCH_STAGES), i == 3
        rows, cost = [unit, *([reached] if last else [])], heaviest if last else NOTHING
        time = FreeTime(0.5, 1.0, weight=0.0, guess=0.95) if last else None
        first = torch.tensor([x0], dtype=torch.float64).repeat(B, 1)
        first[:, 6] -= 1e-3 * torch.arange(B) / B if i == 0 else 0.0
        problems.append(Problem(dynamics, cost, rows, first, LAUNCH_STAGES, time=time))
    drop = lambda mass: Jump(lambda x: torch.cat((x[..., :6], x[..., 6:] - mass), -1))
    return Phases(problems, [drop(mass) for mass in DROPPED])


def launch_by_hand(guess: Guess) -> Hand:
    hand = Hand()
    end: Any = None
    for i, (thrust, flow, seconds) in enumerate(BURNS):
        f, dt = columns(thrusting(thrust, flow)), seconds / TIME / LAUNCH_STAGES
        X, U, _ = hand.phase(f, *guess[i], dt, (0.5, 1.0) if i == 3 else None, start=PAD if i == 0 else None)
        for u in U:
            hand.rows(ca.sumsqr(u) - 1.0)
        if end is not None:
            hand.rows(X[0] - end + ca.vertcat(np.zeros(6), DROPPED[i - 1]))
        end = X[-1]
    hand.rows(ca.vertcat(*elements(ca.vertsplit(end))) - ca.DM(TARGET))
    hand.cost += -end[6] * MASS / 1e3
    return hand


# A car through three gears, then to rest after 400 m, in the least time: states position (100 m), speed (10 m/s)

GEARS = 3.91, 2.002, 1.33
AXLE, WHEEL, CAR = 3.91, 0.302, 1239.0


def resisted(v: Any) -> Any:
    """Drag and rolling friction, N."""
    return 0.5 * 0.3 * 1.249512 * 1.4378946874 * v**2 + CAR * 9.81 * (0.009 + 0.002 * v / 100 + 0.0003 * (v / 100) ** 4)


def geared(gear: float) -> Field:
    def field(x: Any, u: Any, M: Any) -> Any:
        v, by = 10.0 * x[1], gear * AXLE / WHEEL
        w, share = v * by, 1.0 - M.exp(-3.0 * u[0])
        torque = share * (-37.8 + 1.54 * w - 0.0019 * w * w) + (1.0 - share) * (-34.9 - 0.04775 * w)
        return v / 100.0, (by * torque - resisted(v)) / CAR / 10.0

    return field


def braking(x: Any, u: Any, M: Any) -> Any:
    v = 10.0 * x[1]
    return v / 100.0, (-1e4 * u[0] - resisted(v)) / CAR / 10.0


CAR_MODELS = *(geared(gear) for gear in GEARS), braking
CAR_GUESSES = [0.0, 0.3], [0.1, 1.2], [0.8, 2.4], [3.0, 3.0]
CAR_LIMITS = 0.05, 4.0


def gears(B: int) -> Phases:
    time = FreeTime(*CAR_LIMITS, weight=1.0, guess=1.0)
    problems = []
    for i, (field, x0) in enumerate(zip(CAR_MODELS, CAR_GUESSES, strict=True)):
        rows = [ControlBounds(0.0, 1.0), *([ends([4.0, 0.0], [0, 1])] if i == 3 else [])]
        problems.append(Problem(model(field, 2, 1, 0.2), NOTHING, rows, starts(x0, B), 20, time=time))
    return Phases(problems)


def gears_by_hand(guess: Guess) -> Hand:
    hand = Hand()
    end: Any = None
    for i, field in enumerate(CAR_MODELS):
        X, U, tau = hand.phase(columns(field), *guess[i], 0.2, CAR_LIMITS, start=CAR_GUESSES[0] if i == 0 else None)
        hand.bound(U, [0.0], [1.0])
        hand.cost += 4.0 * tau
        if end is not None:
            hand.rows(X[0] - end)
        end = X[-1]
    hand.rows(end - ca.vertcat(4.0, 0.0))
    return hand


# An aircraft rolls, climbs to 300 m and speeds up there, in the least time: lengths in 1000 m, speeds in 100 m/s

WEIGHT, THRUST, AREA, STALL = 79015.8, 240204.0, 124.7, math.sqrt(2 * 79015.8 * 9.80665 / 1.225 / 124.7 / 2.0)
INDUCED = 1.0 / (math.pi * 9.45 * 0.801)


def aero(v: Any, h: Any, lift: Any) -> tuple[Any, Any]:
    """Lift and drag, N, with a coefficient of lift; near the ground there is less drag of it."""
    pressure, near = 0.5 * 1.225 * v * v * AREA, 33.0 * (((h + 1.0) / 17.85) ** 2 + 1e-4) ** 0.75
    return pressure * lift, pressure * (0.03 + INDUCED * near / (1.0 + near) * lift * lift)


def rolling(x: Any, u: Any, M: Any) -> Any:
    v = 100.0 * x[1]
    lift, drag = aero(v, 0.0, 0.5)
    return 0.1 * x[1], (THRUST - drag - 0.03 * (WEIGHT * 9.80665 - lift)) / WEIGHT / 100.0


def climbing(x: Any, u: Any, M: Any) -> Any:
    v, angle, attack = 100.0 * x[2], x[3], u[0]
    lift, drag = aero(v, 1000.0 * x[1], 0.5 + attack / math.radians(10) * 1.5)
    ahead = (THRUST * M.cos(attack) - drag) / WEIGHT - 9.80665 * M.sin(angle)
    up = (THRUST * M.sin(attack) + lift) / WEIGHT - 9.80665 * M.cos(angle)
    return v * M.cos(angle) / 1000.0, v * M.sin(angle) / 1000.0, ahead / 100.0, up / v


def cruising(x: Any, u: Any, M: Any) -> Any:
    v = 100.0 * x[1]
    _, drag = aero(v, 300.0, WEIGHT * 9.80665 / (0.5 * 1.225 * v * v * AREA))
    return 0.1 * x[1], (THRUST * u[0] - drag) / WEIGHT / 100.0


AIR_LIMITS = 0.05, 4.0
LIFT_OFF, CRUISE, ATTACK = 1.2 * STALL / 100.0, 1.8, math.radians(10)
GENTLE = 10.0, 0.1  # cost of the squared angle of attack, and of the share of thrust in cruise


def take_off(B: int) -> Phases:
    time = FreeTime(*AIR_LIMITS, weight=1.0, guess=1.0)
    idle = FunctionCost(lambda x, u: u[..., 0] ** 2)
    efforts = [FunctionCost(lambda x, u, by=by: by * u[..., 0] ** 2) for by in GENTLE]
    roll = Problem(model(rolling, 2, 1, 1.0), idle, [ends([LIFT_OFF], [1])], starts([0.0, 0.01], B), 20, time=time)
    limits = [ControlBounds(-ATTACK, ATTACK), StateBounds([-INF, 0.0, 0.5, -0.3], [INF, INF, 1.286, 0.3])]
    climb = Problem(model(climbing, 4, 1, 1.0), efforts[0], [*limits, ends([0.3, 0.0], [1, 3])],
                    starts([1.2, 0.0, LIFT_OFF, 0.0], B), 30, time=time)  # fmt: skip
    cruise = Problem(model(cruising, 2, 1, 1.0), efforts[1], [ControlBounds(0.0, 1.0), ends([CRUISE], [1])],
                     starts([3.0, 1.2], B), 20, time=time)  # fmt: skip
    lift = Jump(lambda x: torch.stack((x[..., 0], 0 * x[..., 0], x[..., 1], 0 * x[..., 0]), -1))
    return Phases([roll, climb, cruise], [lift, Jump(lambda x: x[..., [0, 2]])])


def take_off_by_hand(guess: Guess) -> Hand:
    hand = Hand()
    X, U, a = hand.phase(columns(rolling), *guess[0], 1.0, AIR_LIMITS, start=[0.0, 0.01])
    hand.cost += 20.0 * a + a * sum(u[0] ** 2 for u in U)
    hand.rows(X[-1][1] - LIFT_OFF)
    Y, V, b = hand.phase(columns(climbing), *guess[1], 1.0, AIR_LIMITS)
    hand.cost += 30.0 * b + GENTLE[0] * b * sum(v[0] ** 2 for v in V)
    hand.rows(Y[0] - ca.vertcat(X[-1][0], 0.0, X[-1][1], 0.0))
    hand.bound(V, [-ATTACK], [ATTACK])
    hand.bound(Y[1:], [-INF, 0.0, 0.5, -0.3], [INF, INF, 1.286, 0.3])
    hand.rows(Y[-1][[1, 3]] - ca.vertcat(0.3, 0.0))
    Z, W, c = hand.phase(columns(cruising), *guess[2], 1.0, AIR_LIMITS)
    hand.cost += 20.0 * c + GENTLE[1] * c * sum(w[0] ** 2 for w in W)
    hand.bound(W, [0.0], [1.0])
    hand.rows(Z[0] - Y[-1][[0, 2]])
    hand.rows(Z[-1][1] - CRUISE)
    return hand


# An arm of two links reaches for a mass, carries it, and goes back without it

LOAD = 1.0  # kg


def arm(load: float) -> Field:
    def field(x: Any, u: Any, M: Any) -> Any:
        a, b, va, vb = x
        tip, c, s = 1.0 + load, M.cos(b), M.sin(b)
        inertia = 1.0 + tip * (2.0 + 2.0 * c), tip * (c + 1.0), tip
        heavy = 9.81 * tip * M.cos(a + b)
        first = u[0] + tip * s * (2.0 * va * vb + vb * vb) - 9.81 * (1.0 + tip) * M.cos(a) - heavy
        second = u[1] - tip * s * va * va - heavy
        det = inertia[0] * inertia[2] - inertia[1] ** 2
        return (
            va,
            vb,
            (inertia[2] * first - inertia[1] * second) / det,
            (inertia[0] * second - inertia[1] * first) / det,
        )

    return field


ARM_LOADS, ARM_LIMITS, TORQUE = (0.0, LOAD, 0.0), (0.2, 4.0), [60.0, 30.0]
ARM_PLACES = [-1.57, 0.0, 0.0, 0.0], [-0.8, 1.6, 0.0, 0.0], [0.6, -1.2, 0.0, 0.0], [-1.57, 0.0, 0.0, 0.0]


def pick_and_place(B: int) -> Phases:
    cost = FunctionCost(lambda x, u: 1e-4 * u.square().sum(-1))
    limits, time = ControlBounds([-t for t in TORQUE], TORQUE), FreeTime(*ARM_LIMITS, weight=1.0, guess=1.0)
    problems = [
        Problem(model(arm(load), 4, 2, 0.04), cost, [limits, ends(there, range(4))], starts(here, B), 25, time=time)
        for load, here, there in zip(ARM_LOADS, ARM_PLACES, ARM_PLACES[1:], strict=False)
    ]
    return Phases(problems)


def pick_and_place_by_hand(guess: Guess) -> Hand:
    hand = Hand()
    end: Any = None
    for i, load in enumerate(ARM_LOADS):
        X, U, tau = hand.phase(columns(arm(load)), *guess[i], 0.04, ARM_LIMITS, start=ARM_PLACES[0] if i == 0 else None)
        hand.bound(U, [-t for t in TORQUE], TORQUE)
        hand.cost += 1.0 * tau + 1e-4 * tau * sum(ca.sumsqr(u) for u in U)
        if end is not None:
            hand.rows(X[0] - end)
        end = X[-1]
        hand.rows(end - ca.vertcat(*ARM_PLACES[i + 1]))
    return hand
