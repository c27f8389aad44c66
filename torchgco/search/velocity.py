"""How fast a model's position moves in its states: read from the equations, and what speed and its change cost."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchgco.base.autodiff import gradients_at_once
from torchgco.base.draws import uniform
from torchgco.base.shapes import repeated
from torchgco.constraints.base import ADMITTED, Constraint
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.search.reach import WIDE, bounds_at_inner_knots
from torchgco.search.steering import SAME_MODEL, SEED, alike, heading_and_speed

SAMPLES = 16  # states and controls at which the equations are looked at


@dataclass(frozen=True, eq=False)
class Velocity:
    """Which states say how fast the position moves, of a batch of one.

    Args:
        places: in the state, of the velocity along each axis, or of heading and speed; empty: neither.
        by_heading: which of the two.
    """

    problem: Problem
    places: tuple[int, ...]
    by_heading: bool

    @classmethod
    def of(cls, problem: Problem) -> Velocity:
        """Read from the equations at samples of states and controls."""
        model, at = problem.dynamics, problem.position
        none = cls(problem, (), False)
        if model.at(0) is not model or not model.stretches:
            return none
        low, high = (part[0] for part in bounds_at_inner_knots(problem))
        bounded = torch.isfinite(low) & torch.isfinite(high)
        low, high = torch.where(bounded, low, -WIDE), torch.where(bounded, high, WIDE)
        z = low + uniform(SEED, (1, SAMPLES, problem.n + problem.m), low) * (high - low)
        x, u = z[..., : problem.n], z[..., problem.n :]
        rates = model.field(x, u)[0, :, at]
        rows = [torch.cat(_slopes(model, x, u, i), dim=-1)[0] for i in range(at.start, at.stop)]
        slopes = torch.stack(rows, dim=-2)  # (SAMPLES, d, n + m)
        if not bool(torch.isfinite(slopes).all() & torch.isfinite(rates).all()):
            return none
        if rates.shape[1] == 2 and (found := heading_and_speed(x[0], rates, slopes)) is not None:
            return cls(problem, found, True)
        depends = (slopes.abs() > SAME_MODEL).any(0)
        places = tuple(int(row.nonzero()[0]) for row in depends if int(row.sum()) == 1)
        if len(places) < len(depends) or max(places) >= problem.n or not alike(rates, x[0][:, list(places)]):
            return none
        return cls(problem, places, False)

    def states(self, v: Array, p: Tensor | None = None) -> Tensor:
        """States (M, n) that move at velocities v (M, d), m/s, at the start; or at places p (M, d) one after another.

        What moves along its heading keeps that of the place before where it rests.
        """
        x = repeated(self.problem.x0, len(v))[0]
        if p is not None:
            x[:, self.problem.position] = p
        if self.by_heading:
            heading, speed = self.places
            x[:, speed] = x.new_tensor(np.hypot(v[:, 0], v[:, 1]))
            x[:, heading] = x.new_tensor(_headings(v, float(self.problem.x0[0, heading]), p is not None))
        elif self.places:
            x[:, list(self.places)] = x.new_tensor(v)
        return x

    @cached_property
    def start(self) -> Array:
        """The velocity (d,) at the start, m/s."""
        x, at = self.problem.x0, self.problem.position
        if not self.places:
            return np.zeros(at.stop - at.start)
        if not self.by_heading:
            return x[0, list(self.places)].double().cpu().numpy()
        heading, speed = (float(x[0, i]) for i in self.places)
        return speed * np.array([np.cos(heading), np.sin(heading)])

    def admitted(self, v: Array) -> NDArray[np.bool_]:
        """Which velocities v (M, d) the constraints on states admit at some knot, (M,) bool."""
        if not any(map(_limits_speed, self.problem.constraints)):
            return np.ones(len(v), dtype=bool)
        rest = self.problem.take(torch.zeros(len(v) + 1, dtype=torch.int64, device=self.problem.x0.device))
        X = repeated(self.states(np.vstack((v, np.zeros_like(v[:1])))), rest.N + 1)
        U = rest.cost.rest_controls(X.new_zeros(rest.B, rest.N, rest.m))
        good = torch.ones(len(v), dtype=torch.bool, device=X.device)
        for part in rest.constraints:
            if _limits_speed(part):
                worst = part.violation(X, U)
                least = worst.flatten(2).amax(-1).amin(-1) if worst.numel() > 0 else X.new_zeros(rest.B)
                good &= least[:-1] <= least[-1] + ADMITTED
        return good.cpu().numpy()

    def cost_of(self, v: Array, stages: float) -> tuple[Array, Array]:
        """What moving at v (M, d) for so many stages costs more than resting, and moving so at the end, (M,) each."""
        both = self.states(np.vstack((v, np.zeros_like(v[:1])))).unsqueeze(0)
        cost, u = self.problem.cost, self._rest(both.shape[1])
        along, last = cost.stage(both, u, 0)[0], cost.terminal(both)[0]
        moving, ending = ((part[:-1] - part[-1]).double().cpu().numpy() for part in (along, last))
        return stages * moving, ending

    def cost_of_change(self, a: float, stages: float) -> Array:
        """What an acceleration a, m/s^2, along each axis costs over so many stages, (d,).

        NaN where no control accelerates at once.
        """
        at, model = self.problem.position, self.problem.dynamics
        unknown = np.full(at.stop - at.start, np.nan)
        if not self.places:
            return unknown
        x, u = self.problem.x0.unsqueeze(1), self._rest(1)
        states = self.places[1:] if self.by_heading else self.places
        B = torch.stack([_slopes(model, x, u, i)[1][0, 0] for i in states])  # (c, m)
        more = torch.linalg.pinv(B).T * a  # controls of each, (c, m)
        does = (more @ B.T - a * torch.eye(len(states)).to(B)).abs().amax(-1) <= 1e-6 * a
        here = repeated(x[:, 0], len(states))
        cost = self.problem.cost.stage(here, u + more, 0) - self.problem.cost.stage(
            here, u.expand(-1, len(states), -1), 0
        )
        found = torch.where(does, stages * cost[0], torch.nan).double().cpu().numpy()
        return np.broadcast_to(found, unknown.shape).copy()

    def _rest(self, count: int) -> Tensor:
        return self.problem.at_rest[1][:, :1].expand(-1, count, -1)


def _slopes(model, x: Tensor, u: Tensor, i: int) -> tuple[Tensor, Tensor]:
    """The derivatives (1, S, n) and (1, S, m) of the rate of state i."""
    fx, fu = gradients_at_once(lambda x, u: model.field(x, u)[..., i], x, u)
    return fx, fu


def _limits_speed(part: Constraint) -> bool:
    """Whether a constraint's rows are of states, and say more than where to be."""
    return (
        not part.geometric
        and not part.joins_knots
        and not part.is_goal
        and getattr(part, "of", "x") == "x"
        and (part.sense == "inequality")
    )


def _headings(v: Array, first: float, in_turn: bool) -> Array:
    """Directions (M,), rad, of velocities v (M, d), `first` where there is none; of places in turn without jumps, and
    that of the place before."""
    moves, ways = np.hypot(v[:, 0], v[:, 1]) > SAME_MODEL, np.arctan2(v[:, 1], v[:, 0])
    if not in_turn:
        return np.where(moves, ways, first)
    last = np.maximum.accumulate(np.where(moves, np.arange(len(v)), -1))
    return np.unwrap(np.append(first, np.where(last >= 0, ways[last], first)))[1:]
