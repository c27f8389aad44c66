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

from torchgco.dynamics.base import WrappedDynamics
from torchgco.dynamics.unicycle import Unicycle
from torchgco.problem.problem import Problem

Array = NDArray[np.float64]
Driver = Callable[[Problem, "Track"], tuple[Array, Array]]

TURNING = 3.0  # rad/s of turn rate per rad of error in the heading
WITHIN = 0.95  # share of the range of the controls that is used
BRAKING = 0.1  # share of the horizon in which the vehicle comes to rest from its speed
AHEAD = 4  # stages after which a point's place is predicted
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
        some = self.points[nearest : nearest + 2 * self.ahead + 1]
        nearest += int(((some - p) ** 2).sum(1).argmin())
        left = self.step * (len(self.points) - 1 - nearest)
        speed = min(self.speed, math.sqrt(2.0 * self.braking * left))
        return nearest, self.points[min(nearest + self.ahead, len(self.points) - 1)], speed


def driver_of(problem: Problem) -> Driver | None:
    """The controller for the model of these problems; None where there is none."""
    model = problem.dynamics
    while isinstance(model, WrappedDynamics):
        model = model.model
    if isinstance(model, Unicycle) and problem.n == model.n:
        return drive_unicycle
    return None if push_of(problem) is None else drive_point


def drive_unicycle(problem: Problem, track: Track) -> tuple[Array, Array]:
    """States (N+1, 4) and controls (N, 2) of a unicycle, for a batch of one: it slows down where it has to turn."""
    dt, stages = float(problem.dynamics.dt), int(problem.stages[0])
    low, high = bounds_of(problem)
    x, y, heading, speed = problem.x0[0].tolist()
    X, U = np.tile(problem.x0[0].numpy(), (problem.N + 1, 1)), np.zeros((problem.N, 2))
    nearest = 0
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
        X[k + 1] = x, y, heading, speed
    X[stages + 1 :] = X[stages]
    return X, U


def push_of(problem: Problem) -> Array | None:
    """How far controls of a few stages push the position of the first problem at its start, (d, m); None: no point.

    A point can be pushed in every direction about equally well.
    """
    one = problem.take(torch.arange(1, device=problem.x0.device))
    x, u = one.x0, one.cost.rest_controls(one.x0.new_zeros(1, one.N, one.m))[:, 0]
    total = x.new_zeros(1, one.n, one.m)
    for k in range(min(AHEAD, one.N)):
        model = one.dynamics.at(k)
        fx, fu = model.jacobians(x, u)
        total, x = fx @ total + fu, model.step(x, u)
    push = total[0, one.position].double().cpu().numpy()
    if not np.isfinite(push).all():
        return None
    strength = np.linalg.svd(push, compute_uv=False)
    return push if len(strength) == len(push) and strength[-1] > EVENLY * strength[0] else None


def drive_point(problem: Problem, track: Track) -> tuple[Array, Array]:
    """States (N+1, n) and controls (N, m) of a point, for a batch of one.

    The controls take the place after a few stages to where the wanted speed would.
    """
    push, stages, at = push_of(problem), int(problem.stages[0]), problem.position
    assert push is not None
    low, high = bounds_of(problem)
    rest = problem.cost.rest_controls(problem.x0.new_zeros(1, problem.N, problem.m))
    inverse, time = np.linalg.pinv(push), AHEAD * float(problem.dynamics.dt)
    X, U = problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1), rest.clone()
    nearest = 0
    for k in range(stages):
        x = X[:, k]
        nearest, aim, wanted = track.target(x[0, at].numpy(), nearest)
        away = aim - x[0, at].numpy()
        far = float(np.linalg.norm(away))
        goal = x[0, at].numpy() + away * min(1.0, wanted * time / max(far, 1e-12))
        change = inverse @ (goal - _after(problem, x, rest, k)[0, at].numpy())
        u = np.clip(rest[0, k].numpy() + change, low[k], high[k])
        U[0, k] = torch.from_numpy(u)
        X[:, k + 1] = problem.dynamics.at(k).step(x, U[:, k])
    X[:, stages + 1 :] = X[:, stages : stages + 1]
    return X[0].numpy(), U[0].numpy()


def _after(problem: Problem, x: Tensor, rest: Tensor, k: int) -> Tensor:
    """The state after a few stages with the controls at rest."""
    for i in range(k, min(k + AHEAD, problem.N)):
        x = problem.dynamics.at(i).step(x, rest[:, i])
    return x


def bounds_of(problem: Problem) -> tuple[Array, Array]:
    """Controls (N, m) that the controller keeps within, for a batch of one; infinite where there are no bounds."""
    bounds = problem.control_bounds
    if bounds is None:
        wide = np.full((problem.N, problem.m), np.inf)
        return -wide, wide
    lower, upper = (part[0].double().cpu().numpy() for part in bounds.over(problem.N))
    slack = np.where(np.isfinite(upper - lower), 0.5 * (1.0 - WITHIN) * (upper - lower), 0.0)
    wide = np.ones((problem.N, 1))
    return (lower + slack) * wide, (upper - slack) * wide
