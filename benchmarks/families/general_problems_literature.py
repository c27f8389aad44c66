"""Set 3 of the general families, first half: optimal control from the literature, with known optima where there are.

COPS: Dolan, Moré, Munson, Benchmarking Optimization Software with COPS 3.0 (2004).
"""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import torch
from torch import Tensor

from benchmarks.families.general_problems_base import (
    INF,
    Drawn,
    Draws,
    balls,
    effort,
    ends_at,
    least_time,
    numbers,
    rk4,
    stacked,
    with_free_time,
)
from benchmarks.families.general_problems_classics import GRAVITY
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Goal,
    Problem,
    Spheres,
    StateBounds,
)


def bryson_denham(draw: Draws) -> Drawn:
    """From (0, 1) to (0, -1) in 1 s with x below a limit."""
    limit, end = draw(0.06, 0.16), draw.states(0, -1)
    upper = draw.states(limit, INF)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), 2, 1, 0.01, "rk4")
    parts = [StateBounds(torch.full_like(upper, -INF), upper), ends_at(end)]
    return Drawn(Problem(model, effort(0.01, 0.5), parts, draw.states(0, 1), 100), end)


def bryson_denham_known(problem: Problem) -> Tensor:
    """4 / (9 l) for limits l up to 1/6."""
    (bounds,) = (part for part in problem.constraints if isinstance(part, StateBounds))
    return 4.0 / (9.0 * bounds.upper[:, 0])


def slide(x: Tensor, u: Tensor) -> Tensor:
    """x = [p (2, m), speed (m/s)], u = angle from the vertical (rad)."""
    v, angle = x[..., 2:], u[..., :1]
    return torch.cat((v * angle.sin(), -v * angle.cos(), GRAVITY * angle.cos()), dim=-1)


def slides(draw: Draws, model: FunctionDynamics, cost: FunctionCost, *parts: ControlBounds) -> Drawn:
    """The fastest slide to a point, from rest."""
    end = draw.states(draw(1.0, 2.5), draw(-1.8, -0.6), 0)
    return Drawn(Problem(model, cost, [*parts, ends_at(end, slice(0, 2))], draw.states(0, 0, 0), 50), end)


def brachistochrone(draw: Draws) -> Drawn:
    return slides(draw, with_free_time(slide, 3, 2, 0.016), least_time(0.016), ControlBounds([-INF, -0.5], [INF, 0.5]))


def brachistochrone_raw(draw: Draws) -> Drawn:
    """The same with the length of a stage itself as a control."""
    model = FunctionDynamics(lambda x, u: rk4(lambda at: slide(at, u), x, u[..., 1:]), 3, 2, 0.016, "none")
    cost = FunctionCost(lambda x, u: u[..., 1] + 1e-3 * (u[..., 1] - 0.016).square() + 1.6e-7 * u[..., 0].square())
    return slides(draw, model, cost, ControlBounds([-INF, 1e-3], [INF, 0.2]))


def brachistochrone_known(problem: Problem) -> Tensor:
    """The time on a cycloid x = r (a - sin a), y = -r (1 - cos a): a sqrt(r / g)."""
    (end,) = (part for part in problem.constraints if isinstance(part, FunctionConstraint))
    goal = end.values.rows[0]
    low, high = torch.full_like(goal[:, 0], 1e-3), torch.full_like(goal[:, 0], 2 * pi - 1e-3)
    for _ in range(60):  # the ratio of x to -y rises with a
        a = 0.5 * (low + high)
        flat = (a - a.sin()) / (1 - a.cos()) > -goal[:, 0] / goal[:, 1]
        low, high = torch.where(flat, low, a), torch.where(flat, a, high)
    return low * (-goal[:, 1] / (1 - low.cos()) / GRAVITY).sqrt()


def time_optimal_di(draw: Draws) -> Drawn:
    """To rest at 0 in the least time with an acceleration of at most 1."""
    field = lambda x, u: stacked(x[..., 1], u[..., 0])
    x0, end = draw.states(draw(1.0, 2.5), 0), draw.states(0, 0)
    parts = [ControlBounds([-1, -0.5], [1, 0.5]), ends_at(end)]
    return Drawn(Problem(with_free_time(field, 2, 2, 0.042), least_time(0.042), parts, x0, 60), end)


def time_optimal_di_known(problem: Problem) -> Tensor:
    return 2.0 * problem.x0[:, 0].sqrt()


def time_optimal_car(draw: Draws) -> Drawn:
    """From rest to a pose at rest among five discs in the least time; u = acceleration, turn rate."""
    field = lambda x, u: stacked(x[..., 3] * x[..., 2].cos(), x[..., 3] * x[..., 2].sin(), u[..., 1], u[..., 0])
    x0, end = draw.states(0, 0, draw(-0.3, 0.3), 0), draw.states(draw(5, 7), draw(-1, 1), draw(-0.5, 0.5), 0)
    discs = Spheres(*balls(draw, 5, ([1.0, -1.5], [5.0, 1.5]), (0.3, 0.6), 0.2, x0[:, :2], end[:, :2]), 0.2)
    bounds = [ControlBounds([-1, -1, -0.5], [1, 1, 0.5]), StateBounds([-INF, -INF, -INF, -1], [INF, INF, INF, 2])]
    parts = [*bounds, discs, ends_at(end)]
    model = with_free_time(field, 4, 3, 0.09, slice(0, 2))
    return Drawn(Problem(model, least_time(0.09), parts, x0, 60, Goal(end[:, :2], 0.3)), end)


def particle_steering(draw: Draws) -> Drawn:
    """COPS: an acceleration of 100 in a free direction, to a height at speed (45, 0), in the least time.

    The first height is that of COPS, 5.
    """
    height = draw(4.0, 6.0)
    height[0] = 5.0
    field = lambda x, u: torch.cat((x[..., 2:], 100.0 * u[..., :1].cos(), 100.0 * u[..., :1].sin()), dim=-1)
    end = draw.states(12, height, 45, 0)
    parts = [ControlBounds([-INF, -0.5], [INF, 0.5]), ends_at(end, slice(1, 4))]
    x0 = draw.states(0, 0, 0, 0)
    return Drawn(Problem(with_free_time(field, 4, 2, 0.0111), least_time(0.0111), parts, x0, 50), end)


def goddard(draw: Draws) -> Drawn:
    """COPS: the greatest height of a rocket, here after a fixed time; drag falls exponentially with the height."""

    def field(x: Tensor, u: Tensor, drag: Tensor) -> Tensor:
        h, v, mass = x.unbind(-1)
        against = 0.5 * drag * v * v.abs() * torch.exp(-500.0 * (h - 1.0))
        return stacked(v, (u[..., 0] - against) / mass - 1.0 / h**2, -2.0 * u[..., 0])

    model = FunctionDynamics(field, 3, 1, 0.002, "rk4", values={"drag": draw(580.0, 660.0)})
    parts = [ControlBounds(0, 3.5), StateBounds([1, -INF, 0.6], [INF, INF, INF])]
    cost = FunctionCost(lambda x, u: 1e-6 * u.square().sum(-1), lambda x: -x[..., 0])
    return Drawn(Problem(model, cost, parts, draw.states(1, 0, 1), 100), draw.states(1.012, 0, 0.6))


def hang_glider(draw: Draws) -> Drawn:
    """COPS: the greatest range of a hang glider through an updraft, in free time.

    x = [p (2, 100 m), v (2, 10 m/s)], u = [lift coefficient less 0.7, logarithm of the stage time]. Stages are two
    steps of the integrator, and their lengths bounded: longer steps would be exploited.
    """

    def field(x: Tensor, u: Tensor) -> Tensor:
        at, vx, vy = x[..., 0], 10.0 * x[..., 2], 10.0 * x[..., 3]
        lift = 0.7 + u[..., 0]
        r = (at - 2.5).square()
        w = vy - 2.5 * (1.0 - r) * (-r).exp()
        speed = (vx.square() + w.square()).sqrt()
        push = 0.5 * 1.13 * 14.0 * speed  # L and D over the coefficients and the speed
        drag = 0.034 + 0.069662 * lift.square()
        ax, ay = (-push * (lift * w + drag * vx)) / 100.0, (push * (lift * vx - drag * w)) / 100.0 - 9.80665
        return stacked(vx / 100.0, vy / 100.0, ax / 10.0, ay / 10.0)

    def step(x: Tensor, u: Tensor) -> Tensor:
        half, rates = 0.625 * u[..., 1:].exp(), lambda at: field(at, u)
        return rk4(rates, rk4(rates, x, half), half)

    height = torch.cat((numbers(10.0), draw(9.9, 10.3)[1:]))
    end = draw.states(12.5, 9.0, 1.323, -0.1288)
    x0 = draw.states(0, height, 1.323, -0.1288)
    cost = FunctionCost(lambda x, u: 1e-5 * u.square().sum(-1), lambda x: -x[..., 0])
    parts = [ControlBounds([-0.7, -0.3], [0.7, 0.3]), ends_at(end, slice(1, 4)), StateBounds([0, 0, 0, -INF], INF)]
    return Drawn(Problem(FunctionDynamics(step, 4, 2, 1.25, "none"), cost, parts, x0, 80), end)


def robot_arm(draw: Draws) -> Drawn:
    """COPS: an arm that turns and telescopes, to a place at rest in the least time.

    x = [length, azimuth, polar angle, their rates]. The first problem is that of COPS.
    """

    def field(x: Tensor, u: Tensor) -> Tensor:
        length, polar = x[..., 0], x[..., 2]
        inertia = ((5.0 - length) ** 3 + length**3) / 3.0
        turn = stacked(u[..., 0] / 5.0, u[..., 1] / (inertia * polar.sin().square()), u[..., 2] / inertia)
        return torch.cat((x[..., 3:], turn), dim=-1)

    end = draw.states(draw(4.2, 4.8), draw(1.6, 2.4), draw(0.65, 0.95), 0, 0, 0)
    end[0] = numbers(4.5, 2 * pi / 3, pi / 4, 0, 0, 0)
    x0 = draw.states(4.5, 0, pi / 4, 0, 0, 0)
    bounds = [
        ControlBounds([-1, -1, -1, -0.5], [1, 1, 1, 0.5]),
        StateBounds([0, -pi, 0.1, -INF, -INF, -INF], [5, pi, pi - 0.1, INF, INF, INF]),
    ]
    return Drawn(Problem(with_free_time(field, 6, 4, 0.152), least_time(0.152), [*bounds, ends_at(end)], x0, 60), end)


def catenary(draw: Draws) -> Drawn:
    """COPS: a chain of length 4 between two heights at a distance of 1, with the least energy.

    x = [height, length so far], u = slope. The first problem is that of COPS, from 1 to 3.
    """
    high = draw(1.0, 1.6)
    high[0] = 1.0
    h = 0.01
    cost = FunctionCost(lambda x, u: h * (x[..., 0] + 0.5 * h * u[..., 0]) * (1.0 + u[..., 0].square()).sqrt())
    model = FunctionDynamics(lambda x, u: stacked(u[..., 0], (1.0 + u[..., 0].square()).sqrt()), 2, 1, h, "rk4")
    end = draw.states(3, 4)
    parts = [StateBounds([0, -INF], INF), ends_at(end)]
    return Drawn(Problem(model, cost, parts, draw.states(high, 0), 100), end)


def catenary_known(problem: Problem) -> Tensor:
    """The energy of y = c cosh((t - t0) / c) + k through both ends."""
    rise = 3.0 - problem.x0[:, 0]
    chord = (16.0 - rise.square()).sqrt()  # 2 c sinh(1 / (2 c)), which falls with c
    low, high = torch.full_like(rise, 0.05), torch.full_like(rise, 5.0)
    for _ in range(80):
        c = 0.5 * (low + high)
        long = 2 * c * (0.5 / c).sinh() > chord
        low, high = torch.where(long, c, low), torch.where(long, high, c)
    t0 = 0.5 - low * (rise / chord).asinh()
    first, last = -t0 / low, (1 - t0) / low
    k = problem.x0[:, 0] - low * first.cosh()
    return 4 * k + low / 2 * (1 + low / 2 * ((2 * last).sinh() - (2 * first).sinh()))


def first_known(value: float) -> Callable[[Problem], Tensor]:
    """The published optimum of the first problem; the others have none."""

    def known(problem: Problem) -> Tensor:
        return torch.cat((numbers(value), torch.full((problem.B - 1,), torch.nan, dtype=torch.float64)))

    return known


LITERATURE = (
    bryson_denham, brachistochrone, brachistochrone_raw, time_optimal_di, time_optimal_car, particle_steering, goddard,
    hang_glider, robot_arm, catenary,
)  # fmt: skip
KNOWN = {
    bryson_denham: bryson_denham_known,
    brachistochrone: brachistochrone_known,
    brachistochrone_raw: brachistochrone_known,
    time_optimal_di: time_optimal_di_known,
    particle_steering: first_known(0.554577),
    hang_glider: first_known(-12.48),
    robot_arm: first_known(9.14138),
    catenary: catenary_known,
}
