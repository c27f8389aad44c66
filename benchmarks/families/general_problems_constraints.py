"""Set 3 of the general families, second half: cones, gates, rates, budgets and other constraints that bind."""

from __future__ import annotations

from math import cos

import torch
from torch import Tensor

from benchmarks.families.general_problems_base import (
    INF,
    D,
    Drawn,
    Draws,
    effort,
    ends_at,
    limits,
    numbers,
    rk4,
    stacked,
    toward,
)
from benchmarks.families.general_problems_classics import GRAVITY
from benchmarks.families.general_problems_obstacles import double_integrator, planar_quad_field, quaternion_field
from torchgco import ControlBounds, FunctionConstraint, FunctionCost, FunctionDynamics, Problem, RateBounds, StateBounds


def landing(draw: Draws) -> Drawn:
    """Powered descent with the least fuel: a thrust between two magnitudes, within a cone, above a glide slope.

    x = [p (3, m), v (3, m/s), mass (kg)], u = thrust (3, N), with a gravity of 3.71 m/s^2.
    """

    def field(x: Tensor, u: Tensor) -> Tensor:
        thrust = u.square().sum(-1).sqrt()
        a = u / x[..., 6:] - numbers(0, 0, 3.71)
        return torch.cat((x[..., 3:6], a, -0.01 * thrust.unsqueeze(-1)), dim=-1)

    def thrust_rows(u: Tensor) -> Tensor:
        aside, size = u[..., :2].square().sum(-1), u.square().sum(-1)
        return stacked(16.0 - size, size - 144.0, aside - 0.36 * u[..., 2].square())  # a cone of 31 degrees

    def slope(x: Tensor) -> Tensor:
        return x[..., :2].square().sum(-1, keepdim=True) - 2.25 * (x[..., 2:3] + 0.2).square()

    x0 = draw.states(draw(-5, 5), draw(-5, 5), draw(9, 13), draw(-0.5, 0.5), draw(-0.5, 0.5), draw(-2.0, -1.0), 2.0)
    end = draw.states(0, 0, 0, 0, 0, 0, 1.3)
    parts = [
        ControlBounds([-12, -12, 1], [12, 12, 12]),
        FunctionConstraint(thrust_rows, of="u", name="thrust"),
        FunctionConstraint(slope, name="slope"),
        StateBounds([-INF, -INF, 0, -INF, -INF, -INF, 1], INF),
        ends_at(end, slice(0, 6)),
    ]
    cost = FunctionCost(lambda x, u: 0.12 * u.square().sum(-1).sqrt())
    return Drawn(Problem(FunctionDynamics(field, 7, 3, 0.12, "rk4"), cost, parts, x0, 60), end)


def friction_cone(draw: Draws) -> Drawn:
    """A planar body is moved by forces at two feet, within cones that narrow with its height, and within their reach.

    x = [p (2, m), tilt (rad), their rates], u = two forces (2, N); 1 kg, feet 0.6 m apart.
    """
    feet = (-0.3, 0.3)

    def field(x: Tensor, u: Tensor) -> Tensor:
        turn = sum((foot - x[..., 0]) * u[..., 2 * i + 1] + x[..., 1] * u[..., 2 * i] for i, foot in enumerate(feet))
        push = stacked(u[..., 0] + u[..., 2], u[..., 1] + u[..., 3] - GRAVITY)
        return torch.cat((x[..., 3:], push, 5.0 * torch.as_tensor(turn).unsqueeze(-1)), dim=-1)

    def cones(x: Tensor, u: Tensor) -> Tensor:
        grip = (0.6 * (1.3 - 0.4 * x[..., 1])).unsqueeze(-1)
        along, up = u[..., 0::2], u[..., 1::2]
        return torch.cat((along - grip * up, -along - grip * up), dim=-1)

    def reach(x: Tensor) -> Tensor:
        return stacked(*((x[..., 0] - foot).square() + x[..., 1].square() - 1.21 for foot in feet))

    x0 = draw.states(draw(-0.3, 0.3), draw(0.7, 0.85), draw(-0.2, 0.2), 0, 0, 0)
    end = draw.states(draw(-0.3, 0.3), draw(0.85, 1.0), 0, 0, 0, 0)
    parts = [
        ControlBounds([-20, 0, -20, 0], [20, 20, 20, 20]),
        FunctionConstraint(cones, of="xu", name="cones"),
        FunctionConstraint(reach, name="reach"),
    ]
    cost = toward(end, [1, 1, 0.1, 0.1, 0.1, 0.1], [1e-3] * 4, [100, 100, 100, 10, 10, 10], [0, GRAVITY / 2] * 2)
    return Drawn(Problem(FunctionDynamics(field, 6, 4, 0.03, "rk4"), cost, parts, x0, 50), end)


def gates(draw: Draws) -> Drawn:
    """A point in space through three places at given times."""
    places = draw([1.5, -1.5, -1.5], [3.0, 1.5, 1.5], 3)
    places[..., 0] = places[..., 0].cumsum(-1)
    at_knots = torch.zeros(draw.B, 81, 3, dtype=D)
    at_knots[:, [20, 40, 60]] = places
    gate = FunctionConstraint(
        lambda x, place: x[..., :3] - place, "equality", [20, 40, 60], name="gates", knot_values={"place": at_knots}
    )
    x0, end = draw([-0.5] * 6, [0.5] * 6), torch.cat((places[:, 2] + 1.0, torch.zeros(draw.B, 3, dtype=D)), dim=-1)
    cost = toward(end, [0.0] * 6, [0.1] * 3, [10.0] * 6)
    parts = [ControlBounds(-4, 4), limits(INF, INF, INF, 4, 4, 4), gate]
    return Drawn(Problem(double_integrator(3, 0.1), cost, parts, x0, 80), end)


def gates_quad(draw: Draws) -> Drawn:
    """A quadrotor through two gates, with a limited tilt."""
    places = draw([1.2, -1.0, -0.6], [2.0, 1.0, 0.6], 2)
    places[..., 0] = places[..., 0].cumsum(-1)
    at_knots = torch.zeros(draw.B, 61, 3, dtype=D)
    at_knots[:, [20, 40]] = places
    gate = FunctionConstraint(
        lambda x, place: (x[..., :3] - place).square().sum(-1, keepdim=True) - 0.15**2, knots=[20, 40], name="gates",
        knot_values={"place": at_knots},
    )  # fmt: skip
    tilt = FunctionConstraint(
        lambda x: cos(0.9) - (x[..., 6:7] ** 2 - x[..., 7:8] ** 2 - x[..., 8:9] ** 2 + x[..., 9:] ** 2), name="tilt"
    )
    x0 = draw.states(0, draw(-0.3, 0.3), draw(-0.3, 0.3), 0, 0, 0, 1, 0, 0, 0)
    end = draw.states(places[:, 1, 0] + 1.5, draw(-0.5, 0.5), 0, 0, 0, 0, 1, 0, 0, 0)
    bounds = ControlBounds([0, -4, -4, -4], [20, 4, 4, 4])
    weights = [0.0] * 3 + [0.02] * 3 + [0.01] * 4
    cost = toward(end, weights, [0.005, 0.05, 0.05, 0.05], [50] * 3 + [10] * 7, [GRAVITY, 0, 0, 0])
    model = FunctionDynamics(quaternion_field, 10, 4, 0.06, "rk4", slice(0, 3))
    return Drawn(Problem(model, cost, [bounds, gate, tilt], x0, 60), end)


def arm_rates(x: Tensor, torque: Tensor) -> Tensor:
    """x = [angle (rad), rate], an arm of 1 kg m^2 whose weight pulls with 3 N m where it is level."""
    return stacked(x[..., 1], torque - 3.0 * x[..., 0].sin() - 0.2 * x[..., 1])


def input_rate_state(draw: Draws) -> Drawn:
    """An arm whose torque changes by at most 0.3 N m per stage: the torque is a state, its change the control."""

    def step(x: Tensor, u: Tensor) -> Tensor:
        torque = x[..., 2] + u[..., 0]
        return torch.cat((rk4(lambda at: arm_rates(at, torque), x[..., :2], 0.05), torque.unsqueeze(-1)), dim=-1)

    angle = draw(1.0, 2.3)
    end = draw.states(angle, 0, 3.0 * angle.sin())
    cost = FunctionCost(
        lambda x, u, goal: (
            0.05 * ((x[..., 0] - goal).square() + 0.1 * x[..., 1] ** 2 + 0.02 * (x[..., 2] + u[..., 0]).square())
        ),
        lambda x, goal: 10.0 * (x[..., 0] - goal).square() + x[..., 1].square(),
        values={"goal": angle},
    )
    parts = [ControlBounds(-0.3, 0.3), limits(INF, INF, 4)]
    x0 = torch.cat((draw([-0.5, -0.5], [0.5, 0.5]), torch.zeros(draw.B, 1, dtype=D)), dim=-1)
    return Drawn(Problem(FunctionDynamics(step, 3, 1, 0.05, "none"), cost, parts, x0, 120), end)


def input_rate_rows(draw: Draws) -> Drawn:
    """The same arm and limit with the torque as the control."""
    field = lambda x, u: arm_rates(x, u[..., 0])
    angle = draw(1.0, 2.3)
    end = draw.states(angle, 0)
    cost = toward(end, [0.1, 0.01], [0.002], [20, 2])
    parts = [ControlBounds(-4, 4), RateBounds(-0.3, 0.3)]
    x0 = draw([-0.5, -0.5], [0.5, 0.5])
    return Drawn(Problem(FunctionDynamics(field, 2, 1, 0.05, "rk4"), cost, parts, x0, 120), end)


def lateral_acceleration(draw: Draws) -> Drawn:
    """A car drives fast to a pose: limits on v^2 times curvature, and on power.

    x = [p (2, m), heading (rad), speed (m/s)], u = [acceleration (m/s^2), curvature (1/m)].
    """

    def field(x: Tensor, u: Tensor) -> Tensor:
        v, heading = x[..., 3], x[..., 2]
        return stacked(v * heading.cos(), v * heading.sin(), v * u[..., 1], u[..., 0])

    def rows(x: Tensor, u: Tensor) -> Tensor:
        sideways, power = x[..., 3].square() * u[..., 1], x[..., 3] * u[..., 0]
        return stacked(sideways - 3.0, -sideways - 3.0, power - 6.0, -power - 6.0)

    x0 = draw.states(0, 0, draw(-0.3, 0.3), draw(0.5, 2.0))
    end = draw.states(draw(12, 18), draw(-6, 6), draw(-1.2, 1.2), 1)
    parts = [
        ControlBounds([-4, -0.8], [4, 0.8]),
        StateBounds([-INF, -INF, -INF, 0], [INF, INF, INF, 8]),
        FunctionConstraint(rows, of="xu", name="tyres and power"),
    ]
    cost = toward(end, [0.02, 0.02, 0, 0], [0.01, 0.1], [50, 50, 50, 10])
    return Drawn(Problem(FunctionDynamics(field, 4, 2, 0.06, "rk4"), cost, parts, x0, 80), end)


def tip_of(q: Tensor) -> Tensor:
    """The tip of an arm of two links of 1 m, (..., 2)."""
    first, second = q[..., 0], q[..., 0] + q[..., 1]
    return stacked(first.cos() + second.cos(), first.sin() + second.sin())


def two_link_limits(draw: Draws) -> Drawn:
    """Torques move an arm to a pose at rest, within limits of joints and speeds, its tip around a disc."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        q, w = x[..., :2], x[..., 2:]
        c, s = q[..., 1].cos(), q[..., 1].sin()
        a, b, d, h = 1.5 + 0.6 * c, 0.3 + 0.3 * c, 0.3, 0.3 * s
        first = u[..., 0] + h * (2.0 * w[..., 0] * w[..., 1] + w[..., 1] ** 2)
        second = u[..., 1] - h * w[..., 0] ** 2
        size = a * d - b * b
        return stacked(w[..., 0], w[..., 1], (d * first - b * second) / size, (a * second - b * first) / size)

    x0 = draw.states(draw(-1.1, -0.8), draw(0.6, 1.0), 0, 0)
    end = draw.states(draw(0.8, 1.3), draw(0.4, 0.9), 0, 0)
    center = tip_of(0.5 * (x0 + end)) * draw(0.5, 0.65, 1)  # where the arm folds on its way
    near = torch.minimum((center - tip_of(x0)).norm(dim=-1), (center - tip_of(end)).norm(dim=-1))
    radius = torch.minimum(draw(0.1, 0.2), 0.6 * near)
    disc = FunctionConstraint(
        lambda x, center, radius: (radius.square() - (tip_of(x) - center).square().sum(-1)).unsqueeze(-1),
        name="disc", values={"center": center, "radius": radius},
    )  # fmt: skip
    parts = [ControlBounds(-6, 6), StateBounds([-2, -0.2, -3, -3], [2, 2.2, 3, 3]), disc, ends_at(end)]
    return Drawn(Problem(FunctionDynamics(field, 4, 2, 0.03, "rk4"), effort(0.03, 0.1, 0.1), parts, x0, 60), end)


def tilt_limit(draw: Draws) -> Drawn:
    """A planar quadrotor moves sideways to exact rest, with a limited tilt and speed."""
    hover = [GRAVITY / 2] * 2
    x0, end = draw.states(draw(-3.2, -2.0), draw(-0.5, 0.5), 0, 0, 0, 0), draw.states(*[0] * 6)
    parts = [ControlBounds(0, 8), limits(INF, INF, 0.3, 2, 2, INF), ends_at(end)]
    model = FunctionDynamics(planar_quad_field, 6, 2, 0.04, "rk4")
    return Drawn(Problem(model, effort(0.04, 1.0, 1.0, around=hover), parts, x0, 90), end)


def energy_budget(draw: Draws) -> Drawn:
    """The least miss of the goal with a budget for the integral of u^2, a state bounded at the last knot."""
    budget = draw(1.0, 3.0)
    field = lambda x, u: torch.cat((x[..., 2:4], u, u.square().sum(-1, keepdim=True)), dim=-1)
    x0, end = draw.states(draw(3, 4), draw(3, 4), 0, 0, 0), draw.states(0, 0, 0, 0, budget)
    upper = draw.states(INF, INF, INF, INF, budget)
    bounds = StateBounds(torch.full_like(upper, -INF), upper, knots=[80])
    cost = FunctionCost(lambda x, u: 1e-4 * u.square().sum(-1), lambda x: x[..., :4].square().sum(-1))
    return Drawn(Problem(FunctionDynamics(field, 5, 2, 0.05, "rk4"), cost, [bounds], x0, 80), end)


CONSTRAINTS = (
    landing, friction_cone, gates, gates_quad, input_rate_state, input_rate_rows, lateral_acceleration, two_link_limits,
    tilt_limit, energy_budget,
)  # fmt: skip
