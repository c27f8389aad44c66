"""Every solver by name, with its settings.

Each preset is a function of the space that the problems live in: a Problem, or the dimension 2 or 3. Commands
name these presets (`solver=NAME`), `torchgco.solve` uses `gco`, and `dataclasses.replace` changes an option.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from torchgco.base.errors import InputError, shown
from torchgco.baselines import CasADiSolver, GuidedCasADi, Hold, IteratedMPPI, PathPursuit
from torchgco.guidance.gco import GCO
from torchgco.guidance.mppi import MPPI
from torchgco.problem.problem import Problem
from torchgco.roadmap.roadmap import Roadmap
from torchgco.search import (
    ClearChords,
    Converge,
    Finish,
    Follow,
    FromProposal,
    FromSamples,
    IntoGoal,
    MultiStart,
    PathProposals,
    Refine,
    Restarts,
    Solve,
    Starts,
)
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
    """The default: AL-iLQR with restarts along paths of several homotopy classes, and from samples."""
    solve, proposals, samples = _parts(space)
    more = 2 * proposals.num_paths
    closer = _closer(proposals.follow[0])
    known = replace(proposals, when="unproposed", roadmaps=(), relax_top=None)
    rough = Refine(top=4, rounds=4, violation=1e-2, cut=0.3, needed=True)
    plane = _in_the_plane(space)
    # Obstacles may bar the way from rest to the path, such as a wall between the two.
    followed_closer = replace(known, follow=(closer, replace(closer, obstacles=0.0)))
    if not plane:  # a costly problem: repairing candidates that cut deep into an obstacle is worth its time
        followed_closer = replace(followed_closer, refine=rough, max_penetration=0.5)
    costly = replace(
        proposals, when="costly", roadmaps=_denser(proposals.roadmaps), num_paths=more,
        follow=(proposals.follow[0], closer), relax_top=None if plane else 12, refine=rough, max_penetration=0.5,
        max_gap=None if plane else 0.15,
    )  # fmt: skip
    thorough = replace(
        proposals, when="far", num_paths=more, follow=(_longer(proposals.follow[0]),), relax_top=None,
        refine=Refine(top=more),
    )  # fmt: skip
    return Restarts(
        local=replace(_local(space), guidance=_guidance(space)),
        passes=(
            Converge(when="first"),
            replace(solve, until="end", when="pathless"),
            solve,
            proposals,
            costly,
            followed_closer,
            FromProposal(),
            IntoGoal(),
            thorough,
            FromProposal(),
            FromSamples("unproposed"),
            samples,
            IntoGoal(),
            Converge(when="mapped"),
            _finish(space),
            ClearChords(),
            Converge(),
            Starts(),
        ),
    )


def gco_fast(space: Space) -> Restarts:
    """One attempt along the shortest path, tracked from rest."""
    solve, proposals, _ = _parts(space)
    guidance = _guidance(space)
    follow = replace(_from_rest(space, proposals.follow[0]), iterations=10)
    one = replace(proposals, num_paths=1, follow=(follow,), relax_iterations=0, relax_top=None, refine=Refine())
    closer = replace(one, when="unproposed", roadmaps=(), follow=(_closer(follow),))
    guidance = replace(guidance, sampler=replace(guidance.sampler, samples=64, rounds=10))
    return Restarts(
        local=replace(_local(space), guidance=guidance),
        passes=(
            Converge(when="first"),
            replace(solve, until="end", when="pathless"),
            solve,
            one,
            closer,
            FromProposal(),
            IntoGoal(),
            FromSamples("unproposed"),
            IntoGoal(),
            Converge(when="mapped"),
            _finish(space),
            ClearChords(),
            Converge(),
        ),
    )


def gco_max(space: Space) -> Restarts:
    """The passes of `gco`, then more for every caught problem: sixteen refined candidates, and more samples.

    Without obstacles: more starts.
    """
    solver = gco(space)
    *_, proposals, samples = _parts(space)
    many = replace(proposals, when="caught", num_paths=16, relax_top=None, refine=Refine(top=16))
    closer = replace(many, when="unproposed", roadmaps=(), follow=(_closer(many.follow[0]),))
    more = (many, closer, FromProposal(), IntoGoal(), replace(samples, when="caught"), IntoGoal())
    *begin, finish, chords, converge, starts = solver.passes
    # What `gco` would return is cleared first: a cheaper trajectory that can't be cleared gives way to it again.
    return replace(solver, passes=(*begin, chords, *more, finish, chords, converge, replace(starts, when="all")))


def gco_exact(space: Space) -> Restarts:
    """`gco` with its last steps taken to a violation and KKT residual of 1e-8; in float64.

    The tolerance of the interior point is smaller: it counts in units of the cost's steepest slope or curvature, while
    a residual is a share of the terms that cancel in a control's slope, which may be far smaller.
    """
    solver, exact = gco(space), InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9)
    ends = Converge | ClearChords | Starts
    return replace(
        solver, passes=tuple(replace(row, solver=exact) if isinstance(row, ends) else row for row in solver.passes)
    )


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
    return CasADiSolver("fatrop")


def fatrop_guided(space: Space) -> GuidedCasADi:
    """FATROP from the cheapest of four tracked candidates; guesses that penetrate an obstacle are accepted."""
    _, proposals, _ = _parts(space)
    relaxed = 0 if _in_the_plane(space) else 20  # in the plane, relaxed candidates fall back into the trap
    follow = replace(_from_rest(space, proposals.follow[0]), pace=None)
    first = replace(
        proposals, num_paths=4, follow=(follow,), relax_iterations=relaxed, relax_top=None, refine=Refine(),
        max_penetration=1.0,
    )  # fmt: skip
    closer = replace(first, when="unproposed", roadmaps=(), follow=(_closer(follow),))
    return GuidedCasADi(fatrop(space), (first, closer))


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
    return PRESETS[name](space)


def _parts(space: Space) -> tuple[Solve, PathProposals, FromSamples]:
    """The passes of `gco` that the others are made of: the first solve, the first proposals, and samples."""
    if _in_the_plane(space):
        follow = Follow(initial_offsets=OFFSETS, depart=0.1, arrive=0.6, stiffness=(200.0,))
        roadmaps = (Roadmap(max_overlap=0.02),)
        proposals = PathProposals(
            roadmaps=roadmaps, num_paths=6, follow=(follow,), relax_iterations=40, refine=Refine(top=8)
        )
        return Solve(single_contact_after=3), proposals, FromSamples(redraws=2)
    follow = Follow(arrive=0.9, pace=1.75, smoothing=0.16, tube=None, stiffness=(200.0,), iterations=10)
    proposals = PathProposals(roadmaps=(Roadmap(num_halton=128),), num_paths=6, follow=(follow,), relax_top=3)
    return Solve(single_contact_after=6), proposals, FromSamples(redraws=3)


def _from_rest(space: Space, follow: Follow) -> Follow:
    """Follows each path once, from rest: in the plane later and in two solves, as no other candidate stands in."""
    if _in_the_plane(space):
        follow = replace(follow, initial_offsets=(), arrive=0.8, stiffness=(20.0, 200.0))
    return follow


def _closer(follow: Follow) -> Follow:
    """Follows the same paths closer, where candidates leave them for a trap.

    A spring gives way to the cost: it gets stiffer, and then takes more iterations to reach the path. So does a tube
    around sharper corners.
    """
    spring = follow.tube is None
    return replace(
        follow, smoothing=follow.smoothing / 4.0, iterations=(3 if spring else 2) * follow.iterations,
        stiffness=(10.0 * follow.stiffness[-1],) if spring else follow.stiffness,
    )  # fmt: skip


def _longer(follow: Follow) -> Follow:
    """Follows paths to the end of the horizon, with more iterations, where the attempt along the best one failed."""
    return replace(follow, iterations=3 * follow.iterations, pace=None)


def _denser(roadmaps: tuple[Roadmap, ...]) -> tuple[Roadmap, ...]:
    """The searches, and the same with twice the points: other paths, but not always better ones."""
    return *roadmaps, *(replace(roadmap, num_halton=2 * roadmap.num_halton) for roadmap in roadmaps)


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


def _finish(space: Space) -> Finish:
    """The local solver with limits that only the slowest of ordinary problems reach, and an end where nothing changes.

    Penalties grow tenfold where the violation doesn't fall by half: costs without states, whose unit is small, begin
    with a penalty that is far too low.
    """
    local = _local(space)
    inner = replace(local.inner, max_iterations=200, damp_below=0.125)
    return Finish(replace(local, inner=inner, max_outer_iterations=100, stalled_growth=10.0, patience=8))


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
