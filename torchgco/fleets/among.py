"""Vehicles of one form, each among motions of others that are known, and teams of such vehicles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from torchgco.fleets.fleet import Fleet
from torchgco.fleets.plans import Plans
from torchgco.obstacles.moved import Moved
from torchgco.problem.known import Known
from torchgco.problem.problem import Problem
from torchgco.roadmap.lattice import Array
from torchgco.roadmap.timed import FAR, PARTS, Others, TimedScene, library_for
from torchgco.search.timed_scenes import Velocity, among, can_search, scene_in_time
from torchgco.solution import Solution
from torchgco.solvers.contracts import Call
from torchgco.solvers.interior import InteriorPoint
from torchgco.solvers.session import Session


@dataclass(frozen=True)
class Plain(InteriorPoint, named="solver"):
    """The interior point alone: what it doesn't solve is no result, so nothing else is looked for there."""

    def run(self, call: Call) -> Solution:
        session = Session(call, own_units=True)
        return session.finished(self.solved(session.call), self.admitted(call.problem))


# From near guesses: a large barrier would lose them.
SOLVER = Plain(tolerance=1e-6, initial_barrier=1e-2, max_iterations=100)

# A way on a lattice changes its velocity by a unit in a layer, so a smooth one leaves it by up to an eighth of a cell.
BESIDE = 0.25  # cells by which two smooth ways may be closer than those on their lattices


@dataclass(frozen=True)
class Ground:
    """The lattice of a vehicle.

    Args:
        scene: without others.
        velocity: at the start, (d,), m/s.
        wait: what waiting for a layer costs in the mean on the way without others.
    """

    scene: TimedScene
    velocity: Array
    wait: float

    @classmethod
    def of(cls, problem: Problem, with_others: Problem, free: Tensor) -> Ground | None:
        """That of a batch of one; None where there is no library, or what is in its way has no distances."""
        d = problem.position.stop - problem.position.start
        if not can_search(with_others) or library_for(d) is None:
            return None
        scene = among(scene_in_time(with_others, free), problem)
        wait = _wait(scene, free[:, problem.position], float(problem.dynamics.dt))
        return cls(scene, Velocity.of(problem).start, wait)

    def among(self, others: Tensor, radii: Tensor, price: Tensor, dt: float) -> TimedScene:
        """The lattice among others at (M, N+1, d), dt apart, from which ways should keep `radii` (M,), m."""
        lattice, last = self.scene.lattice, others.shape[1] - 1
        k = torch.arange(lattice.layers * PARTS + 1, dtype=others.dtype) * (lattice.tau / (PARTS * dt))
        before = k.long().clamp(max=last - 1)
        share = (k - before).clamp(max=1.0).view(1, -1, 1)
        center = torch.lerp(others[:, before], others[:, before + 1], share).transpose(0, 1)
        return replace(self.scene, others=Others(center, radii + BESIDE * lattice.spacing, price))


def _wait(scene: TimedScene, p: Tensor, dt: float) -> float:
    """What staying for a layer costs more than staying elsewhere, in the mean of places p (N+1, d), dt apart; 1 where
    it costs nothing."""
    lattice = scene.lattice
    at = np.rint(lattice.tau / dt * np.arange(lattice.layers)).astype(np.int64).clip(0, len(p) - 1)
    cells = torch.tensor([lattice.cell(point) for point in p.numpy()[at]])
    costs = scene.cell_cost.gather(1, cells.unsqueeze(-1))[:, 0] - scene.cell_cost.amin(-1)
    mean = float(torch.where(costs < FAR, costs, 0.0).mean())
    return mean if mean > 0.0 else 1.0


@dataclass(frozen=True)
class Among:
    """The vehicles of a form among others: problems that share what is known of them."""

    problem: Problem
    known: Known
    grounds: dict[int, Ground | None] = field(default_factory=dict)  # of problems at some rows

    def at(
        self,
        rows: Tensor,
        places: Tensor,
        radii: Tensor,
        grown: Tensor | None = None,
        own: Tensor | float = 0.0,
    ) -> Problem:
        """The problems at some rows, among motions (b, N+1, M, d) that they keep radii (b, M) from.

        Args:
            grown: by how much their own obstacles are larger, (b,), m; None: not at all.
            own: which part of the radii is the vehicle's, (b,), m: a lattice is as fine as this.
        """
        one = self.problem.take(rows)
        if grown is not None and bool((grown > 0).any()):
            one = one.grown(grown)
        theirs = radii - (own.unsqueeze(-1) if isinstance(own, Tensor) else own)
        others = Moved(places, theirs, own).bind(one._dimensions(one.x0))
        parts = [part for part in one.constraints if not part.is_goal]
        goals = [part for part in one.constraints if part.is_goal]
        return one._with({"constraints": (*parts, others, *goals)}, known=self.known)

    def ground(self, fleet: Fleet, v: int, b: int, free: Tensor) -> Ground | None:
        """The lattice of vehicle v of fleet b, without the others; None where none can be searched.

        Args:
            free: states (N+1, n) of it, which say how fast it is.
        """
        row = fleet.row_of(v, b)
        if row not in self.grounds:
            at, keep = torch.tensor([row]), fleet.distances[v]
            radii = keep[keep > 0].unsqueeze(0)
            # How large the others are counts, and not where they are: a lattice is as fine as half of what is kept.
            places = free[None, :, None, self.problem.position].repeat(1, 1, radii.shape[1], 1)
            with_others = self.at(at, places, radii, own=0.5 * radii.amin(-1))
            self.grounds[row] = Ground.of(self.problem.take(at), with_others, free)
        return self.grounds[row]

    @property
    def place(self) -> int:
        """Which constraint of these problems are the others."""
        return sum(not part.is_goal for part in self.problem.constraints)


@dataclass(eq=False)
class Teams:
    """C teams, whose vehicles plan side by side with those of others.

    Args:
        fleet: of which these are.
        forms: of its vehicles.
        of: which of the fleets each team is, (C,): several may be the same.
        plans: what its vehicles begin with; their controls needn't lead to their states.
        late: whether the time is over.
    """

    fleet: Fleet
    forms: Sequence[Among]
    of: Tensor
    plans: Plans
    late: Callable[[], bool] = field(default=lambda: False, kw_only=True)

    def __post_init__(self) -> None:
        self.plans = self.plans.take(torch.arange(len(self.of)))

    def ground(self, c: int, v: int) -> Ground | None:
        """The lattice of a vehicle of a team, without others."""
        among = self.forms[self.fleet.form_of[v][0]]
        return among.ground(self.fleet, v, int(self.of[c]), self.plans.X[v][c])
