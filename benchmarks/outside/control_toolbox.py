"""python -m benchmarks.outside.control_toolbox: problems of OptimalControlProblems.jl, beside IPOPT by hand.

Models, bounds, ends and costs are those of the collection (control-toolbox/OptimalControlProblems.jl, commit 9017231),
but for those that other pages have (COPS). Both solvers get equal stages of RK4 steps and the integral of the cost as
a state. Where a problem of the collection leaves starts free, or sums a cost without the length of its steps, the
docstring of its rates says what is solved here.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from math import cos, pi, radians
from typing import Any

import numpy as np

import torchgco
from benchmarks.lib.command import Command
from benchmarks.lib.forms import INF, Form
from benchmarks.lib.page import markdown

States = Sequence[Any]


def beam(x: States, u: States, lib: Any) -> list[Any]:
    """Bryson's beam: the least square of the control, the deflection bounded."""
    return [x[1], u[0], u[0] ** 2]


def cart_pendulum(x: States, u: States, lib: Any) -> list[Any]:
    """A rod on a cart, x = [place, speed, angle from below, rate].

    The acceleration of the cart follows from the balance of forces (in the collection it is one number for all
    knots), and the cart begins at rest.
    """
    g, length, mass, cart = 9.81, 1.0, 1.0, 0.5
    inertia = mass * length**2 / 12 + 0.25 * mass * length**2
    half = 0.5 * mass * length
    s, c = lib.sin(x[2]), lib.cos(x[2])
    push = (u[0] + half * s * x[3] ** 2 + half**2 * g * s * c / inertia) / (cart + mass - half**2 * c**2 / inertia)
    return [x[1], push, x[3], -half * (push * c + g * s) / inertia]


def dielectrophoretic_particle(x: States, u: States, lib: Any) -> list[Any]:
    return [x[1] * u[0] - 0.75 * u[0] ** 2, -x[1] + u[0]]


def double_oscillator(x: States, u: States, lib: Any) -> list[Any]:
    """Two masses, x = [places, speeds, time, cost]; they begin at rest (in the collection with any speed)."""
    m1, m2, damping, k1, k2 = 100.0, 2.0, 0.5, 100.0, 3.0
    first = -(k1 + k2) / m1 * x[0] + k2 / m1 * x[1] + lib.sin(x[4]) / m1
    second = k2 / m2 * (x[0] - x[1]) - damping * (1 - u[0]) / m2 * x[3]
    return [x[2], x[3], first, second, 0.0 * u[0] + 1.0, 0.5 * (x[0] ** 2 + x[1] ** 2 + u[0] ** 2)]


def ducted_fan(x: States, u: States, lib: Any) -> list[Any]:
    """x = [place (2), speed (2), tilt, its rate, cost]."""
    s, c = lib.sin(x[4]), lib.cos(x[4])
    sideways, up = (u[0] * c - u[1] * s) / 2.2, (u[0] * s + u[1] * c - 4.0) / 2.2
    return [x[2], x[3], sideways, up, x[5], 0.2 * u[0] / 0.05, 2 * u[0] ** 2 + u[1] ** 2]


def electrical_vehicle(x: States, u: States, lib: Any) -> list[Any]:
    """A drive of 10 over a hilly road; the cost is in units of 1,000 and an integral."""
    slope = 3.0 + 0.4 * x[0] - x[0] ** 2 + 0.1 * x[0] ** 3
    return [x[1], u[0] - 1e-3 * x[1] ** 2 - 0.1 - slope, u[0] * x[1] + u[0] ** 2]


def jackson(x: States, u: States, lib: Any) -> list[Any]:
    """Two reactions in a row, and the share of two catalysts (Jackson, 1968): the arc in between is singular."""
    swap, made = u[0] * (x[0] - 10 * x[1]), (1 - u[0]) * x[1]
    return [-swap, swap - made, made]


def moonlander(x: States, u: States, lib: Any) -> list[Any]:
    """Two thrusters, x = [place (2), speed (2), tilt, its rate]."""
    thrust = u[0] + u[1]
    return [x[2], x[3], -thrust * lib.sin(x[4]), thrust * lib.cos(x[4]) - 9.81, x[5], 5.0 * (u[1] - u[0])]


def quadrotor(x: States, u: States, lib: Any) -> list[Any]:
    """x = [place (3), speed (3), roll, pitch]; u = [thrust, rates of roll and pitch].

    The collection bounds differences of roll and pitch, and weighs the yaw so much that it stays 0: it is left out.
    """
    a, sr, cr, sp, cp = u[0], lib.sin(x[6]), lib.cos(x[6]), lib.sin(x[7]), lib.cos(x[7])
    return [x[3], x[4], x[5], a * sp * cr, -a * sr, a * cp * cr - 9.81, u[1], u[2]]


def robbins(x: States, u: States, lib: Any) -> list[Any]:
    """Three integrators above 0, a bound of third order."""
    return [x[1], x[2], u[0], 3 * x[0] + 0.5 * u[0] ** 2]


def space_shuttle(x: States, u: States, lib: Any) -> list[Any]:
    """Reentry (Betts, 2010), x = [altitude (1e5 ft), latitude, speed (1e4 ft/s), path angle, azimuth].

    u = [angle of attack, bank]. The longitude, on which nothing depends, is left out.
    """
    mass, mu = 203000.0 / 32.174, 0.14076539e17
    attack = u[0] * (180 / pi)
    lift = -0.20704 + 0.029244 * attack
    drag = 0.07854 - 0.61592e-2 * attack + 0.621408e-3 * attack**2
    v, r = 1e4 * x[2], 20902900.0 + 1e5 * x[0]
    push = 0.5 * 2690.0 * 0.002378 * lib.exp(-1e5 * x[0] / 23800.0) * v / mass  # over the speed once more
    g, sg, cg = mu / r**2, lib.sin(x[3]), lib.cos(x[3])
    turn = push * lift * lib.sin(u[1]) / cg + v / r * cg * lib.sin(x[4]) * lib.sin(x[1]) / lib.cos(x[1])
    climb = push * lift * lib.cos(u[1]) + cg * (v / r - g / v)
    return [v * sg / 1e5, v / r * cg * lib.cos(x[4]), (-push * drag * v - g * sg) / 1e4, climb, turn]


def truck_trailer(x: States, u: States, lib: Any) -> list[Any]:
    """A truck with two trailers, x = [rear trailer (2), headings from the rear to the truck, speed, steering, cost].

    The collection adds the squares of the angles between trailers at all knots to the time; here it is their integral.
    """
    between, front = x[3] - x[2], x[4] - x[3]
    truck = x[5] / 0.4 * lib.tan(x[6])
    first = x[5] / 1.1 * lib.sin(front) - 0.1 / 1.1 * lib.cos(front) * truck
    pulled = x[5] * lib.cos(front) + 0.1 * lib.sin(front) * truck
    second = pulled / 0.8 * lib.sin(between) - 0.2 / 0.8 * lib.cos(between) * first
    rear = pulled * lib.cos(between) + 0.2 * lib.sin(between) * first
    return [rear * lib.cos(x[2]), rear * lib.sin(x[2]), second, first, truck, u[0], u[1], front**2 + between**2]


def vanderpol(x: States, u: States, lib: Any) -> list[Any]:
    return [x[1], (1 - x[0] ** 2) * x[1] - x[0] + u[0], 0.5 * (x[0] ** 2 + x[1] ** 2 + u[0] ** 2)]


def last(x: States) -> Any:
    return x[-1]


def bounds(n: int, **limits: tuple[float, float]) -> tuple[list[float], list[float]]:
    """Of n states, of which those are bounded that are given as x0, x1, ..."""
    pairs = [limits.get(f"x{i}", (-INF, INF)) for i in range(n)]
    return [low for low, _ in pairs], [high for _, high in pairs]


HALF = pi / 2
# Form, its time (a first one where it is free), stages, and what is known of the optimum.
PROBLEMS: dict[str, tuple[Form, float, int, float | None]] = {
    "beam": (
        Form(beam, [0, 1, 0], [0, -1, None], ([-10], [10]), bounds(3, x0=(0, 0.1)), (1, 1), last, 0.0), 1.0, 100,
        8 / (9 * 0.1),  # Bryson and Ho (1975), section 3.11
    ),
    "cart pendulum": (
        Form(cart_pendulum, [0] * 4, [None, None, pi, 0], ([-5], [5]), bounds(4, x0=(-1, 1), x1=(-2, 2)), (0.1, 20)),
        2.0, 100, None,
    ),
    "dielectrophoretic particle": (
        Form(dielectrophoretic_particle, [1, 0], [2, None], ([-1], [1]), None, (0.1, 30)), 5.0, 300, None,
    ),
    "double oscillator": (
        Form(double_oscillator, [0] * 6, [None] * 6, ([-1], [1]), None, (2 * pi, 2 * pi), last, 0.0), 2 * pi, 100, None,
    ),
    "ducted fan": (
        Form(ducted_fan, [0] * 7, [1, 0, 0, 0, 0, 0, None], ([-5, 0], [5, 17]), bounds(7, x4=(-pi / 6, pi / 6)),
             (0.1, 20), last, 1000.0, U0=[0, 4]),
        1.0, 100, None,
    ),
    "electrical vehicle": (
        Form(electrical_vehicle, [0] * 3, [10, 0, None], ([-INF], [INF]), None, (1, 1), last, 0.0), 1.0, 100, None,
    ),
    "Jackson": (
        Form(jackson, [1, 0, 0], [None] * 3, ([0], [1]), bounds(3, x0=(0, 1.1), x1=(0, 1.1), x2=(0, 1.1)), (4, 4),
             lambda x: -x[2], 0.0, U0=[0.1]), 4.0, 100, None,
    ),
    "moon lander": (
        Form(moonlander, [0] * 6, [5, 5, 0, 0, None, None], ([0, 0], [19.62, 19.62]), None, (0.1, 20), U0=[5, 5]),
        2.0, 100, None,
    ),
    "quadrotor": (
        Form(quadrotor, [0, 0, 2.5, 0, 0, 0, 0, 0], [0.01, 5, 2.5, 0, 0, 0, None, None], ([0, -3, -3], [45.9, 3, 3]),
             bounds(8, x6=(-HALF, HALF), x7=(-HALF, HALF)), (0.1, 20), U0=[10, 0, 0],
             path=lambda x, lib: [cos(0.55) - lib.cos(x[6]) * lib.cos(x[7])]),
        2.0, 60, None,
    ),
    "Robbins": (
        Form(robbins, [1, -2, 0, 0], [0, 0, 0, None], ([-INF], [INF]), bounds(4, x0=(0, INF)), (10, 10), last, 0.0),
        10.0, 100, None,
    ),
    "space shuttle": (
        Form(space_shuttle, [2.6, 0, 2.56, radians(-1), HALF], [0.8, None, 0.25, radians(-5), None],
             ([-HALF, radians(-89)], [HALF, radians(1)]),
             ([0, radians(-89), 1e-4, radians(-89), -INF], [INF, radians(89), INF, radians(89), INF]), (1757, 2259),
             lambda x: -x[1], 0.0),
        2008.0, 200, radians(34.1412),  # Betts (2010), section 6.1
    ),
    "truck trailer": (
        Form(truck_trailer, [0] * 8, [0, -2, HALF, HALF, HALF, None, None, None], ([-1, -pi / 10], [1, pi / 10]),
             bounds(8, x3=(-HALF, HALF), x4=(-HALF, HALF), x5=(-0.2, 0.2), x6=(-pi / 6, pi / 6)), (1, 200), last, 1.0,
             path=lambda x, lib: [x[3] - x[2] - HALF, x[2] - x[3] - HALF, x[4] - x[3] - HALF, x[3] - x[4] - HALF]),
        30.0, 100, None,
    ),
    "Van der Pol": (
        Form(vanderpol, [1, 0, 0], [None] * 3, ([-INF], [INF]), None, (2, 2), last, 0.0), 2.0, 100, None,
    ),
}  # fmt: skip
HEAD = (
    "problem", "states, controls, stages", "known", "gco", "status", "violation", "iterations", "s",
    "IPOPT by hand: value; iterations; s",
)  # fmt: skip


def straight(form: Form) -> Form:
    """The form, with the straight line between the given ends as the guess of the states."""
    pairs = [(begin, begin if end is None else end) for begin, end in zip(form.start, form.end, strict=True)]
    return replace(form, guess=lambda s: [begin + s * (end - begin) for begin, end in pairs])


def row(name: str) -> list[Any]:
    """A problem by both solvers."""
    form, first, N, known = PROBLEMS[name]
    problem = form.problem(N, first)
    torchgco.solve(problem, verbose=False)
    began = time.process_time()
    found = torchgco.solve(problem, verbose=False)
    spent = time.process_time() - began
    line = straight(form)
    hand, began = line.by_hand(N), time.process_time()
    assert line.guess is not None
    done, _, _, count, value = line.hand_solved(hand, N, np.array(form.start, dtype=float), line.guess, first)
    other = time.process_time() - began
    # In either direction the collection's sign: Jackson's and the shuttle's are maxima.
    sign = -1.0 if name in ("Jackson", "space shuttle") else 1.0
    return [
        name, f"{len(form.start)}, {len(form.control[0])}, {N}", "-" if known is None else f"{known:.6g}",
        f"{sign * float(found.cost[0]):.6g}", found.statuses[0].name, f"{float(found.violation[0]):.0e}",
        int(found.iterations[0]), f"{spent:.3f}",
        f"{sign * value:.6g}; {count}; {other:.2f}" if done else f"failed; {count}; {other:.2f}",
    ]  # fmt: skip


def text(problems: Sequence[str]) -> str:
    """The table."""
    return markdown(HEAD, [row(name) for name in problems])


main = Command(
    __doc__, "control_toolbox", text, "one thread", "CasADi", problems=(list(PROBLEMS), "which", list(PROBLEMS)),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
