"""Ways through space and time that the vehicles of a fleet negotiate: whoever meets others goes where it costs least.

Each in turn takes the cheapest way on its lattice, where meeting another one has a price: being all the way inside
another one costs at first what waiting does in the mean, and more each time that the two still meet. So all vehicles
give way by what it costs them, and no order decides beforehand who waits (compare L. McMurchie and C. Ebeling,
PathFinder: a negotiation-based performance-driven router, 1995). A lattice knows little of what vehicles can do, so in
the end each follows its way as well as it can: what shares the room begins with trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchgco.constraints.base import CONTACT_FACTOR
from torchgco.fleets.among import SOLVER, Teams
from torchgco.fleets.forces import under
from torchgco.fleets.plans import Plans
from torchgco.obstacles.measured import segment_distance
from torchgco.roadmap.timed import TimedScene, TimedWays, timed_ways
from torchgco.search.timed import guesses_along, smooth

DEARER = 4.0  # times, where two still meet: by orders of magnitude, as a long wait may be for what takes an instant
DEAREST = 2.0**16  # times the first price, at most: beside it single numbers still tell a 256th of that one


@dataclass(eq=False)
class Negotiated(Teams):
    """Negotiations of C teams side by side.

    Args:
        orders: of the vehicles of each team, in which those that meet others have turns.
        due: vehicles of each team that have a turn in any case, before all others.
    """

    orders: Sequence[Sequence[int]]
    due: Sequence[Sequence[int]] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        C, V = len(self.of), self.fleet.V
        self.first = [list(vehicles) for vehicles in self.due or [[]] * C]
        self.p = self.fleet.places(self.plans.X)  # (C, V, N+1, d)
        self.dearer = torch.ones(C, V, V, dtype=self.p.dtype)  # times the first price
        self.meets = torch.stack([torch.stack([self._met_by(c, v) for v in range(V)]) for c in range(C)])  # (C, V, V)
        self.ways: list[list[TimedWays | None]] = [[None] * V for _ in self.orders]
        self.next = [0] * C

    def run(self) -> Plans:
        """Trajectories along the ways."""
        while not self.late():
            turns = [(c, v) for c in range(len(self.of)) if (v := self._whose_turn(c)) is not None]
            if not turns:
                break
            scenes = [self._scene(c, v) for c, v in turns]
            for (c, v), ways in zip(turns, timed_ways(scenes, 1, 0.0), strict=True):
                self._go(c, v, ways)
        self._follow()
        return self.plans

    @property
    def cost(self) -> Tensor:
        """Of the plans of each team, (C,); infinite where vehicles still meet."""
        each = zip(self.fleet.members, self.plans.X, self.plans.U, strict=True)
        cost = torch.stack([one.take(self.of).cost.total(x, u) for one, x, u in each]).sum(0)
        return torch.where(self.meets.flatten(1).any(-1), torch.inf, cost.nan_to_num(torch.inf))

    def _whose_turn(self, c: int) -> int | None:
        """The next vehicle of a team that is due, or meets another one whose price can still rise; None: nobody."""
        while self.first[c]:
            if self.ground(c, v := self.first[c].pop(0)) is not None:
                return v
        order, meets = self.orders[c], (self.meets[c] & (self.dearer[c] < DEAREST)).any(-1)
        for i in range(len(order)):
            at = (self.next[c] + i) % len(order)
            if bool(meets[order[at]]) and self.ground(c, order[at]) is not None:
                self.next[c] = at + 1
                return order[at]
        return None

    def _met_by(self, c: int, v: int) -> Tensor:
        """Whom a vehicle touches, (V,) bool."""
        away = self.p[c] - self.p[c, v]
        least = segment_distance(away[:, :-1], away[:, 1:]).amin(-1)
        return least < CONTACT_FACTOR * self.fleet.distances[v]

    def _scene(self, c: int, v: int) -> TimedScene:
        """The lattice of a vehicle among the present ways of the others."""
        ground, keep = self.ground(c, v), self.fleet.distances[v]
        assert ground is not None
        others = keep > 0
        price = ground.wait * self.dearer[c, v][others]
        return ground.among(self.p[c][others], keep[others], price, self.fleet.dt)

    def _go(self, c: int, v: int, ways: TimedWays) -> None:
        """Take a way; whom it meets pays more the next time."""
        ground = self.ground(c, v)
        assert ground is not None
        if ways.points:
            self.ways[c][v] = ways
            times = self.fleet.dt * np.arange(self.fleet.N + 1.0)
            self.p[c, v] = torch.from_numpy(smooth(ways.points[0], ways.tau, times, ground.velocity)[0])
        self.meets[c, v] = self.meets[c, :, v] = meets = self._met_by(c, v)
        self.dearer[c, v, meets] = (DEARER * self.dearer[c, v, meets]).clamp(max=DEAREST)
        self.dearer[c, meets, v] = self.dearer[c, v, meets]

    def _follow(self) -> None:
        """Trajectories that follow the ways as well as the vehicles can.

        Springs lead them there: being away at one knot by what a vehicle keeps costs as much as its way.
        """
        for among, (_, whose) in zip(self.forms, self.fleet.forms, strict=True):
            along = {(c, v): ways for v in whose for c, team in enumerate(self.ways) if (ways := team[v]) is not None}
            if not along:
                continue
            rows = torch.tensor([self.fleet.row_of(v, int(self.of[c])) for c, v in along])
            problem = among.problem.take(rows)
            X, U = guesses_along(problem, torch.arange(len(rows)), list(along.values()))
            p, kept = X[..., problem.position], self.fleet.distances.amax(-1)[[v for _, v in along]]
            springs = problem.cost.total(X, U).abs() / kept.square()
            end = SOLVER.solve(under(problem, torch.zeros_like(p), springs, p), U, X0=X)
            lost = ~torch.isfinite(end.X).flatten(1).all(-1)
            end.X[lost], end.U[lost] = X[lost], U[lost]
            for i, (c, v) in enumerate(along):
                self.plans.set(v, torch.tensor([c]), end, torch.tensor([i]))
                self.plans.iterations[c, v] += end.iterations[i]
