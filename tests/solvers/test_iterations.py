"""What `Solution.iterations` counts: every iteration that was made for a problem, however deep the solve is nested."""

from dataclasses import replace

import pytest
import torch
from torchgco.solvers.iteration import EagerIterations, NativeIterations

from tests.problems import planar_batch, quadrotor_batch, quick_gco
from torchgco import ILQR, MPPI, AugmentedLagrangian, Polish, Problem
from torchgco.baselines import MultiStart

BATCHES = {
    "planar": lambda: planar_batch(B=3, N=25, obstacles=9, seed=4),
    "quadrotor": lambda: quadrotor_batch(B=3, N=25, obstacles=7, seed=2),
}


def guided(problem: Problem) -> AugmentedLagrangian:
    """`gco` with few candidates, which are nonetheless followed, settled and solved to their end, and few samples."""
    solver = replace(quick_gco(problem), max_outer_iterations=4, attempts=2)
    guidance, detour = solver.guidance, solver.guidance.detour
    detour = replace(detour, roadmap=replace(detour.roadmap, nodes=32, spread=16), settle=3, iterations=4, depth=9.0)
    return replace(solver, guidance=replace(guidance, detour=detour, sampler=MPPI(samples=16)))


SOLVERS = {
    "gco": guided,
    "multistart": lambda problem: MultiStart(guided(problem), starts=2),
    "polished": lambda problem: replace(guided(problem), polish=Polish(iterations=2)),
}


@pytest.fixture
def made(monkeypatch) -> list[int]:
    """Iterations and Newton steps as they are made, in whatever solve."""
    made: list[int] = []
    for kernels in (EagerIterations, NativeIterations):

        def run(self, state, lagrangian, real=kernels.run):
            before = int(state.iterations.sum())
            end = real(self, state, lagrangian)
            made.append(int(state.iterations.sum()) - before)
            return end

        monkeypatch.setattr(kernels, "run", run)

    def step(self, *point, real=Polish._step):
        moved = real(self, *point)
        made.append(moved is not None)
        return moved

    monkeypatch.setattr(Polish, "_step", step)
    return made


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("batch", BATCHES)
def test_every_iteration_is_counted_once(batch: str, name: str, made: list[int]) -> None:
    problem, U0 = BATCHES[batch]()
    solver = SOLVERS[name](problem)
    together = solver.solve(problem, U0, seed=3)
    assert int(together.iterations.sum()) == sum(made)
    assert bool((together.guided > 0).any())
    for b in (0, 2):
        rows = torch.tensor([b])
        made.clear()
        alone = solver.solve(problem.take(rows), U0[rows], seed=3, ids=rows)
        assert int(alone.iterations) == int(together.iterations[b]) == sum(made)


def test_candidates_are_most_of_it_and_no_part_of_the_trace() -> None:
    problem, U0 = BATCHES["planar"]()
    solution = replace(guided(problem), record=True).solve(problem, U0, seed=3)
    rows = solution.trace.groupby("element").size()
    assert bool((solution.iterations >= torch.tensor(rows.tolist())).all())
    caught = solution.guided > 0
    assert bool((solution.iterations[caught] > 2 * torch.tensor(rows.tolist())[caught]).any())
    for _, history in solution.trace.groupby("element"):
        assert history["iteration"].tolist() == list(range(len(history)))


def test_steps_of_a_polish_are_counted_where_nothing_is_improved_too(made: list[int], monkeypatch) -> None:
    problem, U0 = BATCHES["planar"]()
    before = AugmentedLagrangian(inner=ILQR(max_iterations=20), max_outer_iterations=6, clip=True).solve(problem, U0)
    monkeypatch.setattr(Polish, "_is_better", lambda self, new, old, first: False)
    made.clear()
    after = Polish(iterations=2, reach=10.0).refine(problem, before)
    assert torch.equal(after.U, before.U) and int((after.iterations - before.iterations).sum()) == sum(made) > 0
