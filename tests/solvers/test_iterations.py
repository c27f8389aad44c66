"""`Solution.iterations` counts every iteration made for a problem, in nested solves too."""

from dataclasses import replace

import pytest
import torch

import torchgco
from tests.problems import planar_batch, quadrotor_batch, quick_gco
from tests.search.rows import varied
from torchgco import (
    MPPI,
    ControlBounds,
    FunctionDynamics,
    MultiStart,
    PathProposals,
    Problem,
    QuadraticCost,
    Restarts,
)
from torchgco.kernels.in_c import NativeKernels
from torchgco.kernels.outer import NativeOuter
from torchgco.native.interior import InteriorEngine

BATCHES = {
    "planar": lambda: planar_batch(B=3, N=25, obstacles=9, seed=4),
    "quadrotor": lambda: quadrotor_batch(B=3, N=25, obstacles=7, seed=2),
}


def guided(problem: Problem, record: bool = False) -> Restarts:
    """`gco` with few samples and few candidates, which are tracked, relaxed and refined."""
    solver = quick_gco(problem)
    guidance = replace(solver.local.guidance, sampler=MPPI(samples=16))
    local = replace(solver.local, guidance=guidance, max_outer_iterations=4, record=record)
    passes = (varied(row, iterations=4, relax_iterations=3, max_penetration=9.0)
              if isinstance(row, PathProposals) else row for row in solver.passes)  # fmt: skip
    return replace(solver, local=local, passes=tuple(passes))


SOLVERS = {
    "gco": guided,
    "multistart": lambda problem: MultiStart(replace(guided(problem).local, guidance=None), starts=2),
}


@pytest.fixture
def made(monkeypatch) -> list[int]:
    """Numbers of iterations and Newton steps, noted in every solve."""
    made: list[int] = []

    def descend(self, lagrangian, state, how, limit, begins=False, real=NativeKernels.descend):
        before = int(state.iterations.sum())
        end = real(self, lagrangian, state, how, limit, begins)
        made.append(int(state.iterations.sum()) - before)
        return end

    monkeypatch.setattr(NativeKernels, "descend", descend)

    def passes(self, real=NativeOuter._run, **fields):
        before = int(self.state.iterations.sum())
        real(self, **fields)
        made.append(int(self.state.iterations.sum()) - before)

    monkeypatch.setattr(NativeOuter, "_run", passes)

    def interior(self, *arguments, real=InteriorEngine.solve, **options):
        out = real(self, *arguments, **options)
        made.append(int(out["iterations"].sum()))
        return out

    monkeypatch.setattr(InteriorEngine, "solve", interior)
    return made


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("batch", BATCHES)
def test_every_iteration_is_counted_once(batch: str, name: str, made: list[int]) -> None:
    problem, U0 = BATCHES[batch]()
    solver = SOLVERS[name](problem)
    together = solver.solve(problem, U0, seed=3)
    assert int(together.iterations.sum()) == sum(made)
    assert name == "multistart" or bool((together.guided > 0).any())
    for b in (0, 2):
        rows = torch.tensor([b])
        made.clear()
        alone = solver.solve(problem.take(rows), U0[rows], seed=3, ids=rows)
        assert int(alone.iterations) == int(together.iterations[b]) == sum(made)


@pytest.mark.slow
def test_candidates_take_most_iterations_and_are_not_in_the_trace() -> None:
    problem, U0 = BATCHES["planar"]()
    solution = guided(problem, record=True).solve(problem, U0, seed=3)
    rows = solution.trace.groupby("element").size()
    assert bool((solution.iterations >= torch.tensor(rows.tolist())).all())
    caught = solution.guided > 0
    assert bool((solution.iterations[caught] > 2 * torch.tensor(rows.tolist())[caught]).any())
    for _, history in solution.trace.groupby(["element", "attempt"]):
        assert history["iteration"].tolist() == list(range(len(history)))


@pytest.mark.parametrize("bend", [0.0, 0.3])
def test_convex_problems_are_solved_once(bend: float) -> None:
    """`gco` begins once more where the start held costs less; not where what it found is known to be the least."""
    drift = lambda x, u: x + 0.1 * u + 0.2 + bend * x.sin()
    model = FunctionDynamics(drift, 1, 1, 0.1, "none")
    problem = Problem(model, QuadraticCost([1.0], [0.1], [1.0]), [ControlBounds(-1, 1)], torch.zeros(2, 1).double(), 20)
    found, once = (torchgco.solve(problem, solver=name, verbose=False) for name in ("gco", "interior_point"))
    assert bool((found.iterations > once.iterations).all()) is (bend > 0)
    torch.testing.assert_close(found.U, once.U, rtol=0, atol=1e-6)
