"""Calls of every native kernel, for a process in which a compiler's sanitizer watches all reads and writes."""

from __future__ import annotations

import torch

from tests.engines import engine_of
from tests.native import users
from tests.native.test_engine import BRIEF, PRINTED, running_state
from tests.problems import boxed_batch, planar_batch
from torchgco import MPPI, Problem
from torchgco.base.draws import DrawKey
from torchgco.kernels import EagerWarning, cost_scale, kernels_of
from torchgco.roadmap.geometry import scene_of
from torchgco.roadmap.roadmap import Roadmap
from torchgco.solvers.ending import optimality

SAMPLER = MPPI(samples=19, covariance=0.5, rounds=2, noise_knots=3, elite=4, dwell_cost=0.5)


def call_all(problem: Problem) -> None:
    """Each kernel once or more, with and without a guide."""
    B = problem.B
    for inner, guided in ((BRIEF, None), (PRINTED, "region"), (BRIEF, "path")):
        state, lagrangian = running_state(problem, guided)
        optimality(lagrangian, state.X, state.U)
        kernels_of(problem).lifted(lagrangian, state.X, state.U, torch.full_like(state.merit, 1e9))
        kernels_of(problem).descend(lagrangian, state, inner.descent, 4)
    key = DrawKey(7, torch.arange(B), torch.arange(B))
    SAMPLER.improve(problem, state.U, key)
    cost_scale(problem)
    scene = scene_of(problem, problem.cost.rest_controls(torch.zeros_like(state.U)))
    if scene is not None:
        Roadmap(num_halton=12).paths(scene, 3)


def main() -> None:
    small = MPPI(samples=17, dtype="float32")
    problems = [planar_batch(B=9, N=9, obstacles=5)[0], boxed_batch(3, B=2, N=7)[0], users.PROBLEMS["shifted"]()]
    small.improve(problems[0], torch.zeros(9, 9, 2).double(), DrawKey(7, torch.arange(9), torch.arange(9)))
    for problem in problems:
        assert engine_of(problem) is not None
        call_all(problem)
        print("called", flush=True)


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("error", EagerWarning)
    main()
