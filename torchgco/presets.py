"""Every solver by name, with its settings.

Each preset is a function of the space that the problems live in: a Problem, or the dimension 2 or 3. Commands
name these presets (`solver=NAME`), `torchgco.solve` uses `gco`, and `dataclasses.replace` changes an option.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

from torchgco.base.errors import InputError, shown
from torchgco.baselines import CasADiSolver, GuidedCasADi, Hold, IteratedMPPI, PathPursuit
from torchgco.guidance.gco import GCO
from torchgco.guidance.mppi import MPPI
from torchgco.problem.problem import Problem
from torchgco.roadmap.roadmap import Roadmap
from torchgco.search import (
    ClearChords,
    FirstSolve,
    Follow,
    FromProposal,
    FromSamples,
    IntoGoal,
    Join,
    MultiStart,
    Passes,
    Paths,
    Refine,
    Restarts,
    Samples,
    Starts,
    Tighten,
    Timed,
    Tube,
)
from torchgco.search.rows import closer
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Solver
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.interior import InteriorPoint

Space = Problem | int

# Turns, half turns, both controls, one control: initial offsets of a vehicle with two controls.
OFFSETS = (
    (0.7, -0.7), (-0.7, 0.7), (0.35, -0.35), (-0.35, 0.35), (1, 1), (-1, -1), (-1, 0), (0, -1), (1, 0), (0, 1),
)  # fmt: skip


def gco(space: Space) -> Restarts:
    """The default: AL-iLQR and an interior point, with restarts along paths of several homotopy classes and samples."""
    return Restarts(
        local=replace(_local(space), guidance=_guidance(space)),
        passes=Passes({
            "guess": FirstSolve(single_contact_after=3 if _in_the_plane(space) else 6),
            "timed": Timed(),
            "maps": Tube(among="maps"),
            "paths": _paths(space),
            "tube": Tube(among="bodies"),
            "samples": Samples(redraws=2 if _in_the_plane(space) else 3),
            "clear": ClearChords(),
            "tighten": Tighten(),
        }),
    )  # fmt: skip


def gco_fast(space: Space) -> Restarts:
    """One attempt along the shortest path, tracked from rest."""
    guidance = _guidance(space)
    follow = replace(_from_rest(space, _paths(space).follow), iterations=10)
    first = replace(_paths(space).proposals, num_paths=1, follow=(follow,), relax_top=None, refine=Refine())
    one = replace(first, relax_iterations=0)
    guidance = replace(guidance, sampler=replace(guidance.sampler, samples=64, rounds=10))
    return Restarts(
        local=replace(_local(space), guidance=guidance),
        passes=Passes({
            "guess": gco(space).passes.guess,
            "timed": Timed(ways=2),
            "path": one,
            "closer": replace(one, when="unproposed", roadmaps=(), follow=(closer(follow),)),
            "attempt": FromProposal(),
            "into_goal": IntoGoal(),
            "samples": FromSamples("unproposed"),
            "again_into_goal": IntoGoal(),
            "joined": Join(),
            "clear": ClearChords(),
            "tighten": Tighten(starts=0),
        }),
    )  # fmt: skip


def gco_max(space: Space) -> Restarts:
    """The passes of `gco`, then more for every caught problem: sixteen refined candidates, and more samples.

    Without obstacles: more starts.
    """
    solver, first = gco(space), _paths(space).proposals
    many = replace(first, when="caught", num_paths=16, relax_top=None, refine=Refine(top=16))
    near = replace(many, when="unproposed", roadmaps=(), follow=(closer(many.follow[0]),))
    samples = FromSamples("caught", redraws=solver.passes.samples.redraws)
    *begin, (_, chords), tighten = solver.passes.items()
    # What `gco` would return is cleared first: a cheaper trajectory that can't be cleared gives way to it again.
    more = {
        "clear_first": chords, "many": many, "many_closer": near, "attempt": FromProposal(), "into_goal": IntoGoal(),
        "more_samples": samples, "again_into_goal": IntoGoal(), "clear": chords,
    }  # fmt: skip
    return replace(solver, passes=Passes({**dict(begin), **more, **dict([tighten]), "starts": Starts(when="all")}))


def gco_exact(space: Space) -> Restarts:
    """`gco` with its last steps taken to a violation and KKT residual of 1e-8; in float64.

    The tolerance of the interior point is smaller, since it is measured after the cost's gradient has been scaled to 1.
    The certified residual is relative to the terms that cancel in a control's gradient, which may be far smaller.
    """
    return replace(gco(space), interior=InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9))


def gco_paper(space: Space) -> AugmentedLagrangian:
    """The paper's method: Algorithms 1 to 5 with Table 4 (in the plane: Table A3)."""
    return replace(al_ilqr(space), guidance=GCO(_printed_sampler(space)))


def al_ilqr(space: Space) -> AugmentedLagrangian:
    """AL-iLQR as the paper runs it: Algorithms 1 and 2 with the same tables, without guidance."""
    limit = 20 if _in_the_plane(space) else 10
    return AugmentedLagrangian(ilqr(space), initial_penalty=20.0, penalty_growth=2.2, max_outer_iterations=limit)


def ilqr(space: Space) -> ILQR:
    """iLQR alone (Algorithm 2), without the constraints."""
    if _in_the_plane(space):
        return ILQR(as_printed=True, tolerance=1e-18, max_iterations=100)
    return ILQR(as_printed=True, tolerance=0.1, max_iterations=50)


def mppi(space: Space) -> IteratedMPPI:
    """Algorithm 3 alone, iterated open loop around its own mean."""
    return IteratedMPPI(replace(_printed_sampler(space), saturation="bounds"), iterations=100)


def interior_point(space: Space) -> InteriorPoint:
    """A primal-dual interior point on multiple shooting, from the guess alone."""
    return InteriorPoint()


def path_pursuit(space: Space) -> PathPursuit:
    """A grid path, pursued by a simple controller, then the interior point: for unicycles and points."""
    return PathPursuit()


def multistart(space: Space) -> MultiStart:
    """AL-iLQR from random guesses, with as many iterations as `gco` makes in the family where it makes the most."""
    if _in_the_plane(space):
        return MultiStart(_local(space), starts=1000, budget=8000, covariance=50.0, noise_knots=8)
    return MultiStart(_local(space), starts=1000, budget=125)


def hold(space: Space) -> Hold:
    """The initial guess, unchanged."""
    return Hold()


def ipopt(space: Space) -> CasADiSolver:
    """IPOPT with MUMPS through CasADi: multiple shooting, exact Hessians."""
    return CasADiSolver("ipopt")


def fatrop(space: Space) -> CasADiSolver:
    """FATROP through CasADi: like `ipopt`, with a Riccati recursion over the stages as linear algebra."""
    return CasADiSolver("fatrop", max_seconds=120.0)  # it may hang within a call


def fatrop_guided(space: Space) -> GuidedCasADi:
    """FATROP from the cheapest of four tracked candidates; guesses that penetrate an obstacle are accepted."""
    proposals = _paths(space).proposals
    relaxed = 0 if _in_the_plane(space) else 20  # in the plane, relaxed candidates fall back into the trap
    follow = replace(_from_rest(space, proposals.follow[0]), pace=None)
    first = replace(
        proposals, num_paths=4, follow=(follow,), relax_iterations=relaxed, relax_top=None, refine=Refine(),
        max_penetration=1.0,
    )  # fmt: skip
    near = replace(first, when="unproposed", roadmaps=(), follow=(closer(follow),))
    return GuidedCasADi(fatrop(space), (first, near))


PRESETS: dict[str, Callable[[Space], Solver]] = {
    make.__name__: make
    for make in (
        gco,
        gco_fast,
        gco_max,
        gco_exact,
        gco_paper,
        al_ilqr,
        ilqr,
        mppi,
        interior_point,
        path_pursuit,
        multistart,
        hold,
        ipopt,
        fatrop,
        fatrop_guided,
    )
}


def named(name: str, space: Space) -> Solver:
    """The solver of a preset by its name; InputError where there is none."""
    if name not in PRESETS:
        raise InputError("solver", f"one of {', '.join(PRESETS)}, or a solver", shown(name))
    return _made(PRESETS[name], 2 if _in_the_plane(space) else 3)


@cache
def _made(preset: Callable[[Space], Solver], dimension: int) -> Solver:
    """Solvers are immutable, and depend on the dimension alone: making one takes a millisecond."""
    return preset(dimension)


def _paths(space: Space) -> Paths:
    """The row of `gco` that the others' proposals are made of."""
    if _in_the_plane(space):
        follow = Follow(initial_offsets=OFFSETS, depart=0.1, arrive=0.6, stiffness=(200.0,))
        return Paths(roadmap=Roadmap(max_overlap=0.02), follow=follow, relax_iterations=40, refined=8)
    follow = Follow(arrive=0.9, pace=1.75, smoothing=0.16, tube=None, stiffness=(200.0,), iterations=10)
    return Paths(roadmap=Roadmap(num_halton=128), follow=follow, relax_top=3, max_gap=0.15)


def _from_rest(space: Space, follow: Follow) -> Follow:
    """Follows each path once, from rest: in the plane later and in two solves, as no other candidate stands in."""
    if _in_the_plane(space):
        follow = replace(follow, initial_offsets=(), arrive=0.8, stiffness=(20.0, 200.0))
    return follow


def _guidance(space: Space) -> GCO:
    """The samples of `gco`."""
    if _in_the_plane(space):
        sampler = MPPI(
            samples=256, covariance=None, spread=0.35, temperature=0.01, rounds=20, noise_knots=8, decay=0.93,
            dwell_cost=1.0, elite=5, dtype="float32",
        )  # fmt: skip
        return GCO(sampler, 2.0, start_from_sample=True, sample_from_rest=True)
    sampler = MPPI(
        samples=128, covariance=None, spread=0.1, temperature=0.01, rounds=12, noise_knots=10, decay=0.9, elite=5,
        dtype="float32",
    )  # fmt: skip
    return GCO(sampler, 0.09, start_from_sample=True)


def _local(space: Space) -> AugmentedLagrangian:
    """AL-iLQR in short inner solves; penalties in units of `Problem.cost_unit`."""
    penalty, iterations = (2.0, 20) if _in_the_plane(space) else (0.09, 10)
    inner = ILQR(tolerance=5e-6, max_iterations=iterations)
    return AugmentedLagrangian(inner, initial_penalty=penalty, max_outer_iterations=20)


def _printed_sampler(space: Space) -> MPPI:
    if _in_the_plane(space):
        # On purpose wider than the bounds where these are not symmetric.
        return MPPI(samples=500, covariance=100.0, saturation="symmetric")
    return MPPI(samples=100, covariance=1.0)


def _in_the_plane(space: Space) -> bool:
    """Whether the settings for the plane apply: in all but 3-D problems."""
    if not isinstance(space, Problem) and space not in (2, 3):
        raise InputError("space", "a Problem, or the dimension 2 or 3", repr(space))
    if isinstance(space, Problem):
        at = space.dynamics.position
        space = 0 if at is None else at.stop - at.start
    return space != 3
