"""Trajectories along ways through space and time, to begin solves with."""

from __future__ import annotations

import numpy as np
import scipy
import torch
from torch import Tensor

from torchgco.problem.in_time import states_in_time
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.timed import TimedWays
from torchgco.search.timed_scenes import Velocity

SMALL = 1e-4  # change of a control by which its effect is looked at


def guesses_along(problem: Problem, each: Tensor, found: list[TimedWays]) -> tuple[Tensor, Tensor]:
    """States (C, N+1, n) and controls (C, N, m) along the ways of all problems in turn; `each` says whose way it is."""
    t = float(problem.dynamics.dt) * np.arange(problem.N + 1.0)
    X = _states(problem, found, [t for ways in found for _ in ways.points])
    many = problem.take(each)
    return X, _controls(many, X, many.at_rest[1])


def guesses_in_time(
    problem: Problem, whole: Problem, each: Tensor, found: list[TimedWays]
) -> tuple[Tensor, Tensor, Tensor]:
    """Factors of time (C, 1), and states and controls as of the problem `in_time`, from start to end of each way.

    Args:
        whole: the problem `in_time`; others as of `guesses_along`.
    """
    duration = np.array([ways.tau * (len(points) - 1) for ways in found for points in ways.points])
    X = _states(problem, found, [np.linspace(0.0, last, problem.N + 1) for last in duration])
    many, time = problem.take(each), problem.time
    assert time is not None
    factors = X.new_tensor(duration / (problem.N * float(problem.dynamics.dt))).unsqueeze(-1)
    factors = factors.clamp(time.least[each], time.most[each])
    X, U = states_in_time(many, X, many.at_rest[1], factors)
    return factors, X, _controls(whole.take(each), X, U)


def _states(problem: Problem, found: list[TimedWays], times: list[Array]) -> Tensor:
    """States (C, N+1, n) along the ways of all problems in turn, each at times of its own (N+1,), s."""
    states, t = [problem.x0.new_zeros(0, problem.N + 1, problem.n)], iter(times)
    for b, ways in enumerate(found):
        if len(ways.points) == 0:
            continue
        velocity = Velocity.of(problem.take(torch.tensor([b], device=problem.x0.device)))
        for points in ways.points:
            p, v = _smooth(points, ways.tau, next(t), velocity.start)
            x = velocity.states(v, problem.x0.new_tensor(p))
            x[0] = problem.x0[b]
            states.append(x.unsqueeze(0))
    return torch.cat(states)


def _controls(many: Problem, X: Tensor, U: Tensor) -> Tensor:
    """Controls (C, N, m) that lead from state to state of X (C, N+1, n) as far as those about U can, within bounds."""
    x, model = X[:, :-1], many.along
    then = model.step(x, U)
    fu = torch.stack([model.step(x, U + SMALL * row) - then for row in torch.eye(many.m).to(U)], dim=-1) / SMALL
    U = (U + (torch.linalg.pinv(fu) @ (X[:, 1:] - then).unsqueeze(-1)).squeeze(-1)).nan_to_num(0.0, 0.0, 0.0)
    if many.control_bounds is None:
        return U
    lower, upper = many.control_bounds.over(many.N)
    return torch.minimum(torch.maximum(U, lower), upper)


def _smooth(points: Array, tau: float, t: Array, first: Array) -> tuple[Array, Array]:
    """Places and velocities (K, d) at times (K,) of the cubic spline through points (P, d) at times tau apart; at rest
    after the last one.

    Args:
        first: the velocity (d,) at the beginning.
    """
    ends = (1, first), (2, np.zeros_like(first))
    spline = scipy.interpolate.CubicSpline(tau * np.arange(len(points)), points, bc_type=ends)
    last = tau * (len(points) - 1)
    late = t > last + 1e-9
    v = spline(np.minimum(t, last), 1)
    v[late] = 0.0
    return spline(np.minimum(t, last)), v
