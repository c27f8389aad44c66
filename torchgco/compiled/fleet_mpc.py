"""FleetMPC: vehicles that plan anew in every period, each among the last plans of the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchgco.api import solve
from torchgco.base.errors import InputError, shown
from torchgco.base.options import PositiveOrInfinite, check_value
from torchgco.base.shapes import check_shape
from torchgco.compiled.mpc import MPC
from torchgco.constraints.base import CONTACT_FACTOR
from torchgco.fleets.among import Among
from torchgco.fleets.fleet import Fleet
from torchgco.fleets.solution import FleetSolution
from torchgco.fleets.verdict import leaves_chords
from torchgco.obstacles.measured import segment_distance
from torchgco.problem.known import Known
from torchgco.receding.plan import Plan

TINY = 1e-3  # m, the radius of what is far away
FAR = 1e3  # m from each other, in this many diameters of the fleet, are vehicles that keep no distance


class FleetMPC:
    """Model predictive control of a fleet: in every period each vehicle plans among the last plans of the others.

        mpc = torchgco.FleetMPC(fleet, period=0.1)
        u = mpc.step(x)  # states (B, n) of each vehicle, a list, as controls (B, m) are

    No vehicle knows what others plan now. A new plan is flown only if it is apart, between the knots too, from the
    plans in force, and only then is it in force itself; else the vehicle goes on by its own. So what all fly is a set
    of plans that has been checked, as long as measured states are those of the plans. Obstacles that move go on by
    themselves.

    Args:
        fleet: with starts where the vehicles are at first.
        solver, period: as of `MPC`.
        max_seconds: of the first plans, which `torchgco.solve` makes; None: no limit.

    Attributes:
        first: the solution that is flown at first.
        plans: those in force, one for each vehicle.
        adopted: which vehicles fly a plan of the last step, (B, V) bool.

    Raises:
        InputError: as `MPC`; a cost with rows per knot; first plans that aren't apart or not feasible.
    """

    adopted: Tensor

    def __init__(
        self, fleet: Fleet, solver: str | None = None, period: float | None = None, *, max_seconds: float | None = None
    ) -> None:
        if not isinstance(fleet, Fleet):
            raise InputError("fleet", "a Fleet", type(fleet).__name__)
        for v, one in enumerate(fleet.members):
            if names := sorted(one.cost.names_by_stage()):
                expected = "one for all knots: a step takes no new ones, and begins at knot 0 again"
                raise InputError(f"fleet.vehicles[{v}].cost.{names[0]}", expected, "a row per knot")
        limit = check_value(max_seconds, PositiveOrInfinite | None, "max_seconds")
        self.fleet, self.t = fleet, 0.0
        self.first: FleetSolution = solve(fleet, max_seconds=None if limit == torch.inf else limit)
        if not bool(self.first.verdict.feasible.all()):
            raise InputError("fleet", "vehicles for which plans are found that keep them apart", repr(self.first))
        self.plans = [self._plan(v) for v in range(fleet.V)]
        self.adopted = torch.ones(fleet.B, fleet.V, dtype=torch.bool)
        self._loops, p = list[tuple[MPC, str, tuple[int, ...]]](), self._places()
        off = torch.stack([leaves_chords(m, one.X, one.U) for m, one in zip(fleet.members, self.first, strict=True)], 1)
        for problem, whose in fleet.forms:
            among = Among(problem, Known())
            radii = torch.cat([self._others(off + off[:, [v]] + fleet.distances[v].clamp(min=TINY), v) for v in whose])
            others = torch.cat([self._seen(p, v) for v in whose])
            one, name = among.at(torch.arange(problem.B), others, radii), f"constraints[{among.place}].places"
            self._loops.append((MPC(one, solver, period, changes=[name]), name, whose))
        self.period = self._loops[0][0].period

    def step(self, x: Sequence[Any]) -> list[Tensor]:
        """The controls (B, m) of each vehicle for the next period, from states (B, n) of each, measured now.

        Raises:
            InputError: states of other vehicles.
        """
        if not isinstance(x, Sequence) or len(x) != self.fleet.V:
            raise InputError("x", f"states (B, n) of each of {self.fleet.V} vehicles", shown(x))
        states = [torch.as_tensor(part, dtype=torch.float64) for part in x]
        for v, (one, state) in enumerate(zip(self.fleet.members, states, strict=True)):
            check_shape(state, (self.fleet.B, one.n), f"x[{v}]")
        p, B = self._places(), self.fleet.B
        self.adopted = torch.zeros_like(self.adopted)
        for loop, name, whose in self._loops:
            loop.step(
                torch.cat([states[v] for v in whose]), numbers={name: torch.cat([self._seen(p, v) for v in whose])}
            )
            assert loop.plan is not None
            new = loop.plan.moved_to(self.t)
            for place, v in enumerate(whose):
                rows = slice(place * B, (place + 1) * B)
                self._adopt(v, new.take(rows), loop.feasible[rows], p)
        u = [plan.at(self.t, state).u for plan, state in zip(self.plans, states, strict=True)]
        self.t += self.period
        return u

    def _adopt(self, v: int, new: Plan, good: Tensor, p: Tensor) -> None:
        """Put a vehicle's new plans into force where they are apart from all others in force, at places p, in place."""
        one = self.fleet.members[v]
        q, keep = new.X[..., one.position], self.fleet.distances[v]
        away = q.unsqueeze(1) - p
        least = segment_distance(away[:, :, :-1], away[:, :, 1:]).amin(-1)
        off = 2.0 * leaves_chords(one, new.X, new.U).unsqueeze(-1)  # as if the others left their chords by as much
        rows = (good & ((keep == 0) | (least >= CONTACT_FACTOR * keep + off)).all(-1)).nonzero().flatten()
        self.plans[v] = self.plans[v].with_rows(rows, replace(new, knots=None).take(rows))
        p[rows, v], self.adopted[rows, v] = q[rows], True

    def _plan(self, v: int) -> Plan:
        one, found = self.fleet.members[v], self.first[v]
        start = torch.zeros(self.fleet.B, dtype=torch.float64)
        return Plan(
            X=found.X, U=found.U, K=found.K, start=start, dt=self.fleet.dt, dynamics=one.dynamics,
            bounds=one.control_bounds,
        )  # fmt: skip

    def _places(self) -> Tensor:
        """Where the plans in force lead from now on, (B, V, N+1, d)."""
        return self.fleet.places([plan.moved_to(self.t).X for plan in self.plans])

    def _seen(self, p: Tensor, v: int) -> Tensor:
        """What vehicle v sees of the others, (B, N+1, V-1, d): those that it keeps no distance from far away."""
        far = FAR * (1.0 + p.abs().amax())
        there = self.fleet.distances[v].view(1, -1, 1, 1) > 0
        return self._others(torch.where(there, p, far), v).transpose(1, 2)

    def _others(self, values: Tensor, v: int) -> Tensor:
        """Of values (B, V, ...) of the vehicles those of all but v, (B, V-1, ...)."""
        return values[:, [w for w in range(self.fleet.V) if w != v]].contiguous()
