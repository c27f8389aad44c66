"""Set 2 of the general families: vehicles among obstacles."""

from __future__ import annotations

from itertools import pairwise
from math import pi

import torch
from torch import Tensor

from benchmarks.families.general_problems_base import (
    INF,
    Drawn,
    Draws,
    balls,
    limits,
    numbers,
    stacked,
    toward,
)
from benchmarks.families.general_problems_classics import GRAVITY, bicycle_field
from torchgco import (
    Boxes,
    Capsules,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    Spheres,
    StateBounds,
)

PLANE, SPACE = slice(0, 2), slice(0, 3)


def double_integrator(d: int, dt: float) -> FunctionDynamics:
    """x = [p (d, m), v (d, m/s)], u = acceleration."""
    return FunctionDynamics(lambda x, u: torch.cat((x[..., d:], u), dim=-1), 2 * d, d, dt, "rk4", slice(0, d))


def car_bounds() -> list[ControlBounds | StateBounds]:
    """Of x = [p, heading, speed, steering], u = [acceleration, steering rate]."""
    return [ControlBounds([-2, -1], [2, 1]), StateBounds([-INF, -INF, -INF, -1, -0.6], [INF, INF, INF, 2, 0.6])]


def bicycle_discs(draw: Draws) -> Drawn:
    """A car whose steering takes its time among eight discs."""
    x0, end = draw.states(0, draw(-1, 1), draw(-0.3, 0.3), 0, 0), draw.states(10, 0, 0, 0, 0)
    discs = Spheres(*balls(draw, 8, ([1.5, -2.5], [8.5, 2.5]), (0.3, 0.7), 0.3, x0[:, :2], end[:, :2]), 0.3)
    model = FunctionDynamics(bicycle_field(0.8), 5, 2, 0.1, "rk4", PLANE)
    cost = toward(end, [0.01, 0.01, 0, 0.01, 0.01], [0.1, 0.1], [10, 10, 1, 1, 1])
    return Drawn(Problem(model, cost, [*car_bounds(), discs], x0, 80), end)


def parking_lot(draw: Draws) -> Drawn:
    """A car reverses into a slot between two others."""
    x0 = draw.states(draw(-5, -3), draw(2.5, 3.5), draw(-0.2, 0.2), 0, 0)
    end = draw.states(0, -1.5, pi / 2, 0, 0)
    side = 2.0 + draw(0.0, 0.2)  # from the middle of the slot to the middles of the cars at its sides
    zero = torch.zeros_like(side)
    places = torch.stack((stacked(-side, zero - 1.5), stacked(side, zero - 1.5)), dim=1)
    back = torch.stack((stacked(zero, zero - 3.5), stacked(zero, zero + 6.0)), dim=1)
    sizes = numbers(0.9, 1.5, 0.9, 1.5, 6.0, 0.4, 6.0, 0.4).view(1, 4, 2).expand(draw.B, 4, 2)
    walls = Boxes(torch.cat((places, back), dim=1), sizes, 0.8)
    model = FunctionDynamics(bicycle_field(1.5), 5, 2, 0.12, "rk4", PLANE)
    cost = toward(end, [0.01, 0.01, 0, 0.01, 0.01], [0.1, 0.1], [50, 50, 20, 5, 1])
    return Drawn(Problem(model, cost, [*car_bounds(), walls], x0, 100), end)


def clutter(draw: Draws, d: int, count: int, sizes: tuple[float, float]) -> Drawn:
    """A double integrator crosses a box full of balls."""
    aside = draw([-1.0] * (d - 1), [1.0] * (d - 1))
    zeros = torch.zeros(draw.B, d, dtype=torch.float64)
    x0 = torch.cat((draw.states(0), aside, zeros), dim=-1)
    end = torch.cat((draw.states(9), draw([-1.0] * (d - 1), [1.0] * (d - 1)), zeros), dim=-1)
    low, high = [1.0, *[-2.5] * (d - 1)], [8.0, *[2.5] * (d - 1)]
    spheres = Spheres(*balls(draw, count, (low, high), sizes, 0.2, x0[:, :d], end[:, :d]), 0.2)
    cost = toward(end, [0.01] * d + [0.02] * d, [0.05] * d, [20] * d + [5] * d)
    parts = [ControlBounds(-2, 2), limits(*[INF] * d, *[2] * d), spheres]
    return Drawn(Problem(double_integrator(d, 0.1), cost, parts, x0, 80), end)


def di2_clutter(draw: Draws) -> Drawn:
    return clutter(draw, 2, 20, (0.2, 0.5))


def di3_clutter(draw: Draws) -> Drawn:
    return clutter(draw, 3, 30, (0.4, 0.9))


def airplane(draw: Draws) -> Drawn:
    """An airplane that can neither stop nor climb steeply among twelve towers.

    x = [p (3, m), heading, climb angle (rad), speed (m/s)], u = [turn rate, climb rate (rad/s), acceleration].
    """

    def field(x: Tensor, u: Tensor) -> Tensor:
        heading, climb, speed = x[..., 3], x[..., 4], x[..., 5]
        level = speed * climb.cos()
        return torch.cat((stacked(level * heading.cos(), level * heading.sin(), speed * climb.sin()), u), dim=-1)

    x0 = draw.states(0, draw(-20, 20), draw(30, 50), draw(-0.3, 0.3), 0, 10)
    end = draw.states(200, draw(-20, 20), draw(30, 50), 0, 0, 10)
    feet, radii = balls(draw, 12, ([30.0, -50.0], [170.0, 50.0]), (6.0, 14.0), 2.0, x0[:, :2], end[:, :2])
    ground, height = torch.zeros_like(radii), draw(50, 100, 12)
    starts = torch.cat((feet, (ground + 0 * radii).unsqueeze(-1)), dim=-1)
    ends = torch.cat((feet, (height + 0 * radii).unsqueeze(-1)), dim=-1)
    bounds = StateBounds([-INF, -INF, 5, -INF, -0.3, 8], [INF, INF, 120, INF, 0.3, 14])
    parts = [ControlBounds([-0.5, -0.3, -2], [0.5, 0.3, 2]), bounds, Capsules(starts, ends, radii, 2.0)]
    cost = toward(end, [0, 0, 0, 0.01, 0.01, 0.01], [1, 1, 0.05], [0.1, 0.1, 0.1, 5, 5, 0.5])
    return Drawn(Problem(FunctionDynamics(field, 6, 3, 0.25, "rk4", SPACE), cost, parts, x0, 80), end)


def planar_quad_field(x: Tensor, u: Tensor) -> Tensor:
    """x = [p (2, m), tilt (rad), their rates], u = thrusts of two rotors (N) of a vehicle of 1 kg."""
    lift, tilt = u.sum(-1), x[..., 2]
    rates = stacked(-lift * tilt.sin(), lift * tilt.cos() - GRAVITY, 10.0 * (u[..., 1] - u[..., 0]))
    return torch.cat((x[..., 3:], rates), dim=-1)


def planar_quad(draw: Draws) -> Drawn:
    """A planar quadrotor among ten discs."""
    x0 = draw.states(0, draw(-0.5, 0.5), 0, 0, 0, 0)
    end = draw.states(5, draw(-0.5, 0.5), 0, 0, 0, 0)
    discs = Spheres(*balls(draw, 10, ([0.8, -1.6], [4.2, 1.6]), (0.15, 0.4), 0.15, x0[:, :2], end[:, :2]), 0.15)
    hover = [GRAVITY / 2] * 2
    cost = toward(end, [0.01, 0.01, 0.01, 0.02, 0.02, 0.02], [0.02, 0.02], [50, 50, 20, 10, 10, 2], hover)
    model = FunctionDynamics(planar_quad_field, 6, 2, 0.05, "rk4", PLANE)
    return Drawn(Problem(model, cost, [ControlBounds(0, 8), discs], x0, 80), end)


def quaternion_field(x: Tensor, u: Tensor) -> Tensor:
    """x = [p (3, m), v (3, m/s), q (4)], u = [thrust (m/s^2), body rates (3, rad/s)]."""
    q0, q1, q2, q3 = x[..., 6:].unbind(-1)
    a, w1, w2, w3 = u.unbind(-1)
    up = q0 * q0 - q1 * q1 - q2 * q2 + q3 * q3
    pull = stacked(2 * a * (q1 * q3 + q0 * q2), 2 * a * (q2 * q3 - q0 * q1), a * up - GRAVITY)
    turn = stacked(
        -q1 * w1 - q2 * w2 - q3 * w3, q0 * w1 + q2 * w3 - q3 * w2, q0 * w2 - q1 * w3 + q3 * w1,
        q0 * w3 + q1 * w2 - q2 * w1,
    )  # fmt: skip
    return torch.cat((x[..., 3:6], pull, 0.5 * turn), dim=-1)


def quad_quaternion(draw: Draws) -> Drawn:
    """A quadrotor among twelve spheres."""
    x0 = draw.states(0, draw(-0.5, 0.5), draw(-0.5, 0.5), 0, 0, 0, 1, 0, 0, 0)
    end = draw.states(6, draw(-0.5, 0.5), draw(-0.5, 0.5), 0, 0, 0, 1, 0, 0, 0)
    placed = balls(draw, 12, ([1.0, -1.5, -1.5], [5.0, 1.5, 1.5]), (0.3, 0.7), 0.2, x0[:, :3], end[:, :3])
    bounds = ControlBounds([0, -3, -3, -3], [20, 3, 3, 3])
    weights = [0.01] * 3 + [0.02] * 3 + [0.01] * 4
    cost = toward(end, weights, [0.005, 0.05, 0.05, 0.05], [50] * 3 + [10] * 7, [GRAVITY, 0, 0, 0])
    model = FunctionDynamics(quaternion_field, 10, 4, 0.06, "rk4", SPACE)
    return Drawn(Problem(model, cost, [bounds, Spheres(*placed, 0.2)], x0, 60), end)


def unicycle_field(x: Tensor, u: Tensor) -> Tensor:
    """x = [p (2, m), heading (rad)], u = [speed (m/s), turn rate (rad/s)]."""
    return stacked(u[..., 0] * x[..., 2].cos(), u[..., 0] * x[..., 2].sin(), u[..., 1])


def doorway(draw: Draws) -> Drawn:
    """A differential drive through a corridor and a doorway that is 3 cm wider on each side, off the axis."""
    x0, end = draw.states(0, draw(-0.5, 0.5), draw(-0.3, 0.3)), draw.states(6, draw(-0.5, 0.5), 0)
    door, wall = draw(-0.8, 0.8), 1.5 + draw.states(0)[:, 0]
    middle = torch.full_like(door, 3.0)
    low, high = door - 0.33, door + 0.33  # of the doorway
    centers = torch.stack(
        (stacked(middle, 0.5 * (low - wall)), stacked(middle, 0.5 * (high + wall)),
         stacked(middle, -wall - 0.25), stacked(middle, wall + 0.25)), dim=1,
    )  # fmt: skip
    thick, long = torch.full_like(door, 0.15), torch.full_like(door, 5.0)
    sizes = torch.stack(
        (stacked(thick, 0.5 * (low + wall)), stacked(thick, 0.5 * (wall - high)), stacked(long, wall * 0 + 0.25),
         stacked(long, wall * 0 + 0.25)), dim=1,
    )  # fmt: skip
    bounds = ControlBounds([-1, -1.5], [1, 1.5])
    cost = toward(end, [0.01, 0.01, 0], [0.05, 0.05], [50, 50, 10])
    model = FunctionDynamics(unicycle_field, 3, 2, 0.1, "rk4", PLANE)
    return Drawn(Problem(model, cost, [bounds, Boxes(centers, sizes, 0.3)], x0, 100), end)


def walled(draw: Draws, walls: Tensor, x0: Tensor, end: Tensor, N: int, speed: float) -> Drawn:
    """A double integrator among walls (M, 4) given by middle and half sides."""
    shared = walls.expand(draw.B, *walls.shape)
    boxes = Boxes(shared[..., :2], shared[..., 2:], 0.15)
    parts = [ControlBounds(-2, 2), limits(INF, INF, speed, speed), boxes]
    cost = toward(end, [0.01, 0.01, 0.02, 0.02], [0.05, 0.05], [20, 20, 5, 5])
    return Drawn(Problem(double_integrator(2, 0.1), cost, parts, x0, N), end)


def u_trap(draw: Draws) -> Drawn:
    """A start inside a U of three walls that opens away from the goal."""
    walls = torch.stack((numbers(1, 0, 0.1, 1.1), numbers(0, 1, 1.1, 0.1), numbers(0, -1, 1.1, 0.1)))
    x0, end = draw.states(draw(-0.5, 0.5), draw(-0.5, 0.5), 0, 0), draw.states(draw(3, 5), draw(-1.0, 1.0), 0, 0)
    return walled(draw, walls, x0, end, 80, 2.0)


def spiral_of(draw: Draws, N: int) -> Drawn:
    """Out of a square spiral of seven walls, one metre apart."""
    corners = [(1, -1), (1, 1), (-1, 1), (-1, -2), (2, -2), (2, 2), (-2, 2), (-2, -3)]
    walls = [
        numbers(0.5 * (a + c), 0.5 * (b + d), 0.5 * abs(c - a) + 0.1, 0.5 * abs(d - b) + 0.1)
        for (a, b), (c, d) in pairwise(corners)
    ]
    x0, end = draw.states(draw(-0.4, 0.4), draw(-0.3, 0.3), 0, 0), draw.states(draw(4, 5), draw(-1.0, 1.0), 0, 0)
    return walled(draw, torch.stack(walls), x0, end, N, 1.5)


def spiral(draw: Draws) -> Drawn:
    return spiral_of(draw, 240)


def spiral_short(draw: Draws) -> Drawn:
    """The same with too little time to arrive: staying inside is feasible."""
    return spiral_of(draw, 120)


def footprint(draw: Draws) -> Drawn:
    """A car of three discs along its axis among six discs, as a function of its heading, too."""
    x0, end = draw.states(0, draw(-1, 1), draw(-0.2, 0.2), 0, 0), draw.states(10, 0, 0, 0, 0)
    places = draw.shared([2.5, -2.2], [7.5, 2.2], 6)
    radii = draw.shared(0.2, 0.5, 6)

    def rows(x: Tensor) -> Tensor:
        axis = stacked(x[..., 2].cos(), x[..., 2].sin())
        discs = [x[..., :2] + offset * axis for offset in (-0.5, 0.0, 0.5)]
        return torch.cat([(radii + 0.35).square() - (p.unsqueeze(-2) - places).square().sum(-1) for p in discs], dim=-1)

    model = FunctionDynamics(bicycle_field(1.0), 5, 2, 0.1, "rk4", PLANE)
    cost = toward(end, [0.01, 0.01, 0, 0.01, 0.01], [0.1, 0.1], [10, 10, 1, 1, 1])
    return Drawn(Problem(model, cost, [*car_bounds(), FunctionConstraint(rows, name="discs")], x0, 80), end)


def arm_points(q: Tensor) -> list[Tensor]:
    """Places (..., 3) of elbow, wrist and tip, and halfway between, of seven joints that turn about z and y in turn."""
    zero, one = torch.zeros_like(q[..., 0]), torch.ones_like(q[..., 0])
    x, y, z = stacked(one, zero, zero), stacked(zero, one, zero), stacked(zero, zero, one)
    at, points = zero.unsqueeze(-1) * z, []
    for joint in range(7):
        c, s = q[..., joint : joint + 1].cos(), q[..., joint : joint + 1].sin()
        if joint % 2 == 0:
            x, y = c * x + s * y, c * y - s * x
        else:
            z, x = c * z + s * x, c * x - s * z
            length = (0.4, 0.4, 0.2)[joint // 2]
            points += [at + 0.5 * length * z, at + length * z]
            at = points[-1]
    return points


def arm7(draw: Draws) -> Drawn:
    """An arm of seven joints brings its tip to a place, with its links clear of three spheres.

    u = speeds of the joints (rad/s).
    """
    x0 = draw([-0.3, 0.3, -0.3, 0.6, -0.3, 0.3, -0.3], [0.3, 0.6, 0.3, 1.0, 0.3, 0.6, 0.3])
    end = x0 + draw([1.0, -0.3, -0.5, -0.4, -0.5, -0.3, 0.0], [1.8, 0.5, 0.5, 0.4, 0.5, 0.3, 0.0])
    halfway = torch.stack([arm_points(0.5 * (x0 + end))[i] for i in (2, 3, 5)], dim=1)
    centers = halfway + draw([-0.1] * 3, [0.1] * 3, 3)
    around = torch.stack([*arm_points(x0), *arm_points(end)], dim=1)
    free = (centers.unsqueeze(2) - around.unsqueeze(1)).norm(dim=-1).amin(-1)
    radii = torch.minimum(draw(0.1, 0.2, 3), 0.7 * free)

    def rows(x: Tensor, centers: Tensor, radii: Tensor) -> Tensor:
        clear = [radii.square() - (p.unsqueeze(-2) - centers).square().sum(-1) for p in arm_points(x)]
        return torch.cat(clear, dim=-1)

    cost = FunctionCost(
        lambda x, u: 0.01 * u.square().sum(-1),
        lambda x, tip: 100.0 * (arm_points(x)[-1] - tip).square().sum(-1),
        values={"tip": arm_points(end)[-1]},
    )
    spheres = FunctionConstraint(rows, name="spheres", values={"centers": centers, "radii": radii})
    parts = [ControlBounds(-1.5, 1.5), limits(2.8, 2.0, 2.8, 2.2, 2.8, 2.2, 2.8), spheres]
    model = FunctionDynamics(lambda x, u: u + 0.0 * x, 7, 7, 0.04, "rk4")
    return Drawn(Problem(model, cost, parts, x0, 50), end)


OBSTACLES = (
    bicycle_discs, parking_lot, di2_clutter, di3_clutter, airplane, planar_quad, quad_quaternion, doorway, u_trap,
    spiral, spiral_short, footprint, arm7,
)  # fmt: skip
