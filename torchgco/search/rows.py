"""The rows of the default's table: each makes several steps, whose settings follow from a few options."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

from torchgco.base.options import Count, Natural, Positive
from torchgco.roadmap.roadmap import Roadmap
from torchgco.search.candidates import Refine
from torchgco.search.finish import Converge
from torchgco.search.following import Follow
from torchgco.search.proposals import PathProposals
from torchgco.search.starts import Direct, Join, ReleaseGoal, RequireGoal, Starts
from torchgco.search.steps import FromProposal, FromSamples, IntoGoal, Solve
from torchgco.search.table import Row

REPAIRED = Refine(top=4, rounds=4, violation=1e-2, cut=0.3, needed=True)  # of candidates that lie deep in an obstacle
INSIDE_DEPTH = 0.5  # how deep these may lie, in R


@dataclass(frozen=True)
class FirstSolve(Row):
    """The solve from the given guess.

    Without obstacles the interior point makes it; where no path can be sought, AL-iLQR to its end; else AL-iLQR until
    it is caught, and the interior point beside it where that is cheap.

    Args:
        single_contact_after: as of `Solve`.

    Raises:
        InputError: a field out of its range.
    """

    single_contact_after: Count | None = 3

    label: ClassVar[str] = "guess"
    problems: ClassVar[str] = "all"

    @cached_property
    def steps(self) -> tuple[Row, ...]:
        solve = Solve(single_contact_after=self.single_contact_after)
        return Converge(among="free"), Solve("end", "pathless"), solve, Direct()

    @property
    def does(self) -> str:
        after = self.single_contact_after
        single = "" if after is None else f", or one after {after} outer iterations"
        return (
            "without obstacles: interior point from the guess or the start held; where no path can be sought: AL-iLQR "
            f"to the end; else until caught (two obstacles at a knot{single}); {Direct().problems}: interior point "
            "too, and what drives along its heading is steered along the paths"
        )


@dataclass(frozen=True)
class Paths(Row):
    """Proposals along paths, where these lack or cost much further ones, and an attempt from the best.

    Args:
        num_paths, follow, relax_iterations, relax_top, max_penetration: as of `PathProposals`.
        roadmap: finds the paths.
        refined: candidates that are refined before they are compared; 1: the best is proposed as relaxed, only those of
            paths that led to no proposal are followed closer and refined, and where the attempt ends far from the goal,
            twice as many.
        max_gap: proposals that cost more than this above the trajectory without obstacles, as a share, are compared
            with those along twice as many paths; None: none are.

    Raises:
        InputError: a field out of its range.
    """

    num_paths: Count = 6
    roadmap: Roadmap = Roadmap()
    follow: Follow = Follow()
    relax_iterations: Natural = 20
    relax_top: Count | None = None
    refined: Count = 1
    max_penetration: Positive = 0.1
    max_gap: Positive | None = None

    label: ClassVar[str] = "paths"
    seeks_paths: ClassVar[bool] = True
    kinds: ClassVar[tuple[str, ...]] = ("maps", "bodies")
    problems: ClassVar[str] = "caught, not arrived"

    @property
    def proposals(self) -> PathProposals:
        """The first step."""
        return PathProposals(
            roadmaps=(self.roadmap,), num_paths=self.num_paths, follow=(self.follow,),
            relax_iterations=self.relax_iterations, relax_top=self.relax_top, refine=Refine(top=self.refined),
            max_penetration=self.max_penetration,
        )  # fmt: skip

    @cached_property
    def steps(self) -> tuple[Row, ...]:
        first, attempt = self.proposals, (FromProposal(), IntoGoal())
        more = () if self.max_gap is None else (self._more(first),)
        if self.refined > 1:
            return first, *more, *attempt
        # Obstacles may bar the way from rest to the path, such as a wall between the two.
        near = closer(self.follow)
        again = replace(
            first, when="unproposed", roadmaps=(), follow=(near, replace(near, obstacles=0.0)), relax_top=None,
            refine=REPAIRED, max_penetration=INSIDE_DEPTH,
        )  # fmt: skip
        return first, *more, again, *attempt, self._thorough(first), FromProposal()

    def _thorough(self, first: PathProposals) -> PathProposals:
        """Along twice as many paths, to the end of the horizon and all refined, where the attempt ends far away."""
        count, follow = 2 * self.num_paths, replace(self.follow, iterations=3 * self.follow.iterations, pace=None)
        return replace(first, when="far", num_paths=count, follow=(follow,), relax_top=None, refine=Refine(top=count))

    def _more(self, first: PathProposals) -> PathProposals:
        """Along twice as many paths, over twice as many points too: other paths, but not always better ones."""
        denser = replace(self.roadmap, num_halton=2 * self.roadmap.num_halton)
        count = 2 * self.num_paths
        return replace(
            first, when="costly", roadmaps=(self.roadmap, denser), num_paths=count,
            follow=(self.follow, closer(self.follow)), relax_top=count, refine=REPAIRED, max_penetration=INSIDE_DEPTH,
            max_gap=self.max_gap,
        )  # fmt: skip

    @property
    def does(self) -> str:
        more = "" if self.max_gap is None else f"; over {self.max_gap:.0%} above free: twice as many paths"
        near, far = "; without any: followed closer", "; still far: twice as many, all refined"
        near, far = (near, far) if self.refined == 1 else ("", "")
        return f"{self.proposals.does}{more}{near}; then AL-iLQR from the best, into the goal{far}"

    def fitting(self, m: int) -> Self:
        """Without initial offsets that have another number of controls than m."""
        follow = self.follow.fitting(m)
        return self if follow is self.follow else replace(self, follow=follow)  # the same has its steps already


@dataclass(frozen=True)
class Samples(Row):
    """Attempts from samples, and one into the goal; then what the interior point found beside the search competes.

    Where there was never a proposal, as among moving obstacles, the solve that was stopped goes into the goal, or on,
    first.

    Args:
        redraws: as of `FromSamples`.

    Raises:
        InputError: a field out of its range.
    """

    redraws: Natural = 2

    label: ClassVar[str] = "samples"
    kinds: ClassVar[tuple[str, ...]] = ("moving", "maps", "bodies")
    problems: ClassVar[str] = "caught, not arrived"

    @cached_property
    def steps(self) -> tuple[Row, ...]:
        return (
            IntoGoal("pathless"), FromSamples("unproposed"), FromSamples(redraws=self.redraws), IntoGoal(), Join(),
        )  # fmt: skip

    @property
    def does(self) -> str:
        return f"{self.steps[2].does}; the best into the goal; what waits competes"


@dataclass(frozen=True)
class Tighten(Row):
    """The last solve, by the interior point: from the best trajectory.

    Problems that are unsolved, or miss a stated goal, are solved from other guesses, too, and with the goal required;
    those with a required goal that doesn't bind, or into which the terminal cost draws, once without it.

    Args:
        starts: so many guesses; 0: none, and no goal is required that isn't.

    Raises:
        InputError: a field out of its range.
    """

    starts: Natural = 8

    label: ClassVar[str] = "tighten"
    last: ClassVar[bool] = True
    problems: ClassVar[str] = "not solved as tightly yet"

    @cached_property
    def steps(self) -> tuple[Row, ...]:
        return Converge(), *((Starts(self.starts), RequireGoal(), ReleaseGoal()) if self.starts > 0 else ())

    @property
    def does(self) -> str:
        more = f"; unsolved or not arrived: from {self.starts} guesses, then with the goal required"
        more = more if self.starts > 0 else ""
        return f"{self.steps[0].does}{more}"


def closer(follow: Follow) -> Follow:
    """Follows the same paths closer, where candidates leave them for a trap.

    A spring gives way to the cost: it gets stiffer, and then takes more iterations to reach the path. So does a tube
    around sharper corners.
    """
    spring = follow.tube is None
    return replace(
        follow, smoothing=follow.smoothing / 4.0, iterations=(3 if spring else 2) * follow.iterations,
        stiffness=(10.0 * follow.stiffness[-1],) if spring else follow.stiffness,
    )  # fmt: skip
