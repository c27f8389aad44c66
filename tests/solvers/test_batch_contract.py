"""A problem's result has the same bits alone, in any batch and in any order; a broken problem disturbs no other."""

import pytest
import torch

from tests.problems import FIELDS, assert_same_bits, boxed_batch, planar_batch, quadrotor_batch
from tests.search.rows import restarts
from torchgco import (
    GCO,
    ILQR,
    MPPI,
    AugmentedLagrangian,
    PathProposals,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Spheres,
)
from torchgco.base.status import Status
from torchgco.baselines import IteratedMPPI
from torchgco.constraints import ControlBounds
from torchgco.missions.planning_problem import FirstStepRates
from torchgco.search import Follow, Refine
from torchgco.solution import Solution

SAMPLER = MPPI(samples=20)
SOLVERS = {
    "gco": AugmentedLagrangian(
        inner=ILQR(tolerance=1e-4, max_iterations=8),
        guidance=GCO(sampler=SAMPLER),
        initial_penalty=0.1,
        max_outer_iterations=6,
    ),
    "gco as printed": AugmentedLagrangian(
        inner=ILQR(as_printed=True, tolerance=0.1, max_iterations=15),
        guidance=GCO(sampler=SAMPLER),
        max_outer_iterations=4,
    ),
    "restarts": restarts(
        AugmentedLagrangian(ILQR(max_iterations=6), initial_penalty=0.1, max_outer_iterations=5),
        PathProposals(
            num_paths=3,
            relax_top=2,
            follow=(Follow(iterations=4),),
            relax_iterations=3,
            refine=Refine(top=2),
            max_penetration=9.0,
        ),
        GCO(
            sampler=MPPI(samples=40, covariance=4.0, rounds=3, noise_knots=5, decay=0.8, elite=3, dwell_cost=1.0),
            start_from_sample=True,
        ),
        attempts=3,
        after=2,
    ),
    "mppi": IteratedMPPI(sampler=SAMPLER, iterations=4),
}
BATCHES = {
    "planar": lambda: planar_batch(B=7, N=25, obstacles=9, seed=4),
    "quadrotor": lambda: quadrotor_batch(B=7, N=25, obstacles=7, seed=2),
    "boxes": lambda: boxed_batch(2, B=7, N=25, boxes=6, seed=4),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("solver", ["gco", "restarts"])
@pytest.mark.parametrize("batch", ["planar", "quadrotor", pytest.param("boxes", marks=pytest.mark.slow)])
def test_freed_slots_are_taken_by_waiting_problems(batch: str, solver: str) -> None:
    problem, U0 = BATCHES[batch]()
    problem.x0[4, 0] = torch.nan  # a waiting problem that cannot start
    seen = []
    few = SOLVERS[solver].in_slots(2).solve(problem, U0, seed=3, callback=lambda p: seen.append(p))
    assert seen[-1].finished == seen[-1].total == 7
    seen = [p for p in seen if p.candidates is None and p.state is not None]  # of the outer loop
    assert max(p.state.rows.numel() for p in seen) == 2
    assert max(len(set(p.rows.tolist())) for p in seen) == max(p.rows.numel() for p in seen) == 2
    assert {b for p in seen for b in p.rows.tolist()} == set(KEPT.tolist())
    assert_same_bits(few.take(KEPT), SOLVERS[solver].solve(problem, U0, seed=3).take(KEPT))
    assert few.statuses[4] == Status.NON_FINITE


KEPT = torch.tensor([0, 1, 2, 3, 5, 6])


def solve_rows(solver, problem: Problem, U0, rows: list[int]) -> Solution:
    index = torch.tensor(rows)
    return solver.solve(problem.take(index), U0[index], seed=3, ids=index)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("batch", BATCHES)
def test_alone_in_any_batch_and_in_any_order(batch: str, solver: str) -> None:
    check_alone_in_any_batch_and_in_any_order(batch, solver)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("native", ["eager"], indirect=True)
@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "restarts"])
@pytest.mark.parametrize(
    "batch", ["planar", *(pytest.param(b, marks=pytest.mark.slow) for b in ("quadrotor", "boxes"))]
)
def test_eager_kernels_keep_the_contract(batch: str, solver: str, native: bool) -> None:
    check_alone_in_any_batch_and_in_any_order(batch, solver)


def check_alone_in_any_batch_and_in_any_order(batch: str, solver: str) -> None:
    problem, U0 = BATCHES[batch]()
    together = SOLVERS[solver].solve(problem, U0, seed=3)
    if solver != "mppi":
        assert len(set(together.iterations.tolist())) > 1  # they end at different times: compaction is at work
        assert bool((together.guided > 0).any())
    for rows in ([4], [0], [5, 2], [6, 5, 4, 3, 2, 1, 0]):
        part = solve_rows(SOLVERS[solver], problem, U0, rows)
        assert_same_bits(part, together.take(torch.tensor(rows)))


def test_two_threads_keep_the_contract() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        problem, U0 = BATCHES["planar"]()
        together = SOLVERS["gco"].solve(problem, U0, seed=3)
        assert_same_bits(solve_rows(SOLVERS["gco"], problem, U0, [4]), together.take(torch.tensor([4])))
    finally:
        torch.set_num_threads(before)


def test_large_batch_equals_small_ones() -> None:
    problem, U0 = planar_batch(B=5, N=12, obstacles=6, seed=1)
    rows = torch.arange(300) % 5
    solver = AugmentedLagrangian(inner=ILQR(max_iterations=4), max_outer_iterations=2)
    large = solver.solve(problem.take(rows), U0[rows])
    small = solver.solve(problem, U0)
    for name in FIELDS:
        assert torch.equal(getattr(large, name), getattr(small, name)[rows]), name


def test_parts_per_problem_follow_their_problem() -> None:
    """Goals, weights, drag, bounds and moving obstacles per problem: parts of the batch solve to the same bits."""
    B, N = 4, 20
    random = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random, dtype=torch.float64)

    goal = torch.zeros(B, N + 1, 6, dtype=torch.float64)
    goal[..., :2] = draw(B, 1, 2) + 0.01 * draw(B, N + 1, 2)
    Q = torch.diag_embed(1 + draw(B, N, 6)) + 0.1
    bound = 5 + 5 * draw(B, 2)
    problem = Problem(
        Planar(dt=0.1, drag=8 + 4 * draw(B)),
        QuadraticCost(Q=Q, R=[0.1, 0.1], Qf=torch.diag_embed(10 + draw(B, 6)), x_ref=goal),
        [
            Spheres(draw(B, 3, 2), 0.05 + 0.05 * draw(B, 3), 0.02 * draw(B), 0.2 * draw(B, 3, 2)),
            ControlBounds(-bound, bound),
        ],
        torch.cat((-draw(B, 2) - 0.3, torch.zeros(B, 4, dtype=torch.float64)), dim=-1),
        N,
    )
    U0 = torch.zeros(B, N, 2, dtype=torch.float64)
    solver = SOLVERS["gco"]
    together = solver.solve(problem, U0, seed=3)
    for rows in ([2], [3, 1]):
        assert_same_bits(solve_rows(solver, problem, U0, rows), together.take(torch.tensor(rows)))


def test_a_broken_problem_disturbs_no_other() -> None:
    problem, U0 = BATCHES["planar"]()
    healthy = SOLVERS["gco"].solve(problem, U0, seed=3)
    x0 = problem.x0.clone()
    x0[1] = torch.nan
    x0[3, :2] = problem.constraints[0].centers[3, 0]  # inside an obstacle
    x0[5, 3] = 1e200  # overflows on the way
    broken = Problem(problem.dynamics, problem.cost, problem.constraints, x0, problem.N)
    solution = SOLVERS["gco"].solve(broken, U0, seed=3)
    assert solution.statuses[1] == Status.NON_FINITE
    assert solution.statuses[3] == Status.INVALID_START
    assert solution.statuses[5] == Status.NON_FINITE
    rest = torch.tensor([0, 2, 4, 6])
    assert_same_bits(solution.take(rest), healthy.take(rest))


def test_first_step_consistency_holds_per_problem() -> None:
    """The rates after one period are what each vehicle's own thrusts allow (section 5.2.1)."""
    problem, U0 = quadrotor_batch(B=3, N=15)
    thrusts = torch.tensor([[3.9, 3.9, 3.9, 3.9], [3.8, 4.0, 4.0, 3.8], [3.9, 3.9, 4.1, 4.1]], dtype=torch.float64)
    first = FirstStepRates(thrusts, period=0.1)
    problem = Problem(QuadrotorPlanning(dt=0.1), problem.cost, [*problem.constraints, first], problem.x0, problem.N)
    solver = AugmentedLagrangian(inner=ILQR(tolerance=1e-6), max_outer_iterations=12, violation_tolerance=1e-5)
    solution = solver.solve(problem, U0)
    torch.testing.assert_close(solution.X[:, 1, 10:13], problem.constraints[2].target, rtol=0, atol=1e-4)
    alone = solver.solve(problem.take(torch.tensor([1])), U0[[1]])
    assert torch.equal(alone.X[0], solution.X[1])
