"""The settings of the default solver, by what can be seen of a problem."""

from __future__ import annotations

from dataclasses import replace

from torchgco.guidance.detour import Detour
from torchgco.guidance.gco import GCO
from torchgco.guidance.mppi import MPPI
from torchgco.guidance.roadmap import Roadmap
from torchgco.problem import Problem
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR
from torchgco.solvers.line_search import LineSearch

# Turns, half turns, both controls, one control: initial offsets of a vehicle with two controls.
OFFSETS = (
    (0.7, -0.7), (-0.7, 0.7), (0.35, -0.35), (-0.35, 0.35), (1, 1), (-1, -1), (-1, 0), (0, -1), (1, 0), (0, 1),
)  # fmt: skip
IN_THE_PLANE = (
    GCO(
        sampler=MPPI(
            samples=256, covariance=None, spread=0.35, temperature=0.01, rounds=20, knots=8, decay=0.93, linger=1.0,
            elite=5, dtype="float32",
        ),
        initial_penalty=2.0, adopt=True, patience=3, afresh=True,
        detour=Detour(
            roadmap=Roadmap(slack=0.02), ways=12, pushes=OFFSETS, begin=0.1, end=(0.8, 0.6), settle=40, finalists=8,
        ),
    ),
    {"penalty": 2.0, "iterations": 20, "attempts": 3},
)  # fmt: skip
IN_SPACE = (
    GCO(
        sampler=MPPI(
            samples=128, covariance=None, spread=0.1, temperature=0.01, rounds=12, knots=10, decay=0.9, elite=5,
            dtype="float32",
        ),
        initial_penalty=0.09, adopt=True, patience=6,
        detour=Detour(
            roadmap=Roadmap(spread=128), ways=6, keep=3, end=(0.9,), smoothing=0.16, tube=None, stiffness=(200.0,),
            iterations=10,
        ),
    ),
    {"penalty": 0.09, "iterations": 10, "attempts": 4},
)  # fmt: skip


def gco(problem: Problem) -> AugmentedLagrangian:
    """The solver that the configuration `gco` describes, for problems in the plane or in space.

    Without obstacles, or without a position, there is nothing to be guided around: the augmented Lagrangian alone.
    """
    at = problem.dynamics.position
    guidance, numbers = IN_SPACE if at is not None and at.stop - at.start == 3 else IN_THE_PLANE
    if not problem.geometric or at is None:
        guidance = None
    elif guidance.detour is not None and problem.m != 2:
        guidance = _without_offsets(guidance)
    return AugmentedLagrangian(
        inner=ILQR(
            tolerance=5e-6,
            max_iterations=numbers["iterations"],
            damping=0.02,
            line_search=LineSearch(accept_last=False),
        ),
        guidance=guidance,
        initial_penalty=numbers["penalty"],
        grow_when_feasible=False,
        max_outer_iterations=20,
        cost_tolerance=1e-3,
        hold_factor=2.0,
        attempts=numbers["attempts"],
        arrival=0.09,
        clip=True,
    )


def _without_offsets(guidance: GCO) -> GCO:
    """Initial offsets are given for two controls; with another number, paths are followed from rest alone."""
    assert guidance.detour is not None
    return replace(guidance, detour=replace(guidance.detour, pushes=()))
