"""The tracker: rotor speeds that make the vehicle turn and climb as the plan says (section 5.2.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

import torch
from torch import Tensor

from torchgco.base.options import AtLeast, Checked, Count, NonNegative, Positive, Seconds
from torchgco.base.tree import Rows, take
from torchgco.constraints import StateBounds
from torchgco.costs import QuadraticCost
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.dynamics.quadrotor import Airframe, RotorTracking
from torchgco.lagrangian.lagrangian import Multipliers, shifted, update_and_raise_penalty
from torchgco.missions.planning_problem import RotorLimits, ThrustSum
from torchgco.problem.problem import Problem
from torchgco.solvers.augmented_lagrangian import PENALTY_MAX
from torchgco.solvers.ilqr import ILQR, RepeatedDescent

RATES, THRUST = slice(10, 13), 13  # in the planning model's state: w and a
FIRST_ROUNDS = 3  # inner solves of the first call


@dataclass(frozen=True)
class Reference:
    """A plan that is tracked: states X (B, N+1, 14) at knots `period` apart, s, and the vehicle that it is for."""

    X: Tensor
    period: float
    airframe: Airframe

    def at(self, offset: float, dt: float, count: int) -> tuple[Tensor, Tensor]:
        """Body rates (B, K, 3), rad/s, and thrust accelerations (B, K), m/s^2, at K = `count` times.

        These are dt apart, s, the first `offset` s after the first knot. Interpolated between the knots; after the last
        knot, its values.
        """
        left, right, share = _between(offset, dt, count, self.period, self.X.shape[1], self.X.dtype)
        asked = self.X[..., RATES.start :]
        values = torch.lerp(asked.index_select(1, left), asked.index_select(1, right), share)
        return values[..., :3], values[..., 3]


@lru_cache(maxsize=64)  # every period asks for the same times
def _between(
    offset: float, dt: float, count: int, period: float, knots: int, dtype: torch.dtype
) -> tuple[Tensor, Tensor, Tensor]:
    """The knots before and after the times of `Reference.at`, (K,) int64, and shares of the way between, (K, 1)."""
    times = offset + dt * torch.arange(count, dtype=dtype)
    knot = (times / period).clamp(max=knots - 1)
    left = knot.floor().long().clamp(max=knots - 2)
    return left, left + 1, (knot - left).unsqueeze(-1)


@dataclass(frozen=True)
class Tracking:
    """The commands of the tracker, and what its next call starts from."""

    solves: RepeatedDescent  # of the tracking problems, which have the numbers of the last call
    commands: Tensor  # (B, 4): rotor speeds, rpm
    violation: Tensor  # (B,): largest violation of the tracking problem, N
    U: Tensor  # (B, N, 4)
    multipliers: Multipliers

    @property
    def problem(self) -> Problem:
        """The tracking problems of the last call."""
        return self.solves.problem

    def take(self, index: Rows) -> Tracking:
        """The same for the vehicles in `index`."""
        tensors = take((self.commands, self.violation, self.U, self.multipliers), index)
        return Tracking(self.solves.take(index), *tensors)


@dataclass(frozen=True)
class Tracker(Checked, named="tracker"):
    """AL-iLQR on the rotor model: rates follow the plan, thrusts sum up to its acceleration, rotors keep their limits.

    Successive tracking problems are alike, so by default the augmented Lagrangian goes on from call to call: one inner
    solve and one update of the multipliers each, from the controls and multipliers of the call before (three at first).
    The paper's tracker (Table 5, `mission=paper`) solves every problem from the beginning.

    Args:
        inner: iLQR; with `inner.as_printed`, inequalities have the printed form, too (`lagrangian.penalty_weights`).
        limits: of the "commands", the speeds that rotors can turn at; or as printed of the "thrusts", which leaves the
            commands free: where a plan turns faster than rotors speed up, the vehicle then loses thrust and sinks.
        effort: weight of the squared distance of rotor speeds from hovering, in units of b^2. By default 1000 rpm weigh
            as much as 0.005 rad/s. With 0.01, of Table 5, a step of the rates is asked for within 20 ms; with 1e5 the
            little that remains of a period's turn at its end is left out, and a vehicle may stay where it is.
        multipliers: "shifted" goes on from the call before, with a constant penalty; "reset" starts every call from
            rotor speeds that hover, multipliers of zero and the first penalty.
        penalty: mu, in units of the cost per N^2; the first one with "reset".
        penalty_growth: eta, the factor of mu per outer iteration, with "reset".
        outer_iterations: inner solves of a call, each with an update of the multipliers, with "reset".
        dt: time between two commands, s; stages: N.

    Raises:
        InputError: a field out of its range.
    """

    inner: ILQR = ILQR(tolerance=1e-4, max_iterations=10)
    limits: Literal["commands", "thrusts"] = "commands"
    effort: NonNegative = 1e3
    multipliers: Literal["shifted", "reset"] = "shifted"
    penalty: Positive = 1e3
    penalty_growth: Annotated[float, AtLeast(1)] = 2.0
    outer_iterations: Count = 10
    dt: Seconds = 0.01
    stages: Count = 6

    def track(self, x: Tensor, reference: Reference, offset: float, before: Tracking | None = None) -> Tracking:
        """Commands for plants x (B, 17), `offset` s after the plan's first knot; `before` is the last result."""
        x_ref, acceleration = self._reference(x, reference, offset)
        if before is None:
            solves = self._solves(x, x_ref, acceleration, reference.airframe)
        else:
            solves = before.solves
            _write(solves, x, x_ref, acceleration)
        problem, reset = solves.problem, self.multipliers == "reset"
        if before is None or reset:
            U = x.new_full((problem.B, self.stages, 4), reference.airframe.hover_speed)
            multipliers, rounds = Multipliers.zero(problem, self.penalty), FIRST_ROUNDS
        else:
            U, multipliers, rounds = shifted(before.U), before.multipliers.shifted(), 1
        growth, rounds = (self.penalty_growth, self.outer_iterations) if reset else (1.0, rounds)
        for _ in range(rounds):
            X, U, violation = solves.solve(U, multipliers)
            multipliers = update_and_raise_penalty(problem, X, U, multipliers, growth, PENALTY_MAX)
        return Tracking(solves, U[:, 0], violation, U, multipliers)

    def _reference(self, x: Tensor, reference: Reference, offset: float) -> tuple[Tensor, Tensor]:
        """The states (B, N+1, 7) and thrust accelerations (B, N) at knots 1..N that are tracked."""
        rates, acceleration = reference.at(offset, self.dt, self.stages + 1)
        thrusts = rates.new_full((*rates.shape[:2], 4), reference.airframe.hover_thrust)
        return torch.cat((rates, thrusts), dim=-1), acceleration[:, 1:].contiguous()

    def _solves(self, x: Tensor, x_ref: Tensor, acceleration: Tensor, frame: Airframe) -> RepeatedDescent:
        """Solves of the tracking problems of Table 5 for plants x (B, 17)."""
        x0, b = x[:, RATES.start :].clone(), frame.thrust_coefficient
        weight = [1.0] * 3 + [b * b] * 4
        cost = QuadraticCost(weight, [self.effort * b * b] * 4, weight, x_ref, [frame.hover_speed] * 4)
        lower, upper = [-math.inf] * 3 + [frame.thrust_min] * 4, [math.inf] * 3 + [frame.thrust_max] * 4
        limits = RotorLimits(frame) if self.limits == "commands" else StateBounds(lower, upper)
        model = RotorTracking(self.dt, airframe=frame)
        problem = Problem(model, cost, [ThrustSum(acceleration, frame.mass), limits], x0, self.stages)
        # Nobody else holds its parts: no call has to look whether they have changed.
        return RepeatedDescent(self.inner, problem.renewed())


def _write(solves: RepeatedDescent, x: Tensor, x_ref: Tensor, acceleration: Tensor) -> None:
    """Write the numbers of another call into the tracking problems."""
    problem = solves.problem
    cost, thrust_sum = problem.cost, problem.constraints[0]
    assert isinstance(cost, BoundQuadratic) and isinstance(thrust_sum, ThrustSum)
    problem.x0.copy_(x[:, RATES.start :])
    cost.x_ref.copy_(x_ref[:, :-1])
    cost.xf_ref.copy_(x_ref[:, -1])
    thrust_sum.toward(acceleration)
    solves.refresh(0)
