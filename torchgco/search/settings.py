"""The settings of path proposals, and other settings for problems where the first proposal fails or is costly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Self

from torchgco.base.errors import InputError
from torchgco.base.options import AtLeast, Below, Count, Natural, Positive, check_options
from torchgco.roadmap.roadmap import Roadmap

# Of closer paths. Corners are averaged over a share of the horizon that is smaller by a factor. A spring gives way to
# the cost: it gets stiffer, and then takes more iterations to reach the path. So does a tube around sharper corners.
SHARPER, STIFFER, LONGER_BY_SPRING, LONGER_IN_TUBE = 4.0, 10.0, 3, 2
MORE = 2  # times as many paths, and times as many points
# Candidates that are refined roughly, and how deep they may penetrate an obstacle before, as a share of the mean
# inflated radius.
COMPARED, DEEP = 4, 0.5
THOROUGH = 3  # times as many iterations of tracking


@dataclass(frozen=True)
class PathSettings:
    """How paths are found, followed and compared.

    Args:
        roadmap: finds the paths.
        num_paths: paths per problem, before those of one homotopy class are merged.
        initial_offsets: offsets (m,) of the controls over the first tenth of the horizon, as shares of the range from
            rest to the control bounds; every path is tracked from rest and once from each offset. An initial turn lets
            a vehicle that turns slowly find reversing and three-point turns. `Restarts` leaves them out where they
            don't fit the number of controls.
        depart, arrive: shares of the horizon at which the vehicle leaves the start and reaches the goal. Several
            values of `arrive`: every path is tracked at each pace.
        pace: times the time that the vehicle takes without constraints, per length of the way: no path is followed more
            slowly than this, whatever `arrive` says. None: no such limit.
        smoothing: share of the horizon over which the corners of a path are averaged, at most (`tracking.followed`).
        tube: radius of the tube that a candidate is kept in, as a share of the mean inflated radius; None: a spring to
            the path instead. A spring takes half the iterations; a vehicle that can't move sideways ends closer to the
            path in a tube.
        stiffness: of tube or spring, one tracking solve per value, in units of the cost of resting at the start per
            squared distance to the goal.
        track_iterations, relax_iterations: iLQR iterations of each of these solves, at most; relax_iterations=0
            compares the candidates as tracked.
        relax_top: candidates per problem that are relaxed, the cheapest as tracked; None: all.
        refine_top: candidates per problem that AL-iLQR solves to convergence, of the relaxed ones that differ; 1: the
            best relaxed candidate is proposed as it is.
        max_penetration: largest accepted penetration of a relaxed candidate into an obstacle, as a share of the mean
            inflated radius; at least 0.5 where the candidate is refined before it counts.
        max_gap: how much more than without constraints the best candidate may cost, as a share; where it costs more,
            twice as many paths from each of two searches are compared, followed in two ways, and the best candidates
            refined. Where no candidate is sound, the best are refined, too. None: it may cost anything, and nothing
            more is refined.

    Raises:
        InputError: a field out of its range.
    """

    roadmap: Roadmap = Roadmap()
    num_paths: Count = 1
    initial_offsets: tuple[tuple[float, ...], ...] = ()
    depart: float = 0.0
    arrive: float | tuple[float, ...] = 0.9
    pace: Positive | None = None
    smoothing: Annotated[float, AtLeast(0), Below(1)] = 0.08
    tube: Positive | None = 0.05
    stiffness: tuple[Positive, ...] = (20.0, 200.0)
    track_iterations: Count = 20
    relax_iterations: Natural = 20
    relax_top: Count | None = None
    refine_top: Count = 1
    max_penetration: Positive = 0.1
    max_gap: Positive | None = None

    def __post_init__(self) -> None:
        check_options(self, "paths")
        for name in ("arrive", "stiffness", "initial_offsets"):  # lists of a configuration file equal tuples
            if isinstance(value := getattr(self, name), Sequence):
                rows = (tuple(row) if isinstance(row, list) else row for row in value)
                object.__setattr__(self, name, tuple(rows))
        if not self.paces or not all(0 <= self.depart < arrive <= 1 for arrive in self.paces):
            raise InputError("paths.depart", f"at least 0 and below arrive, {self.arrive}", self.depart)
        if not self.stiffness:
            raise InputError("paths.stiffness", "one or more numbers above 0", self.stiffness)

    @property
    def paces(self) -> tuple[float, ...]:
        """The values of `arrive`, as a tuple."""
        return tuple(self.arrive) if isinstance(self.arrive, Sequence) else (self.arrive,)

    def closer(self) -> Self:
        """Proposals that follow the same paths closer, where candidates leave them for a trap."""
        spring = self.tube is None
        return replace(
            self, smoothing=self.smoothing / SHARPER,
            stiffness=(STIFFER * self.stiffness[-1],) if spring else self.stiffness,
            track_iterations=(LONGER_BY_SPRING if spring else LONGER_IN_TUBE) * self.track_iterations,
        )  # fmt: skip

    def roughly(self) -> Self:
        """Proposals for which a few candidates are refined roughly, those that penetrate deeper too."""
        return replace(self, refine_top=COMPARED, max_penetration=max(DEEP, self.max_penetration))

    def wider(self) -> Self:
        """Proposals that compare more paths, from two searches, by candidates that are refined roughly."""
        relax_top = None if self.relax_top is None else MORE * MORE * self.relax_top
        return replace(self.roughly(), num_paths=MORE * self.num_paths, relax_top=relax_top)

    def among_more_points(self) -> Self:
        """Proposals along paths over a roadmap with more points: other paths, but not always better ones."""
        roadmap = replace(self.roadmap, num_halton=MORE * self.roadmap.num_halton)
        # The trajectory without constraints, which pace and gap are measured by, is known from the first search.
        return replace(self, roadmap=roadmap, pace=None, max_gap=None)

    def thorough(self) -> Self:
        """Proposals where the attempt along the best path has failed: more paths, tracked longer, all refined."""
        num_paths = MORE * self.num_paths
        return replace(
            self, num_paths=num_paths, track_iterations=THOROUGH * self.track_iterations, relax_top=None,
            refine_top=max(num_paths, self.refine_top), pace=None, max_gap=None,
        )  # fmt: skip
