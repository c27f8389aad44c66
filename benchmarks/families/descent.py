"""python -m benchmarks.families.descent: powered descents with least fuel, and their convex relaxation.

The lander of Acikmese and Ploen ("Convex programming approach to powered descent guidance for Mars landing", 2007): a
point whose mass is a state and whose thrust has a least and a largest size, here also a largest angle from the vertical
(Acikmese, Carson and Blackmore, 2013), above a glide slope, with a free time and a required end at rest. Starts are
drawn. `gco` has no guess but the nominal time that its problem names.

The relaxation, of the logarithm of the mass, acceleration and slack as these papers say, is convex for a fixed
time; the least fuel over times is found by a search along a line. The largest thrust, which the papers replace by a
tangent that forbids some of it, is replaced by a chord that allows more: the value is a lower bound, but for stages
along which the acceleration is constant there, the thrust here.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown, share
from torchgco import (
    Cone,
    FreeTime,
    FunctionCost,
    FunctionDynamics,
    Goal,
    NormBounds,
    Problem,
    Solution,
    StateBounds,
    Status,
)

GRAVITY = 3.7114  # m/s^2, of Mars
WET, DRY = 1905.0, 1505.0  # kg
PER_THRUST = 5e-4  # s/m: fuel per second and newton
LEAST, MOST = 4972.0, 13260.0  # N: 0.3 and 0.8 of six engines of 3.1 kN, canted by 27 degrees
POINTING, GLIDE = math.radians(45), math.radians(80)  # from the vertical; 10 degrees above ground
TIMES = 20.0, 120.0  # s
LENGTH, SPEED, PULL = 1000.0, 50.0, 10.0  # units of the relaxation, m, m/s, m/s^2
NEAR = 1e-2  # share of the relaxation's fuel
TIGHT = 1e-3  # largest share of the slack that exceeds the thrust where the relaxation is called tight
WIDE = 5.0  # s between the times that the relaxation is tried at first
FINE = 20  # steps in a stage of the flight


def starts(count: int, seed: int) -> np.ndarray:
    """Drawn states (count, 7): 1.5 to 2.5 km high, aside by 0.2 to 1.2 times that, at up to 117 m/s."""
    return np.stack([_start(np.random.default_rng((seed, number))) for number in range(count)])


def _start(rng: np.random.Generator) -> np.ndarray:
    height = rng.uniform(1500.0, 2500.0)
    aside, bearing = height * rng.uniform(0.2, 1.2), rng.uniform(-math.pi, math.pi)
    course = bearing + rng.uniform(-0.5, 0.5) + math.pi * (rng.random() < 0.5)  # away from the site, or towards it
    speed, fall = rng.uniform(0.0, 75.0), rng.uniform(20.0, 90.0)
    there = aside * math.cos(bearing), aside * math.sin(bearing), height
    return np.array([*there, speed * math.cos(course), speed * math.sin(course), -fall, WET])


def field(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [p (m), v (m/s), mass (kg)]; u is the thrust, N."""
    weight = torch.tensor([0.0, 0.0, GRAVITY], dtype=x.dtype)
    return torch.cat((x[..., 3:6], u / x[..., 6:] - weight, -PER_THRUST * u.norm(dim=-1, keepdim=True)), dim=-1)


def problem(x0: np.ndarray, N: int, nominal: float) -> Problem:
    """The descents from x0 (B, 7), in N stages; the nominal time, s, is where the search for the time begins."""
    up, free = [0.0, 0.0, 1.0], math.inf
    return Problem(
        FunctionDynamics(field, n=7, m=3, dt=nominal / N, integrator="rk4", position=slice(0, 3)),
        FunctionCost(lambda x, u: 0.0 * u[..., 0], lambda x: -x[..., 6]),
        [
            NormBounds("u", LEAST, MOST),
            Cone(up, POINTING, "u"),
            Cone(up, GLIDE, ("x", [0, 1, 2])),
            StateBounds([-free] * 6 + [DRY], free),
        ],
        torch.from_numpy(x0),
        N,
        Goal(state=[0.0] * 6 + [math.nan], required=True),
        time=FreeTime(TIMES[0] / nominal, TIMES[1] / nominal, weight=0.0),
    )


@dataclass(frozen=True)
class Bound:
    """What the relaxation says of a start."""

    fuel: float  # kg; infinite where no time serves
    duration: float  # s
    loose: float  # largest share of the slack that exceeds the thrust
    seconds: float  # of processor time


def relaxation(N: int) -> Callable[[np.ndarray], Bound]:
    """The relaxation's least fuel from states (7,)."""
    program = _convex(N)

    def at(duration: float, x0: np.ndarray) -> tuple[float, float]:
        """Fuel, kg, and `loose`; infinite where IPOPT doesn't end well."""
        found = program(x0=_guess(x0, N), p=np.append(x0, duration), lbg=0.0, ubg=program_limits)
        if not program.stats()["success"]:
            return math.inf, math.inf
        v = np.array(found["x"]).ravel()
        pulls, slack = v[7 * (N + 1) : -N].reshape(N, 3), v[-N:]
        return float(x0[6] - math.exp(v[7 * N + 6])), float((1.0 - np.linalg.norm(pulls, axis=1) / slack).max())

    program_limits = np.concatenate((np.zeros(13 + 7 * N), np.full(5 * N, math.inf)))

    def least(x0: np.ndarray) -> Bound:
        began, tried = time.process_time(), dict[float, tuple[float, float]]()

        def fuel(duration: float) -> float:
            tried[duration] = at(duration, x0)
            return min(tried[duration][0], 1e6 - duration)  # where there is none, a longer time is tried

        least_of = lambda: min(tried, key=lambda duration: tried[duration][0])
        for duration in np.arange(TIMES[0], TIMES[1] + WIDE, WIDE).tolist():
            fuel(duration)
        near = least_of() - WIDE, least_of() + WIDE
        minimize_scalar(fuel, bounds=near, method="bounded", options={"xatol": 0.05})
        best = least_of()
        return Bound(tried[best][0], best, tried[best][1], time.process_time() - began)

    return least


def _convex(N: int) -> ca.Function:
    """IPOPT for parameters x0 (7,) and a duration; variables X (7, N+1), accelerations (3, N), slacks (N,).

    The last state is the logarithm of the mass. Rows: equalities first, then those of at least 0.
    """
    X, W, S = ca.SX.sym("X", 7, N + 1), ca.SX.sym("W", 3, N), ca.SX.sym("S", N)
    x0, duration = ca.SX.sym("x0", 7), ca.SX.sym("T")
    h, down, mass = duration / N, ca.vertcat(0, 0, -GRAVITY / PULL), x0[6]
    unit = np.repeat([LENGTH, SPEED], 3)
    equal, least = [X[:6, 0] - x0[:6] / unit, X[6, 0] - ca.log(mass), X[:6, N]], list[ca.SX]()
    for k in range(N):
        pull, z = W[:, k] + down, X[6, k]
        moved = X[:3, k] + h * SPEED / LENGTH * X[3:6, k] + 0.5 * h * h * PULL / LENGTH * pull
        equal += [X[:3, k + 1] - moved, X[3:6, k + 1] - X[3:6, k] - h * PULL / SPEED * pull]
        equal += [X[6, k + 1] - z + h * PER_THRUST * PULL * S[k]]
        # The mass lies between those after the largest and after the least thrust: there the chord is above.
        lightest = ca.fmax(mass - PER_THRUST * MOST * h * k, DRY)
        low, high = ca.log(lightest), ca.log(mass - PER_THRUST * LEAST * h * k)
        along = (z - low) / ca.fmax(high - low, 1e-9)
        most = MOST * ((1 - along) / lightest + along * ca.exp(-high)) if k > 0 else MOST / mass
        least += [S[k] - LEAST * ca.exp(-z) / PULL, most / PULL - S[k]]
        least += [S[k] - ca.sqrt(ca.sumsqr(W[:, k]) + 1e-10), W[2, k] - math.cos(POINTING) * S[k]]
        least += [math.tan(GLIDE) * X[2, k] - ca.sqrt(ca.sumsqr(X[:2, k]) + 1e-8)] if k > 0 else []
    least.append(X[6, N] - math.log(DRY))
    rows = ca.vertcat(*equal, *least)
    v = ca.vertcat(ca.vec(X), ca.vec(W), S)
    quiet = {"print_time": False, "show_eval_warnings": False}
    options = quiet | {"ipopt": {"print_level": 0, "sb": "yes", "max_iter": 200, "tol": 1e-8}}
    return ca.nlpsol(
        "relaxed", "ipopt", {"x": v, "p": ca.vertcat(x0, duration), "f": -100 * X[6, N], "g": rows}, options
    )


def _guess(x0: np.ndarray, N: int) -> np.ndarray:
    """On the straight line to the end, in hover."""
    share = np.linspace(0.0, 1.0, N + 1)[:, None]
    X = (1.0 - share) * np.append(x0[:6] / np.repeat([LENGTH, SPEED], 3), 0.0)
    X[:, 6] = np.log(x0[6] - 0.5 * (WET - DRY) * share[:, 0])
    hover = GRAVITY / PULL
    return np.concatenate((X.ravel(), np.tile([0.0, 0.0, hover], N), np.full(N, 1.2 * hover)))


def flown(found: Solution) -> tuple[Tensor, Tensor]:
    """By how much the controls, in `FINE` RK4 steps a stage, miss the end and leave the glide slope on the way, m."""
    x, outside = found.X[:, 0], torch.zeros_like(found.cost)
    h = (found.duration / found.U.shape[1] / FINE).unsqueeze(-1)
    for u in found.U.unbind(1):
        for _ in range(FINE):
            k1 = field(x, u)
            k2 = field(x + 0.5 * h * k1, u)
            k3 = field(x + 0.5 * h * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(x + h * k3, u))
            away = x[:, :2].norm(dim=-1) * math.cos(GLIDE) - x[:, 2] * math.sin(GLIDE)
            outside = torch.maximum(outside, away)
    return x[:, :3].norm(dim=-1), outside


def row(x0: np.ndarray, N: int, nominal: float, bounds: list[Bound]) -> list[object]:
    """How `gco` does with one nominal time."""
    stated, count = problem(x0, N, nominal), len(x0)
    torchgco.solve(stated.take(slice(0, 1)), verbose=False)  # compiles
    began = time.process_time()
    found = torchgco.solve(stated, verbose=False)
    spent = (time.process_time() - began) / count
    verdict = torchgco.judge(stated, found.U, times=found.t)
    feasible, ended = verdict.feasible.numpy(), [status is Status.CONVERGED for status in found.statuses]
    ratios = (WET - found.X[:, -1, 6].numpy()) / np.array([bound.fuel for bound in bounds])
    end, outside = (float(miss.max()) for miss in flown(found))
    counts = found.iterations.numpy()
    return [
        f"{nominal:g}", share(feasible.sum(), count), sum(ended),
        share((feasible & (abs(ratios - 1.0) <= NEAR)).sum(), count),
        f"{np.median(ratios):.5f} ({ratios.min():.5f} to {ratios.max():.5f})",
        f"{np.median(counts):.0f} ({counts.max()})", f"{1e3 * spent:.0f}", f"{float(verdict.violation.max()):.0e}",
        f"{end:.0e}", f"{outside:.2f}",
    ]  # fmt: skip


def text(count: int, seed: int, stages: int, nominal: list[float]) -> str:
    """The table of nominal times, and what the relaxation says."""
    x0, least = starts(count, seed), relaxation(stages)
    bounds = [least(x) for x in x0]
    tight = sum(bound.loose <= TIGHT for bound in bounds)
    solved = [bound for bound in bounds if math.isfinite(bound.fuel)]
    spans = [f"{min(z):.0f} to {max(z):.0f}" for z in zip(*((b.fuel, b.duration) for b in solved), strict=True)]
    said = (
        f"The relaxation is solved for {share(len(solved), count)} starts, and tight for {share(tight, count)}: "
        f"{spans[0]} kg in {spans[1]} s; {np.median([bound.seconds for bound in bounds]):.2f} s a start."
    )
    head = ["nominal time, s", "judged feasible", "CONVERGED", "within 1 % of the relaxation",
            "fuel / the relaxation's", "iterations (most)", "ms a start", "largest violation",
            "end missed in flight, m", "outside the glide slope between knots, m"]  # fmt: skip
    return "\n\n".join([markdown(head, [row(x0, stages, each, bounds) for each in nominal]), said])


main = Command(
    __doc__, "free_time", text, "{count} drawn starts, seed {seed}, {stages} stages",
    "CasADi", mark="descent", count=(64, "starts"), seed=(7, "of the starts"), stages=(60, "of each descent"),
    nominal=([40.0, 60.0, 90.0], "times of the problem, s"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
