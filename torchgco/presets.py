"""Every solver by name, with its settings.

Each preset is a function of the space that the problems live in: a Problem, or the dimension 2 or 3. The configurations
in conf/solver name these presets, `torchgco.solve` uses `gco`, and `dataclasses.replace` changes an option.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from torchgco.base.errors import InputError, shown
from torchgco.baselines import CasADiSolver, GuidedCasADi, Hold, IteratedMPPI
from torchgco.guidance.gco import GCO
from torchgco.guidance.mppi import MPPI
from torchgco.problem.problem import Problem
from torchgco.roadmap.roadmap import Roadmap
from torchgco.search.multistart import MultiStart
from torchgco.search.paths import PathProposals
from torchgco.search.restarts import Restarts
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.contracts import Solver
from torchgco.solvers.ilqr import ILQR

Space = Problem | int

# Turns, half turns, both controls, one control: initial offsets of a vehicle with two controls.
OFFSETS = (
    (0.7, -0.7), (-0.7, 0.7), (0.35, -0.35), (-0.35, 0.35), (1, 1), (-1, -1), (-1, 0), (0, -1), (1, 0), (0, 1),
)  # fmt: skip


def gco(space: Space) -> Restarts:
    """The default: AL-iLQR with restarts along paths of several homotopy classes, and from samples."""
    if _in_the_plane(space):
        return Restarts(
            local=_local(space),
            paths=PathProposals(
                roadmap=Roadmap(max_overlap=0.02), num_paths=12, initial_offsets=OFFSETS, depart=0.1,
                arrive=(0.8, 0.6), relax_iterations=40, refine_top=8,
            ),
            sampling=GCO(
                MPPI(
                    samples=256, covariance=None, spread=0.35, temperature=0.01, rounds=20, noise_knots=8, decay=0.93,
                    dwell_cost=1.0, elite=5, dtype="float32",
                ),
                initial_penalty=2.0, start_from_sample=True, sample_from_rest=True, single_contact_after=3,
            ),
            attempts=3,
            finish=_finish(space),
        )  # fmt: skip
    return Restarts(
        local=_local(space),
        paths=PathProposals(
            roadmap=Roadmap(num_halton=128), num_paths=6, relax_top=3, arrive=(0.9,), smoothing=0.16, tube=None,
            stiffness=(200.0,), track_iterations=10, pace=1.75, max_gap=0.15,
        ),
        sampling=GCO(
            MPPI(
                samples=128, covariance=None, spread=0.1, temperature=0.01, rounds=12, noise_knots=10, decay=0.9,
                elite=5, dtype="float32",
            ),
            initial_penalty=0.09, start_from_sample=True, single_contact_after=6,
        ),
        attempts=4,
        finish=_finish(space),
    )  # fmt: skip


def gco_fast(space: Space) -> Restarts:
    """One attempt along the shortest path, tracked from rest."""
    solver = gco(space)
    assert solver.paths is not None and solver.sampling is not None
    paths = replace(
        solver.paths, num_paths=1, initial_offsets=(), arrive=solver.paths.paces[:1], track_iterations=10,
        relax_iterations=0, relax_top=None, refine_top=1, max_gap=None,
    )  # fmt: skip
    sampling = replace(solver.sampling, sampler=replace(solver.sampling.sampler, samples=64, rounds=10))
    return replace(solver, paths=paths, sampling=sampling, attempts=1)


def gco_max(space: Space) -> Restarts:
    """Up to sixteen paths, the sixteen best candidates refined, then sampled attempts; the cheapest result is kept."""
    solver = gco(space)
    assert solver.paths is not None
    paths = replace(solver.paths, num_paths=16, relax_top=None, refine_top=16, max_gap=None)
    return replace(solver, paths=paths, attempts=4, all_attempts=True)


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
    paths = gco(space).paths
    assert paths is not None
    relaxed = 0 if _in_the_plane(space) else 20  # in the plane, relaxed candidates fall back into the trap
    paths = replace(
        paths, num_paths=4, initial_offsets=(), arrive=paths.paces[:1], relax_iterations=relaxed, relax_top=None,
        refine_top=1, max_penetration=1.0, pace=None, max_gap=None,
    )  # fmt: skip
    return GuidedCasADi(fatrop(space), paths)


PRESETS: dict[str, Callable[[Space], Solver]] = {
    make.__name__: make
    for make in (
        gco,
        gco_fast,
        gco_max,
        gco_paper,
        al_ilqr,
        ilqr,
        mppi,
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


def _local(space: Space) -> AugmentedLagrangian:
    """AL-iLQR in short inner solves; penalties in units of `Problem.cost_unit`."""
    penalty, iterations = (2.0, 20) if _in_the_plane(space) else (0.09, 10)
    inner = ILQR(tolerance=5e-6, max_iterations=iterations)
    return AugmentedLagrangian(inner, initial_penalty=penalty, max_outer_iterations=20)


def _finish(space: Space) -> AugmentedLagrangian:
    """The local solver with limits that only the slowest of ordinary problems reach, and an end where nothing changes.

    Penalties grow tenfold where the violation doesn't fall by half: costs without states, whose unit is small, begin
    with a penalty that is far too low.
    """
    local = _local(space)
    inner = replace(local.inner, max_iterations=200, damp_below=0.125)
    return replace(local, inner=inner, max_outer_iterations=100, stalled_growth=10.0, patience=8)


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
