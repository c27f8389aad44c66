"""Set 1 of the general families: classics of swing-up and driving."""

from __future__ import annotations

from math import pi

import torch
from torch import Tensor

from benchmarks.families.general_problems_base import (
    INF,
    Drawn,
    Draws,
    Field,
    effort,
    ends_at,
    limits,
    numbers,
    stacked,
    toward,
)
from torchgco import ControlBounds, FunctionConstraint, FunctionDynamics, Problem, StateBounds

GRAVITY = 9.81


def pendulum(draw: Draws) -> Drawn:
    """Swing-up of 1 kg at 1 m with a torque too weak to lift it."""
    field = lambda x, u: stacked(x[..., 1], u[..., 0] - GRAVITY * x[..., 0].sin() - 0.1 * x[..., 1])
    end = draw.states(pi, 0)
    cost = toward(end, [0, 0], [0.01], [50, 10])
    x0 = draw([-0.5, -0.5], [0.5, 0.5])
    return Drawn(Problem(FunctionDynamics(field, 2, 1, 0.05, "rk4"), cost, [ControlBounds(-4, 4)], x0, 100), end)


def cartpole_field(x: Tensor, u: Tensor) -> Tensor:
    """x = [cart (m), angle (rad, 0 hangs), their rates], u = force (N); cart 1 kg, pole 0.2 kg at 0.5 m."""
    _, angle, v, w = x.unbind(-1)
    force, pole, length = u[..., 0], 0.2, 0.5
    s, c = angle.sin(), angle.cos()
    mass = 1.0 + pole * s * s
    a = (force + pole * s * (length * w * w + GRAVITY * c)) / mass
    turn = (-force * c - pole * length * w * w * c * s - (1.0 + pole) * GRAVITY * s) / (length * mass)
    return stacked(v, w, a, turn)


def cartpole_of(draw: Draws, N: int) -> Drawn:
    """A swing-up in 4 s."""
    end = draw.states(0, pi, 0, 0)
    cost = toward(end, [0] * 4, [1.0 / N], [50, 100, 5, 10])
    x0 = draw([-0.2, -0.3, -0.1, -0.3], [0.2, 0.3, 0.1, 0.3])
    parts = [ControlBounds(-8, 8), limits(1, INF, INF, INF)]
    model = FunctionDynamics(cartpole_field, 4, 1, 4.0 / N, "rk4")
    return Drawn(Problem(model, cost, parts, x0, N), end)


def cartpole(draw: Draws) -> Drawn:
    return cartpole_of(draw, 100)


def cartpole_eq(draw: Draws) -> Drawn:
    """The same, upright and at rest as an equality, with the least effort."""
    end = draw.states(0, pi, 0, 0)
    parts = [ControlBounds(-8, 8), limits(1, INF, INF, INF), ends_at(end)]
    x0 = draw([-0.2, -0.3, -0.1, -0.3], [0.2, 0.3, 0.1, 0.3])
    return Drawn(Problem(FunctionDynamics(cartpole_field, 4, 1, 0.04, "rk4"), effort(0.04, 0.5), parts, x0, 100), end)


def two_links(x: Tensor, first: Tensor, second: Tensor, gravity: float = GRAVITY, friction: float = 0.0) -> Tensor:
    """Rates of x = [angles (rad, 0 hangs, the second from the first link), their rates] for torques (N m).

    Two rods of 1 kg and 1 m.
    """
    q1, q2, w1, w2 = x.unbind(-1)
    c, s = q2.cos(), q2.sin()
    a, b, d = 5.0 / 3.0 + c, 1.0 / 3.0 + 0.5 * c, 1.0 / 3.0
    low = gravity * 0.5 * (q1 + q2).sin()
    first = first + 0.5 * s * (2.0 * w1 * w2 + w2 * w2) - gravity * 1.5 * q1.sin() - low - friction * w1
    second = second - 0.5 * s * w1 * w1 - low - friction * w2
    size = a * d - b * b
    return stacked(w1, w2, (d * first - b * second) / size, (a * second - b * first) / size)


def acrobot(draw: Draws) -> Drawn:
    """Two links swing up by a torque at the joint between them."""
    field = lambda x, u: two_links(x, torch.zeros_like(u[..., 0]), u[..., 0])
    end = draw.states(pi, 0, 0, 0)
    cost = toward(end, [0] * 4, [0.01], [100, 100, 10, 10])
    x0 = draw([-0.3, -0.3, -0.2, -0.2], [0.3, 0.3, 0.2, 0.2])
    problem = Problem(FunctionDynamics(field, 4, 1, 0.05, "rk4"), cost, [ControlBounds(-15, 15)], x0, 100)
    return Drawn(problem, end)


def double_pendulum(draw: Draws) -> Drawn:
    """Two links swing up by torques at both joints, of which the first is too weak to lift them."""
    field = lambda x, u: two_links(x, u[..., 0], u[..., 1], friction=0.1)
    end = draw.states(pi, 0, 0, 0)
    cost = toward(end, [0] * 4, [0.01, 0.01], [100, 100, 10, 10])
    x0 = draw([-0.3, -0.3, -0.2, -0.2], [0.3, 0.3, 0.2, 0.2])
    parts = [ControlBounds([-8, -5], [8, 5])]
    problem = Problem(FunctionDynamics(field, 4, 2, 0.05, "rk4"), cost, parts, x0, 100)
    return Drawn(problem, end)


def vdp(draw: Draws) -> Drawn:
    """Van der Pol's oscillator brought to rest, with a limit on its rate."""
    field = lambda x, u: stacked((1.0 - x[..., 1] ** 2) * x[..., 0] - x[..., 1] + u[..., 0], x[..., 0])
    end = draw.states(0, 0)
    cost = toward(end, [0.2, 0.2], [0.2], [0.2, 0.2])
    parts = [ControlBounds(-0.75, 1.0), StateBounds([-0.25, -INF], [INF, INF])]
    problem = Problem(FunctionDynamics(field, 2, 1, 0.1, "rk4"), cost, parts, draw([0.0, 0.7], [0.3, 1.05]), 100)
    return Drawn(problem, end)


def chain(draw: Draws) -> Drawn:
    """Four masses on springs between a wall and a hand, which stills them above a floor.

    x = [masses (4, 2), hand (2), velocities of the masses (4, 2)], u = velocity of the hand.
    """
    mass, stiffness, rest = 0.1, 5.0, 0.1

    def field(x: Tensor, u: Tensor) -> Tensor:
        joints = x[..., :10].unflatten(-1, (5, 2))
        joints = torch.cat((torch.zeros_like(joints[..., :1, :]), joints), dim=-2)
        links = joints[..., 1:, :] - joints[..., :-1, :]
        length = (links.square().sum(-1, keepdim=True) + 1e-6).sqrt()
        pull = stiffness * (1.0 - rest / length) * links
        v = x[..., 10:].unflatten(-1, (4, 2))
        a = (pull[..., 1:, :] - pull[..., :-1, :] - 0.05 * v) / mass - numbers(0, GRAVITY)
        return torch.cat((x[..., 10:], u, a.flatten(-2)), dim=-1)

    at = torch.arange(1, 6, dtype=torch.float64)
    sag = mass * GRAVITY / stiffness * at * (5 - at) / 2
    shape = torch.stack((0.3 * at, -0.9 * sag), dim=-1).flatten().expand(draw.B, 10)
    x0 = torch.cat((shape, draw(-0.7, 0.7, 8)), dim=-1)
    end = torch.cat((shape[:, :8], draw([1.1, -0.3], [1.7, 0.3]), torch.zeros(draw.B, 8, dtype=torch.float64)), dim=-1)
    stage = [0.0] * 8 + [1.0, 1.0] + [0.2] * 8
    cost = toward(end, stage, [0.05, 0.05], [20 * weight for weight in stage])
    floor = FunctionConstraint(lambda x: -0.85 - x[..., 1:10:2], name="floor")
    parts = [ControlBounds(-1, 1), floor]
    return Drawn(Problem(FunctionDynamics(field, 18, 2, 0.05, "rk4"), cost, parts, x0, 80), end)


def parallel_park(draw: Draws) -> Drawn:
    """A car at rest stands where it should, but too far to the side."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        speed, angle = u[..., 0], x[..., 2]
        return stacked(speed * angle.cos(), speed * angle.sin(), speed * u[..., 1].tan() / 0.5)

    end = draw.states(0, 0, 0)
    parts = [ControlBounds([-1, -0.6], [1, 0.6]), ends_at(end)]
    x0 = draw.states(draw(-0.3, 0.3), draw(0.5, 1.3), draw(-0.2, 0.2))
    return Drawn(Problem(FunctionDynamics(field, 3, 2, 0.1, "rk4"), effort(0.1, 1.0, 0.3), parts, x0, 60), end)


def bicycle_field(wheelbase: float) -> Field:
    """Rates of x = [p (2, m), heading (rad), speed (m/s), steering (rad)], u = [acceleration, steering rate]."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        _, _, heading, speed, steering = x.unbind(-1)
        turn = speed * steering.tan() / wheelbase
        return stacked(speed * heading.cos(), speed * heading.sin(), turn, u[..., 0], u[..., 1])

    return field


def bicycle_rates(draw: Draws) -> Drawn:
    """A car whose steering takes its time drives from pose to pose."""
    end = draw.states(draw(6, 10), draw(-4, 4), draw(-1.2, 1.2), 0, 0)
    cost = toward(end, [0, 0, 0, 0.01, 0.01], [0.05, 0.1], [50, 50, 50, 20, 5])
    parts = [ControlBounds([-2, -0.6], [2, 0.6]), StateBounds([-INF, -INF, -INF, -1, -0.5], [INF, INF, INF, 2.5, 0.5])]
    model = FunctionDynamics(bicycle_field(1.2), 5, 2, 0.08, "rk4")
    x0 = draw.states(0, 0, draw(-0.5, 0.5), 0, draw(-0.3, 0.3))
    return Drawn(Problem(model, cost, parts, x0, 100), end)


def truck_trailer(draw: Draws) -> Drawn:
    """A truck backs its trailer to a dock, with a limited angle between the two."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        _, _, angle, hitch = x.unbind(-1)
        speed, turn = u[..., 0], u[..., 0] * u[..., 1].tan()
        return stacked(speed * angle.cos(), speed * angle.sin(), turn, -speed * hitch.sin() / 1.5 - turn)

    end = draw.states(0, 0, 0, 0)
    parts = [ControlBounds([-1, -0.7], [1, 0.7]), limits(INF, INF, INF, 1), ends_at(end)]
    x0 = draw.states(draw(3, 5), draw(-1, 1), draw(-0.3, 0.3), draw(-0.2, 0.2))
    return Drawn(Problem(FunctionDynamics(field, 4, 2, 0.1, "rk4"), effort(0.1, 1.0, 0.5), parts, x0, 100), end)


CLASSICS = (
    pendulum, cartpole, cartpole_eq, acrobot, double_pendulum, vdp, chain, parallel_park, bicycle_rates, truck_trailer,
)  # fmt: skip
