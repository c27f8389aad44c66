"""Benchmark problems of the ALTRO solver, as torchgco problems: five tasks with terminal equalities and control bounds.

The numbers (models, starts, goals, times, weights, bounds, obstacles, initial guesses) are those of the public sources
Altro.jl (problems/pendulum.jl, cartpole.jl, dubins_car.jl; commit 4864df2) and RobotZoo.jl (src/pendulum.jl,
cartpole.jl, car.jl; commit a3abc6e). Steps are RK4 throughout; the source takes RK3 for the cart-pole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    PathProposals,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    StateBounds,
    presets,
    solve,
)


def at_paces(proposals: PathProposals, paces: tuple[float, ...]) -> PathProposals:
    """The same pass, with paths followed at other paces."""
    return replace(proposals, follow=tuple(replace(follow, arrive=paces) for follow in proposals.follow))


@dataclass(frozen=True)
class Golden:
    """One task: `problem(x0)` for starts (B, n), the published start, and the initial controls (N, m).

    `spread` holds the standard deviations of other starts around the published one, in units of each state. With
    `paces` the default solver tracks its paths at these paces instead of its own, and from rest.
    """

    name: str
    problem: Callable[[Tensor], Problem]
    start: tuple[float, ...]
    spread: tuple[float, ...]
    U0: Tensor
    paces: tuple[float, ...] | None = None

    def solve(self, problem: Problem, U0: Tensor) -> Solution:
        """By the default solver, from U0 (B, N, m)."""
        if self.paces is None:
            return solve(problem, U0)
        solver = presets.gco(problem)
        passes = (at_paces(one, self.paces) if isinstance(one, PathProposals) else one for one in solver.passes)
        return solve(problem, solver=replace(solver, passes=tuple(passes)))

    def batch(self, count: int = 1, seed: int = 0) -> tuple[Problem, Tensor]:
        """The problem from the published start and from count - 1 starts drawn around it; U0 (count, N, m)."""
        x0 = torch.tensor([self.start], dtype=torch.float64).repeat(count, 1)
        draws = torch.randn(count - 1, x0.shape[1], generator=torch.Generator().manual_seed(seed), dtype=x0.dtype)
        x0[1:] += torch.tensor(self.spread, dtype=x0.dtype) * draws
        return self.problem(x0), self.U0.expand(count, *self.U0.shape).clone()


def pendulum_rates(x: Tensor, u: Tensor) -> Tensor:
    """x = [angle (rad, 0 hangs), rate], u = torque (N m); mass 1 kg at 0.5 m, friction 0.1, g = 9.81."""
    inertia, length = 0.25, 0.5
    swing = u[..., 0] / inertia - 9.81 / length * x[..., 0].sin() - 0.1 / inertia * x[..., 1]
    return torch.stack((x[..., 1], swing), dim=-1)


def cartpole_rates(x: Tensor, u: Tensor) -> Tensor:
    """x = [cart (m), angle (rad, 0 hangs), their rates], u = force (N); cart 1 kg, pole 0.2 kg of 0.5 m."""
    cart, pole, length, g = 1.0, 0.2, 0.5, 9.81
    s, c, rate = x[..., 1].sin(), x[..., 1].cos(), x[..., 3]
    # Both rows of the equations of motion, solved for the accelerations.
    push = u[..., 0] + pole * s * (length * rate.square() + g * c)
    slide = push / (cart + pole * s.square())
    swing = -(slide * c + g * s) / length
    return torch.stack((x[..., 2], rate, slide, swing), dim=-1)


def car_rates(x: Tensor, u: Tensor) -> Tensor:
    """x = [px, py (m), heading (rad)], u = [speed (m/s), turn rate (rad/s)]."""
    return torch.stack((u[..., 0] * x[..., 2].cos(), u[..., 0] * x[..., 2].sin(), u[..., 1]), dim=-1)


def at_end(goal: list[float], N: int) -> FunctionConstraint:
    """x_N = goal."""
    return FunctionConstraint(lambda x: x - x.new_tensor(goal), "equality", knots=[N], name="goal")


def pendulum(x0: Tensor) -> Problem:
    N, dt, goal = 50, 3.0 / 50, [np.pi, 0.0]
    model = FunctionDynamics(pendulum_rates, 2, 1, dt, "rk4")
    cost = QuadraticCost(Q=[1e-3 * dt] * 2, R=[1e-3 * dt], Qf=[1.0] * 2, x_ref=goal)
    return Problem(model, cost, [ControlBounds([-3.0], [3.0]), at_end(goal, N)], x0, N)


def cartpole(x0: Tensor) -> Problem:
    N, dt, goal = 100, 5.0 / 100, [0.0, np.pi, 0.0, 0.0]
    model = FunctionDynamics(cartpole_rates, 4, 1, dt, "rk4")
    cost = QuadraticCost(Q=[1e-2 * dt] * 4, R=[1e-1 * dt], Qf=[1e2] * 4, x_ref=goal)
    return Problem(model, cost, [ControlBounds([-3.0], [3.0]), at_end(goal, N)], x0, N)


def _car(dt: float) -> FunctionDynamics:
    return FunctionDynamics(car_rates, 3, 2, dt, "rk4", position=slice(0, 2))


def parallel_park(x0: Tensor) -> Problem:
    """Sideways by 1.5 m inside a corridor 0.5 m wide."""
    N, dt, goal = 100, 3.0 / 100, [0.0, 1.5, 0.0]
    cost = QuadraticCost(Q=[1e-2 * dt] * 3, R=[1e-2 * dt] * 2, Qf=[100.0] * 3, x_ref=goal)
    inside = StateBounds([-0.25, -0.001, -np.inf], [0.25, 1.501, np.inf], knots=slice(1, N))
    return Problem(_car(dt), cost, [ControlBounds([-2.0] * 2, [2.0] * 2), inside, at_end(goal, N)], x0, N)


def three_obstacles(x0: Tensor) -> Problem:
    """Along a diagonal with three discs on it; the speed is never negative."""
    N, dt, goal = 100, 5.0 / 100, [3.0, 3.0, 0.0]
    cost = QuadraticCost(Q=[dt] * 3, R=[0.5 * dt] * 2, Qf=[10.0] * 3, x_ref=goal)
    discs = Spheres([[0.75, 0.75], [1.5, 1.5], [2.25, 2.25]], [0.25] * 3, vehicle_radius=0.175)
    return Problem(_car(dt), cost, [discs, ControlBounds([0.0, -3.0], [3.0, 3.0]), at_end(goal, N)], x0, N)


def escape(x0: Tensor) -> Problem:
    """From one room into the next, through two gaps in walls of 170 discs."""
    N, dt, goal = 100, 3.0 / 100, [7.5, 2.5, 0.0]
    cost = QuadraticCost(Q=[1e-3 * dt] * 3, R=[1e-2 * dt] * 2, Qf=[100.0] * 3, x_ref=goal)
    upright = [[x, y] for x in (0.0, 5.0, 10.0) for y in np.linspace(0, 5, 30)]
    level = [[x, 0.0] for x in np.linspace(0, 10, 50)]
    top = [[x, 5.0] for first in (0, 5) for x in np.linspace(first, first + 3, 15)]
    centers = np.array(upright + level + top)
    walls = Spheres(centers, [0.5] * len(centers), vehicle_radius=0.0)
    return Problem(_car(dt), cost, [walls, ControlBounds([-5.0] * 2, [5.0] * 2), at_end(goal, N)], x0, N)


def _along(points: list[list[float]], N: int, dt: float) -> Tensor:
    """Controls (N, 2) of a car with heading 0 that turns on the spot, then drives from point to point.

    Corners are averaged over a tenth of the horizon, so that the turn rates stay moderate.
    """
    turning, window = N // 10, N // 10
    at = np.linspace(0, len(points) - 1, N - turning + 1)
    line = np.stack([np.interp(at, range(len(points)), column) for column in np.transpose(points)], axis=-1)
    padded = np.pad(line, ((window // 2, window - 1 - window // 2), (0, 0)), mode="edge")
    line = np.stack([np.convolve(column, np.full(window, 1 / window), mode="valid") for column in padded.T], axis=-1)
    steps = np.diff(line, axis=0)
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    first = np.c_[np.zeros(turning), np.full(turning, heading[0] / turning)]
    then = np.c_[np.linalg.norm(steps, axis=1), np.diff(heading, append=heading[-1])]
    return torch.from_numpy(np.concatenate((first, then)) / dt)


WAY_OUT = [[2.5, 2.5], [4.0, 5.0], [5.0, 6.25], [7.5, 6.25], [9.0, 5.0], [7.5, 2.5]]  # m: the source's initial states


def _constant(value: float, N: int, m: int) -> Tensor:
    return torch.full((N, m), value, dtype=torch.float64)


GOLDEN = {
    task.name: task
    for task in (
        Golden("pendulum", pendulum, (0.0, 0.0), (0.05, 0.05), _constant(0.1, 50, 1)),
        Golden("cartpole", cartpole, (0.0, 0.0, 0.0, 0.0), (0.05,) * 4, _constant(0.01, 100, 1)),
        Golden("parallel_park", parallel_park, (0.0, 0.0, 0.0), (0.05, 0.0, 0.05), _constant(0.1, 100, 2)),
        Golden("three_obstacles", three_obstacles, (0.0, 0.0, 0.0), (0.05,) * 3, _constant(0.01, 100, 2)),
        # The way out is so long that at the default paces no car with these bounds keeps up.
        Golden("escape", escape, (2.5, 2.5, 0.0), (0.05,) * 3, _along(WAY_OUT, 100, 3.0 / 100), paces=(0.95, 0.8)),
    )
}
