"""Simple controllers that drive along a path: their trajectories are guesses for a solver.

Pursuit: at each stage the vehicle steers towards a point of the path some way ahead of the place that it is nearest to.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.autodiff import jacobian
from torchgco.dynamics.base import Dynamics, WrappedDynamics
from torchgco.dynamics.planar import Unicycle
from torchgco.problem.problem import Problem
from torchgco.search.steering import BRAKING as BRAKING
from torchgco.search.steering import TURNING, WITHIN

Array = NDArray[np.float64]
Driver = Callable[[Problem, "Track"], Array]

PREDICTED_STAGES = 4  # stages after which a point's place is predicted
EVENLY = 0.1  # a point's weakest push, as a share of its strongest, at least


@dataclass(frozen=True, eq=False)
class Track:
    """A path to pursue.

    Args:
        points: at equal distances `step`, m, (P, d).
        step: between points, m.
        ahead: points that the vehicle looks ahead.
        speed: m/s.
        braking: m/s^2.
    """

    points: Array
    step: float
    ahead: int
    speed: float
    braking: float

    def target(self, p: Array, nearest: int) -> tuple[int, Array, float]:
        """The point nearest to p (d,), from `nearest` on as far as is looked ahead; the one to steer to; the speed."""
        window = self.points[nearest : nearest + 2 * self.ahead + 1]
        nearest += int(((window - p) ** 2).sum(1).argmin())
        left = self.step * (len(self.points) - 1 - nearest)
        speed = min(self.speed, math.sqrt(2.0 * self.braking * left))
        return nearest, self.points[min(nearest + self.ahead, len(self.points) - 1)], speed


def driver_of(problem: Problem) -> Driver | None:
    """The controller for the model of these problems; None where there is none."""
    if isinstance(own_model(problem.dynamics), Unicycle):
        return drive_unicycle
    return drive_point if is_point(problem) else None


def own_model(model: Dynamics) -> Dynamics:
    """The model as the user gave it."""
    while isinstance(model, WrappedDynamics):
        model = model.model
    return model


def is_point(problem: Problem) -> bool:
    """Whether the controls choose the position's velocity or, where they don't change it at once, its acceleration.

    In every direction about equally well, for the first problem at its start and at rest.
    """
    single = problem.take(torch.arange(1, device=problem.x0.device))
    model = own_model(single.dynamics.at(0))
    x = single.x0[:, : model.n].nan_to_num(0.0, 0.0, 0.0)  # a bad start says nothing about the model
    u = single.cost.rest_controls(single.x0.new_zeros(1, single.N, single.m))[:, 0]
    A, B = jacobian(model.field if model.stretches else model.step, x, u)
    position = single.position
    orders = [_numbers(gain[0, position]) for gain in (B, A @ B)]
    first = next((push for push in orders if push.any()), orders[0])
    if not np.isfinite(first).all() or min(first.shape) < len(first):
        return False
    strength = np.linalg.svd(first, compute_uv=False)
    return bool(strength[-1] > EVENLY * strength[0])


def drive_unicycle(problem: Problem, track: Track) -> Array:
    """Controls (N, 2) of a unicycle, for a batch of one: it slows down where it has to turn."""
    dt, stages = float(problem.dynamics.dt), int(problem.stages[0])
    low, high = bounds_of(problem)
    x, y, heading, speed = problem.x0[0, :4].tolist()
    U, nearest = np.zeros((problem.N, 2)), 0
    for k in range(stages):
        nearest, aim, wanted = track.target(np.array([x, y]), nearest)
        error = math.remainder(math.atan2(aim[1] - y, aim[0] - x) - heading, 2.0 * math.pi)
        wanted *= max(math.cos(error), 0.0)
        push = min(max((wanted - speed) / dt, low[k, 0]), high[k, 0])
        turn = min(max(TURNING * error, low[k, 1]), high[k, 1])
        U[k] = push, turn
        middle, along = heading + 0.5 * dt * turn, dt * (speed + 0.5 * dt * push)
        x, y = x + along * math.cos(middle), y + along * math.sin(middle)
        heading, speed = heading + dt * turn, speed + dt * push
    return U


def push_of(problem: Problem) -> Array:
    """How far controls, held for a few stages, push the position of the first problem at its start, (d, m)."""
    single = problem.take(torch.arange(1, device=problem.x0.device))
    x, u = single.x0, single.cost.rest_controls(single.x0.new_zeros(1, single.N, single.m))[:, 0]
    total = x.new_zeros(1, single.n, single.m)
    for k in range(min(PREDICTED_STAGES, single.N)):
        model = single.dynamics.at(k)
        fx, fu = model.jacobians(x, u)
        total, x = fx @ total + fu, model.step(x, u)
    return _numbers(total[0, single.position])


def drive_point(problem: Problem, track: Track) -> Array:
    """Controls (N, m) of a point, for a batch of one.

    The controls take the place after a few stages to where the wanted speed would.
    """
    push, stages, position = push_of(problem), int(problem.stages[0]), problem.position
    low, high = bounds_of(problem)
    rest = problem.cost.rest_controls(problem.x0.new_zeros(1, problem.N, problem.m))
    inverse, time = np.linalg.pinv(push), PREDICTED_STAGES * float(problem.dynamics.dt)
    x, U, nearest = problem.x0, rest.clone(), 0
    for k in range(stages):
        p = _numbers(x[0, position])
        nearest, aim, wanted = track.target(p, nearest)
        far = float(np.linalg.norm(aim - p))
        goal = p + (aim - p) * min(1.0, wanted * time / max(far, 1e-12))
        change = inverse @ (goal - _numbers(_after(problem, x, rest, k)[0, position]))
        U[0, k] = U.new_tensor(np.clip(_numbers(rest[0, k]) + change, low[k], high[k]))
        x = problem.dynamics.at(k).step(x, U[:, k])
    return _numbers(U[0])


def _after(problem: Problem, x: Tensor, rest: Tensor, k: int) -> Tensor:
    """The state after a few stages with the controls at rest."""
    for i in range(k, min(k + PREDICTED_STAGES, problem.N)):
        x = problem.dynamics.at(i).step(x, rest[:, i])
    return x


def bounds_of(problem: Problem) -> tuple[Array, Array]:
    """Controls (N, m) that the controller keeps within, for a batch of one; infinite where there are no bounds."""
    bounds = problem.control_bounds
    if bounds is None:
        wide = np.full((problem.N, problem.m), np.inf)
        return -wide, wide
    lower, upper = (_numbers(bound[0]) for bound in bounds.over(problem.N))
    slack = np.where(np.isfinite(upper - lower), 0.5 * (1.0 - WITHIN) * (upper - lower), 0.0)
    wide = np.ones((problem.N, 1))
    return (lower + slack) * wide, (upper - slack) * wide


def _numbers(value: Tensor) -> Array:
    return value.double().cpu().numpy()
