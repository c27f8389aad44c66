"""Vehicles that drive along their heading, recognised by their equations, and driven along a way by pure pursuit.

A state is the heading and another the speed; one control changes the speed, another one turns, at a rate as of a
unicycle or by a curvature as of a car. At each stage the vehicle steers towards a point of the way some distance ahead
of the place that it is nearest to, forwards or backwards, and slows down where it has to turn. Its trajectory has no
cusps, which one that is drawn to a moving point has by the dozen. Coulter, Implementation of the pure pursuit path
tracking algorithm (CMU-RI-TR-92-01, 1992).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.base.draws import uniform
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.search.reach import WIDE, bounds_at_inner_knots

SAMPLES = 16  # states and controls at which the equations are looked at
TABLED = 65  # values of a control at which its effect is tabulated
SAME_MODEL = 1e-9  # share by which equations may differ from those of a vehicle that drives along its heading
SEED = 0x57EE
TURNING = 3.0  # rad/s of turn rate per rad of error in the heading
WITHIN = 0.95  # share of the range of the controls that is used
BRAKING = 0.1  # share of the horizon in which the vehicle comes to rest from its speed
CREEP = 0.3  # share of its speed that a vehicle keeps that can't turn on the spot


@dataclass(frozen=True, eq=False)
class Table:
    """What a control u does, at `TABLED` values of it between its bounds."""

    control: int
    u: Array  # (TABLED,)
    effect: Array  # (TABLED,), ascending

    def inverse(self, effect: Array) -> Array:
        """The control that has an effect, within the bounds."""
        return np.interp(effect, self.effect, self.u)


@dataclass(frozen=True)
class Steered:
    """A vehicle that drives along its heading.

    Args:
        heading, speed: places in the state.
        push: accelerations, m/s^2.
        turn: turn rates, rad/s, or curvatures, 1/m.
        by_curvature: which of the two.
        fastest: bounds on the speed, m/s.
    """

    heading: int
    speed: int
    push: Table
    turn: Table
    by_curvature: bool
    fastest: tuple[float, float]


class Sampled(NamedTuple):
    """The equations of a batch of one at samples of states and controls."""

    z: Tensor  # (1, SAMPLES, n + m)
    box: tuple[Tensor, Tensor]  # (n + m,) each: where these lie
    ends: tuple[Tensor, Tensor]  # (n + m,) each: the bounds, infinite without any
    rates: Tensor  # (SAMPLES, n)
    slopes: Tensor  # (SAMPLES, n, n + m)
    places: tuple[int, int]  # in the state, of heading and speed


def sampled(problem: Problem) -> Sampled | None:
    """None for vehicles that don't drive in a plane along their heading, by the same equations at all times."""
    model, at = problem.dynamics, problem.dynamics.position
    if at is None or at.stop - at.start != 2 or model.at(0) is not model or problem.m < 2 or not model.is_integrated:
        return None
    n, ends = problem.n, [part[0] for part in bounds_at_inner_knots(problem)]
    bounded = torch.isfinite(ends[0]) & torch.isfinite(ends[1])
    low, high = (torch.where(bounded, end, wide) for end, wide in zip(ends, (-WIDE, WIDE), strict=True))
    share = uniform(SEED, (1, SAMPLES, n + problem.m), low)
    z = low + share * (high - low)
    x, u = z[..., :n], z[..., n:]
    rates = model.field(x, u)[0]

    def slope(i: int) -> Tensor:
        return torch.cat(gradients_at_once(lambda x, u: model.field(x, u)[..., i], x, u), dim=-1)[0]

    velocity = {i: slope(i) for i in range(at.start, at.stop)}  # which tells most vehicles apart
    places = heading_and_speed(x[0], rates[:, at], torch.stack(list(velocity.values()), dim=-2))
    if places is None:
        return None
    slopes = torch.stack([velocity[i] if i in velocity else slope(i) for i in range(n)], dim=-2)
    if not bool(torch.isfinite(slopes).all() & torch.isfinite(rates).all()):
        return None
    return Sampled(z, (low, high), (ends[0], ends[1]), rates, slopes, places)


def steered(problem: Problem) -> Steered | None:
    """The vehicle of a batch of one, by its equations at samples of states and controls; None of another kind."""
    if problem.part_of is None:
        return _recognised(problem)
    whole, rows = problem.part_of
    known, b = whole.derive("steered", dict), int(rows[0])
    if b not in known:
        known[b] = _recognised(problem)
    return known[b]


def _recognised(problem: Problem) -> Steered | None:
    seen = sampled(problem)
    if seen is None:
        return None
    z, (low, high), ends, rates, slopes, (heading, speed) = seen
    n = problem.n
    x = z[..., :n]
    turn = _by_one_control(slopes[:, heading], n, speed)
    push = _by_one_control(slopes[:, speed], n, None)
    if turn is None or push is None or turn == push:
        return None
    by_curvature = bool((slopes[:, heading, speed].abs() > SAME_MODEL).any())
    tables = _tables(problem, z[:1, :1], low, high, heading, speed, (push, turn))
    if tables is None or (by_curvature and not alike(rates[:, heading], x[0, :, speed] * slopes[:, heading, speed])):
        return None
    return Steered(heading, speed, *tables, by_curvature, (float(ends[0][speed]), float(ends[1][speed])))


def heading_and_speed(x: Tensor, velocity: Tensor, slopes: Tensor) -> tuple[int, int] | None:
    """Places in the states x (S, n) where velocities (S, 2) are speed [cos heading, sin heading]; slopes (S, 2, n + m).

    The velocity turns with the heading and grows with the speed, by as much, and depends on nothing else.
    """
    depends = (slopes.abs() > SAME_MODEL).any(1).any(0).nonzero().flatten().tolist()
    if len(depends) != 2 or max(depends) >= x.shape[1]:
        return None
    for heading, speed in (depends, depends[::-1]):
        toward = torch.stack((x[:, heading].cos(), x[:, heading].sin()), dim=-1)
        if alike(velocity, x[:, speed, None] * toward):
            return heading, speed
    return None


def _by_one_control(slopes: Tensor, n: int, also: int | None) -> int | None:
    """The one control on which a rate with slopes (S, n + m) depends, besides a state; None where it isn't so."""
    depends = (slopes.abs() > SAME_MODEL).any(0).nonzero().flatten().tolist()
    others = [i for i in depends if i != also]
    return others[0] - n if len(others) == 1 and others[0] >= n else None


def _tables(
    problem: Problem, z: Tensor, low: Tensor, high: Tensor, heading: int, speed: int, controls: tuple[int, int]
) -> tuple[Table, Table] | None:
    """Accelerations by one control and turn rates, at a speed of 1 m/s, by another; None where not monotone."""
    n, made = problem.n, []
    for control, rate in zip(controls, (speed, heading), strict=True):
        ends = 0.5 * (1.0 - WITHIN), 0.5 * (1.0 + WITHIN)
        u = low[n + control] + torch.linspace(*ends, TABLED, dtype=z.dtype, device=z.device) * (high - low)[n + control]
        each = z.repeat(1, TABLED, 1)
        each[..., speed], each[0, :, n + control] = 1.0, u
        effect = problem.dynamics.field(each[..., :n], each[..., n:])[0, :, rate]
        order = slice(None) if bool(effect[-1] > effect[0]) else slice(None, None, -1)
        values, inputs = (part.double().cpu().numpy()[order] for part in (effect, u))
        if not (np.diff(values) > 0).all():
            return None
        made.append(Table(control, inputs.copy(), values.copy()))
    return made[0], made[1]


def alike(a: Tensor, b: Tensor) -> bool:
    return bool((a - b).abs().amax() <= SAME_MODEL * (1.0 + b.abs().amax()))


@dataclass(frozen=True, eq=False)
class Tracks:
    """Ways to pursue, C of them.

    Args:
        points: at equal distances, the last repeated, (C, P, 2), m.
        last: of the points of each, (C,).
        step: between points, (C,), m.
        ahead: points that the vehicle looks ahead.
        speed: (C,), m/s.
        limit: the speed from which it still slows down in time for what is ahead at each point, (C, P), m/s.
        backward: whether it drives backwards, (C,).
    """

    points: Array
    last: NDArray[np.int64]
    step: Array
    ahead: int
    speed: Array
    limit: Array
    backward: NDArray[np.bool_]


def driven(problem: Problem, vehicle: Steered, tracks: Tracks) -> Array:
    """Controls (C, N, m) of the vehicle of a batch of one that drives along each way; at rest behind its end."""
    dt, stages, sign = float(problem.dynamics.dt), int(problem.stages[0]), np.where(tracks.backward, -1.0, 1.0)
    at, x0 = problem.position.start, problem.x0[0].double().cpu().numpy()
    held = problem.cost.rest_controls(problem.x0.new_zeros(1, problem.N, problem.m))[0].double().cpu().numpy()
    U = np.repeat(held[None], len(sign), axis=0)
    x, y, heading, speed = (np.full(len(sign), x0[i]) for i in (at, at + 1, vehicle.heading, vehicle.speed))
    braking, nearest = tracks.speed / (BRAKING * dt * stages), np.zeros(len(sign), np.int64)
    euler, each = problem.dynamics.integrator == "euler", np.arange(len(sign))
    window = np.arange(2 * tracks.ahead + 1)
    for k in range(stages):
        some = tracks.points[each[:, None], np.minimum(nearest[:, None] + window, tracks.last[:, None])]
        apart = (some[..., 0] - x[:, None]) ** 2 + (some[..., 1] - y[:, None]) ** 2
        nearest = np.minimum(nearest + apart.argmin(1), tracks.last)
        aim = tracks.points[each, np.minimum(nearest + tracks.ahead, tracks.last)]
        slowing = np.sqrt(2.0 * braking * tracks.step * (tracks.last - nearest))
        error = np.arctan2(sign * (aim[:, 1] - y), sign * (aim[:, 0] - x)) - heading
        error = (error + math.pi) % (2.0 * math.pi) - math.pi
        wanted = sign * np.minimum(np.minimum(tracks.speed, tracks.limit[each, nearest]), slowing)
        wanted = wanted * np.maximum(np.cos(error), CREEP if vehicle.by_curvature else 0.0)
        push, turn, u = _steered(vehicle, np.clip(wanted, *vehicle.fastest), speed, TURNING * error, dt)
        U[:, k, vehicle.push.control], U[:, k, vehicle.turn.control] = u
        half = 0.0 if euler else 0.5 * dt
        toward, along = heading + half * turn, dt * (speed + half * push)
        x, y = x + along * np.cos(toward), y + along * np.sin(toward)
        heading, speed = heading + dt * turn, speed + dt * push
    return U


def speed_limit(vehicle: Steered, points: Array, step: float, ahead: int) -> Array:
    """The speeds (P,), m/s, at points (P, 2) of a way, from which the vehicle slows down in time for each bend.

    In a bend it turns as fast as it can, where its turn rate is what is bounded; braking is as hard as it can be. How a
    way bends is looked at over as many points as the vehicle looks ahead: it cuts tighter bends.
    """
    if vehicle.by_curvature:
        return np.full(len(points), np.inf)
    half, last = max(1, ahead // 2), len(points) - 1
    at = np.arange(len(points))
    toward, before = points[np.minimum(at + half, last)] - points, points - points[np.maximum(at - half, 0)]
    cross, along = toward[:, 0] * before[:, 1] - toward[:, 1] * before[:, 0], (toward * before).sum(1)
    bend = np.abs(np.arctan2(cross, along)) / (half * step)
    turning = min(-vehicle.turn.effect[0], vehicle.turn.effect[-1])
    braking = max(0.0, min(-vehicle.push.effect[0], vehicle.push.effect[-1]))  # none where it can't brake
    # v^2 at a point is at most that at any later one, and twice the braking times the way there.
    energy = (turning / np.maximum(bend, 1e-12)) ** 2 + 2.0 * braking * step * at
    return np.sqrt(np.minimum.accumulate(energy[::-1])[::-1] - 2.0 * braking * step * at)


def _steered(
    vehicle: Steered, wanted: Array, speed: Array, turn: Array, dt: float
) -> tuple[Array, Array, tuple[Array, Array]]:
    """Accelerations and turn rates (C,) towards wanted ones, within the bounds, and the controls that cause them."""
    pushes, turns = vehicle.push.effect, vehicle.turn.effect
    push = np.clip((wanted - speed) / dt, pushes[0], pushes[-1])
    if not vehicle.by_curvature:
        turn = np.clip(turn, turns[0], turns[-1])
        return push, turn, (vehicle.push.inverse(push), vehicle.turn.inverse(turn))
    slow = np.abs(speed) < SAME_MODEL
    curvature = np.clip(turn / np.where(slow, 1.0, speed), turns[0], turns[-1])
    curvature = np.where(slow, np.clip(np.sign(turn * wanted) * turns[-1], turns[0], turns[-1]), curvature)
    mean = speed + 0.5 * dt * push
    return push, curvature * mean, (vehicle.push.inverse(push), vehicle.turn.inverse(curvature))
