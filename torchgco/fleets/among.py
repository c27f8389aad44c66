"""Vehicles of one form, each among motions of others that are known."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from torchgco.obstacles.moved import Moved
from torchgco.problem.known import Known
from torchgco.problem.problem import Problem
from torchgco.roadmap.timed import TimedScene
from torchgco.search.timed_scenes import among, scene_in_time
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


@dataclass(frozen=True)
class Among:
    """The vehicles of a form among others: problems that share what is known of them."""

    problem: Problem
    known: Known
    scenes: dict[int, TimedScene] = field(default_factory=dict)  # lattices of problems at some rows

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

    def scene(self, row: int, problem: Problem, free: Tensor) -> TimedScene:
        """The lattice of the problem at a row with what is in its way now.

        Args:
            problem: a batch of one.
            free: states (N+1, n) of it alone.
        """
        if row in self.scenes:
            return among(self.scenes[row], problem)
        return self.scenes.setdefault(row, scene_in_time(problem, free))

    @property
    def place(self) -> int:
        """Which constraint of these problems are the others."""
        return sum(not part.is_goal for part in self.problem.constraints)
