"""Twelve families of ordinary constrained problems, drawn by seed; obstacles hardly occur.

Terminal states as equalities, limits on states, budgets as states, free time as a control, several discs on one car.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, pi

import torch
from torch import Tensor

from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    StateBounds,
)

D, B = torch.float64, 8


def drawn(seed: int, *shape: int) -> Tensor:
    """Uniform draws in [0, 1)."""
    return torch.rand(*shape, dtype=D, generator=torch.Generator().manual_seed(seed))


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=D)


def effort(dt: float, *weights: float) -> FunctionCost:
    """dt sum_i w_i u_i^2 per stage."""
    return FunctionCost(lambda x, u: dt * (numbers(*weights) * u.square()).sum(-1))


def ends_at(goal: Tensor) -> FunctionConstraint:
    """The last state is the goal, (n,) or one row per problem."""
    if goal.dim() == 1:
        return FunctionConstraint(lambda x: x - goal, sense="equality", knots=[-1])
    return FunctionConstraint(lambda x, goal: x - goal, sense="equality", knots=[-1], values={"goal": goal})


def starts(n: int, **columns: Tensor | float) -> Tensor:
    """States (B, n) of zeros, but for the columns x0, x1, ..."""
    x0 = torch.zeros(B, n, dtype=D)
    for name, value in columns.items():
        x0[:, int(name[1:])] = value
    return x0


def free_time(h: float, field: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """RK4 steps of h exp(w) s, where w is the last control."""

    def step(x: Tensor, u: Tensor) -> Tensor:
        dt, rates = h * u[..., -1:].exp(), lambda at: field(at, u)
        k1 = rates(x)
        k2 = rates(x + 0.5 * dt * k1)
        k3 = rates(x + 0.5 * dt * k2)
        return x + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + rates(x + dt * k3))

    return step


def least_time(h: float) -> FunctionCost:
    return FunctionCost(lambda x, u: h * u[..., -1].exp() + 1e-6 * u.square().sum(-1))


def bryson_denham(seed: int) -> Problem:
    """From (0, 1) to (0, -1) in 1 s with x below a limit."""
    upper = torch.stack((0.08 + 0.12 * drawn(seed, B), torch.full((B,), inf, dtype=D)), dim=-1)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), 2, 1, 0.01, "rk4")
    bounds = StateBounds(torch.full_like(upper, -inf), upper)
    return Problem(model, effort(0.01, 0.5), [bounds, ends_at(numbers(0, -1))], starts(2, x1=1.0), 100)


def cart_pole(seed: int) -> Problem:
    """A swing-up that ends upright and at rest, as an equality."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        _, angle, v, w = x.unbind(-1)
        force, cart, pole, length, g = u[..., 0], 1.0, 0.2, 0.5, 9.81
        s, c = angle.sin(), angle.cos()
        mass = cart + pole * s * s
        a = (force + pole * s * (length * w * w + g * c)) / mass
        turn = (-force * c - pole * length * w * w * c * s - (cart + pole) * g * s) / (length * mass)
        return torch.stack((v, w, a, turn), dim=-1)

    x0 = starts(4, x0=0.4 * (drawn(seed, B) - 0.5), x1=0.4 * (drawn(seed + 9, B) - 0.5))
    parts = [ControlBounds(-10, 10), ends_at(numbers(0, pi, 0, 0))]
    return Problem(FunctionDynamics(field, 4, 1, 0.02, "rk4"), effort(0.02, 0.5), parts, x0, 100)


def parking(seed: int) -> Problem:
    """A car at rest that should stand beside its place: stationary for any penalty."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        speed, angle = u[..., 0], x[..., 2]
        return torch.stack((speed * angle.cos(), speed * angle.sin(), speed * u[..., 1].tan() / 0.5), dim=-1)

    parts = [ControlBounds([-1, -0.6], [1, 0.6]), ends_at(numbers(0, 0, 0))]
    x0 = starts(3, x1=0.6 + 0.8 * drawn(seed, B))
    return Problem(FunctionDynamics(field, 3, 2, 0.1, "rk4"), effort(0.1, 1.0, 0.3), parts, x0, 60)


def energy_budget(seed: int) -> Problem:
    """The least miss of the goal with a budget of the integral of u^2, a state bound at the last knot."""
    budget = 2.0 + 3.0 * drawn(seed, B)
    field = lambda x, u: torch.cat((x[..., 2:4], u, u.square().sum(-1, keepdim=True)), dim=-1)
    x0 = starts(5)
    x0[:, :2] = 3.0 + drawn(seed + 1, B, 2)
    free = torch.full((B, 4), inf, dtype=D)
    bounds = StateBounds(-torch.cat((free, free[:, :1]), -1), torch.cat((free, budget[:, None]), -1), knots=[80])
    cost = FunctionCost(lambda x, u: 1e-4 * u.square().sum(-1), lambda x: x[..., :4].square().sum(-1))
    return Problem(FunctionDynamics(field, 5, 2, 0.05, "rk4"), cost, [bounds], x0, 80)


def particle_steering(seed: int) -> Problem:
    """COPS: an acceleration of 100 in a free direction, to a height at speed (45, 0), in the least time."""
    height = 4.0 + 2.0 * drawn(seed, B)
    field = lambda x, u: torch.cat((x[..., 2:], 100.0 * u[..., :1].cos(), 100.0 * u[..., :1].sin()), dim=-1)
    rows = lambda x, h: torch.cat((x[..., 1:2] - h[..., None], x[..., 2:3] - 45.0, x[..., 3:]), dim=-1)
    end = FunctionConstraint(rows, sense="equality", knots=[-1], values={"h": height})
    model = FunctionDynamics(free_time(0.01, field), 4, 2, 0.01, "none")
    return Problem(model, least_time(0.01), [end], starts(4), 50)


def brachistochrone(seed: int) -> Problem:
    """The fastest slide to a point, from rest."""
    goal = torch.stack((1.0 + 1.5 * drawn(seed, B), -0.6 - 1.2 * drawn(seed + 1, B)), dim=-1)

    def field(x: Tensor, u: Tensor) -> Tensor:
        v, slope = x[..., 2:], u[..., :1]
        return torch.cat((v * slope.cos(), v * slope.sin(), -9.81 * slope.sin()), dim=-1)

    end = FunctionConstraint(lambda x, goal: x[..., :2] - goal, sense="equality", knots=[-1], values={"goal": goal})
    model = FunctionDynamics(free_time(0.02, field), 3, 2, 0.02, "none")
    return Problem(model, least_time(0.02), [end], starts(3), 50)


def two_link_arm(seed: int) -> Problem:
    """Torques move an arm to a pose at rest within limits of joints and speeds."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        q, w = x[..., :2], x[..., 2:]
        c, s = q[..., 1].cos(), q[..., 1].sin()
        a, b, d, h = 1.5 + 0.6 * c, 0.3 + 0.3 * c, 0.3, 0.3 * s
        first = u[..., 0] + h * (2.0 * w[..., 0] * w[..., 1] + w[..., 1] ** 2)
        second = u[..., 1] - h * w[..., 0] ** 2
        size = a * d - b * b
        turns = (d * first - b * second) / size, (a * second - b * first) / size
        return torch.stack((w[..., 0], w[..., 1], *turns), dim=-1)

    zero = torch.zeros(B, dtype=D)
    goal = torch.stack((1.0 + 0.5 * drawn(seed, B), 0.5 + 0.5 * drawn(seed + 1, B), zero, zero), dim=-1)
    parts = [ControlBounds(-6, 6), StateBounds([-2, -0.2, -3, -3], [2, 2, 3, 3]), ends_at(goal)]
    model = FunctionDynamics(field, 4, 2, 0.03, "rk4")
    return Problem(model, effort(0.03, 0.1, 0.1), parts, starts(4, x0=-1.0, x1=0.8), 60)


def tilt_limit(seed: int) -> Problem:
    """A planar quadrotor moves sideways to exact rest with a limited tilt and speed."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        lift, tilt = u.sum(-1), x[..., 2]
        rates = -lift * tilt.sin(), lift * tilt.cos() - 9.81, 20.0 * (u[..., 1] - u[..., 0])
        return torch.cat((x[..., 3:], torch.stack(rates, dim=-1)), dim=-1)

    hover = numbers(4.905, 4.905)
    limits = [inf, inf, 0.3, 2, 2, inf]
    parts = [ControlBounds(0, 8), StateBounds([-limit for limit in limits], limits), ends_at(torch.zeros(6, dtype=D))]
    cost = FunctionCost(lambda x, u: 0.04 * (u - hover).square().sum(-1))
    return Problem(FunctionDynamics(field, 6, 2, 0.04, "rk4"), cost, parts, starts(6, x0=-2.0 - drawn(seed, B)), 90)


def truck_and_trailer(seed: int) -> Problem:
    """A truck backs its trailer to a dock, with a limited angle between the two."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        _, _, angle, hitch = x.unbind(-1)
        speed, turn = u[..., 0], u[..., 0] * u[..., 1].tan()
        back = -speed * hitch.sin() / 1.5 - turn
        return torch.stack((speed * angle.cos(), speed * angle.sin(), turn, back), dim=-1)

    x0 = starts(4, x0=3 + 2 * drawn(seed, B), x1=2 * drawn(seed + 1, B) - 1, x2=0.6 * drawn(seed + 2, B) - 0.3)
    limits = [inf, inf, inf, 1]
    bounds = [ControlBounds([-1, -0.7], [1, 0.7]), StateBounds([-limit for limit in limits], limits)]
    model = FunctionDynamics(field, 4, 2, 0.1, "rk4")
    return Problem(model, effort(0.1, 1.0, 0.5), [*bounds, ends_at(torch.zeros(4, dtype=D))], x0, 100)


def goddard_rocket(seed: int) -> Problem:
    """The greatest height after a fixed time; drag falls exponentially with the height."""

    def field(x: Tensor, u: Tensor, drag: Tensor) -> Tensor:
        h, v, mass = x.unbind(-1)
        thrust, against = u[..., 0], 0.5 * drag * v * v.abs() * torch.exp(-500.0 * (h - 1.0))
        return torch.stack((v, (thrust - against) / mass - 1.0 / h**2, -2.0 * thrust), dim=-1)

    model = FunctionDynamics(field, 3, 1, 0.002, "rk4", values={"drag": 600.0 + 40.0 * drawn(seed, B)})
    parts = [ControlBounds(0, 3.5), StateBounds([1, -inf, 0.6], [inf, inf, inf])]
    cost = FunctionCost(lambda x, u: 1e-6 * u.square().sum(-1), lambda x: -x[..., 0])
    return Problem(model, cost, parts, starts(3, x0=1.0, x2=1.0), 100)


def three_gates(seed: int) -> Problem:
    """A point in space through three places at given times."""
    places = 3.0 * drawn(seed, B, 3, 3)
    places[..., 0] += numbers(2, 5, 8)
    at_knots = torch.zeros(B, 81, 3, dtype=D)
    at_knots[:, [20, 40, 60]] = places
    gate = FunctionConstraint(
        lambda x, place: x[..., :3] - place, "equality", [20, 40, 60], knot_values={"place": at_knots}
    )
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 3:], u), dim=-1), 6, 3, 0.1, "rk4")
    return Problem(model, effort(0.1, 1.0, 1.0, 1.0), [ControlBounds(-4, 4), gate], starts(6), 80)


def three_disc_car(seed: int) -> Problem:
    """A car of three discs along its axis among six discs, as a function of its heading too: nothing seeks paths."""
    places = drawn(seed, 6, 2) * numbers(5, 4) + numbers(2, -2)

    def field(x: Tensor, u: Tensor) -> Tensor:
        _, _, angle, speed, steering = x.unbind(-1)
        turn = speed * steering.tan() / 1.2
        return torch.stack((speed * angle.cos(), speed * angle.sin(), turn, u[..., 0], u[..., 1]), dim=-1)

    def rows(x: Tensor) -> Tensor:
        axis = torch.stack((x[..., 2].cos(), x[..., 2].sin()), dim=-1)
        discs = [x[..., :2] + offset * axis for offset in (-0.6, 0.0, 0.6)]
        return torch.cat([0.64 - (p.unsqueeze(-2) - places).square().sum(-1) for p in discs], dim=-1)

    cost = QuadraticCost([0.01, 0.01, 0, 0.01, 0.01], [0.1, 0.1], [10, 10, 1, 1, 1], x_ref=[9, 0, 0, 0, 0])
    bounds = [ControlBounds([-2, -1], [2, 1]), StateBounds([-inf, -inf, -inf, -1, -0.6], [inf, inf, inf, 2, 0.6])]
    model = FunctionDynamics(field, 5, 2, 0.1, "rk4", slice(0, 2))
    return Problem(model, cost, [*bounds, FunctionConstraint(rows)], starts(5, x1=2 * drawn(seed + 1, B) - 1), 80)


FAMILIES: dict[str, Callable[[int], Problem]] = {
    make.__name__: make
    for make in (
        bryson_denham, cart_pole, parking, energy_budget, particle_steering, brachistochrone, two_link_arm, tilt_limit,
        truck_and_trailer, goddard_rocket, three_gates, three_disc_car,
    )
}  # fmt: skip
