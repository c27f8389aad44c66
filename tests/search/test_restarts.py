"""Restarts: where a trajectory is caught further passes follow, the best is kept, and all are counted."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from tests.problems import assert_same_bits, planar_batch
from tests.search.cup import GOAL, controls, cup
from tests.search.gates import (
    CLOSED,
    FREE,
    LOCAL,
    PASSES,
    PATHS,
    SAMPLING,
    SHORT,
    SOLVER,
    Solve,
    gates,
)
from tests.search.rows import proposed, restarts, thorough
from torchgco import (
    GCO,
    ILQR,
    AugmentedLagrangian,
    PathProposals,
    Problem,
    Restarts,
    Solution,
    Spheres,
    Status,
    judge,
)
from torchgco.base.status import STOPPED
from torchgco.lagrangian.penalties import GuideRegion
from torchgco.lagrangian.quality import has_arrived
from torchgco.search import Follow, FromSamples
from torchgco.search.proposals import Round
from torchgco.search.steps import ATTEMPT_SEED_STEP
from torchgco.solvers.caught import StopWhenCaught
from torchgco.solvers.contracts import Call


def arrived(solve: Solve) -> Tensor:
    best = solve.end.best
    return (best.violation <= LOCAL.violation_tolerance) & has_arrived(solve.call.problem, best.X)


def rank(solve: Solve, place: int) -> tuple:
    """Sort key of a result: arrived, then feasible, then cheap; of infeasible ones the less violated."""
    best, fits = solve.end.best, bool(solve.end.best.violation[place] <= LOCAL.violation_tolerance)
    return not bool(arrived(solve)[place]), not fits, float((best.cost if fits else best.violation)[place])


def test_sampled_attempts_start_from_the_caught_trajectory_and_the_best_is_kept(solves: list[Solve]) -> None:
    problem, U0 = gates()
    solution = restarts(LOCAL, None, SAMPLING, attempts=3, every=True).solve(problem, U0, seed=5)
    first, attempts = solves[0], solves[1:4]
    assert isinstance(first.guidance, StopWhenCaught) and torch.equal(first.call.U0, U0)
    assert (first.end.status == STOPPED).tolist() == [False, True, True, True]
    for k, attempt in enumerate(attempts):
        assert attempt.rows == [PASSES, SHORT, CLOSED] and isinstance(attempt.guidance, GCO)
        assert attempt.call.seed == 5 + k * ATTEMPT_SEED_STEP and attempt.call.ids.tolist() == attempt.rows
        assert torch.equal(attempt.call.U0, first.end.last.U[1:])
        assert torch.equal(attempt.call.warm.mu, first.end.last.multipliers.mu[1:])
    for b in (PASSES, SHORT, CLOSED):
        found = [(rank(s, s.rows.index(b)), s.end.best.U[s.rows.index(b)]) for s in solves if b in s.rows]
        best = min(found, key=lambda pair: pair[0])
        assert torch.equal(solution.U[b], best[1]) and len({key for key, _ in found}) > 2


@pytest.mark.parametrize("every", [False, True])
def test_arriving_ends_the_attempts_unless_all_are_wanted(every: bool, solves: list[Solve]) -> None:
    problem, U0 = gates()
    restarts(LOCAL, None, SAMPLING, attempts=3, every=every).solve(problem, U0)
    expected = [PASSES, SHORT, CLOSED]
    for attempt in solves[1:4]:
        assert attempt.rows == expected
        expected = [b for b, there in zip(expected, arrived(attempt).tolist(), strict=True) if every or not there]
    assert (PASSES in expected) == every


def test_the_first_attempt_is_along_a_path_without_guidance(solves: list[Solve]) -> None:
    problem, U0 = gates()
    SOLVER.solve(problem, U0, seed=3)
    caught, along, attracted, sampled, again = solves
    proposal = proposed(PATHS, problem.in_cost_units())
    assert proposal.found.tolist() == [True, True, True, False]
    assert along.rows == [PASSES, SHORT] and along.guidance is along.penalty is None
    assert torch.equal(along.call.U0, proposal.U[1:3])
    before = caught.end.last.multipliers.mu[1:3]
    assert torch.equal(along.call.warm.mu, torch.maximum(proposal.multipliers.mu[1:3], before))
    assert not any(bool(lam.any()) for lam in along.call.warm.lam)
    # The attempt of SHORT ends close to the goal, and is attracted to it.
    assert attracted.rows == [SHORT] and attracted.penalty is not None
    # Without a path the first attempt is sampled. A second, sampled one follows where the first does not arrive.
    assert sampled.rows == [CLOSED] and again.rows == [CLOSED]
    assert [s.call.seed for s in (sampled, again)] == [3, 3 + ATTEMPT_SEED_STEP]


def test_where_the_first_path_fails_the_best_of_more_candidates_is_proposed(solves: list[Solve]) -> None:
    """The optimum of SHORT ends far from the goal for this weight; CLOSED has no path."""
    problem, U0 = gates(1.0)
    SOLVER.solve(problem, U0, seed=3)
    caught, along, better, sampled, again = solves
    assert (along.rows, better.rows, sampled.rows) == ([PASSES, SHORT], [SHORT], [CLOSED])
    assert again.rows == [SHORT, CLOSED] and torch.equal(again.call.U0, caught.end.last.U[[SHORT, CLOSED]])
    more = proposed(thorough(PATHS), problem.in_cost_units().take(torch.tensor([SHORT, CLOSED])))
    assert more.found.tolist() == [True, False]
    assert torch.equal(better.call.U0, more.U[:1]) and better.guidance is better.penalty is None
    solves.clear()
    restarts(LOCAL, PATHS, SAMPLING, attempts=1).solve(problem, U0, seed=3)
    assert [s.rows for s in solves[1:]] == [[PASSES, SHORT], [CLOSED]]


def test_without_a_path_and_without_samples_the_stopped_solve_continues(solves: list[Solve]) -> None:
    """All proposals penetrate deeper than `max_penetration`; their candidates' iterations still count."""
    problem, U0 = gates()
    problem, U0 = problem.take(torch.tensor([PASSES])), U0[:1]
    caught = LOCAL.outer_loop(Call.checked(problem, U0).in_cost_units()[0], StopWhenCaught(None))
    shallow = replace(PATHS, max_penetration=1e-9)
    proposal, more = proposed(shallow, problem), proposed(thorough(shallow), problem)
    solution = restarts(LOCAL, shallow).solve(problem, U0)
    assert caught.status.tolist() == [STOPPED] and not bool(proposal.found | more.found)
    assert int(solution.guided) == 0
    assert torch.equal(solves[-1].call.U0, caught.last.U)
    counts = caught.iterations + proposal.iterations + more.iterations + solves[-1].end.iterations
    assert torch.equal(solution.iterations, counts) and int(solves[-1].end.iterations) > 0


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("weight", "attracted"), [(1.0, False), (6.0, True), (100.0, False)])
def test_a_trajectory_that_ends_close_to_the_goal_is_finally_attracted_to_it(
    weight: float, attracted: bool, solves: list[Solve], monkeypatch
) -> None:
    """The optimum ends far from the goal (unchanged), slightly short of it (attracted), or at it (unchanged)."""
    problem, U0 = gates(weight)
    solution = SOLVER.solve(problem, U0)
    pulled = [s for s in solves if s.penalty is not None]
    assert len(pulled) == attracted
    monkeypatch.setattr("torchgco.search.search.ATTRACTED_WITHIN", 0.0)
    plain = SOLVER.solve(problem, U0)
    away, optimal = ((s.X[:, -1, :2] - torch.tensor([10.0, 0.0])).norm(dim=-1) for s in (solution, plain))
    assert bool(away[SHORT] < 0.9 < optimal[SHORT]) == attracted
    others = torch.tensor([FREE, PASSES, CLOSED])
    assert torch.equal(solution.U[others], plain.U[others])
    if attracted:
        (last,) = pulled
        assert last.rows == [SHORT] and last.guidance is None and isinstance(last.penalty, GuideRegion)
        assert torch.isfinite(last.penalty.radius).nonzero().tolist() == [[0, 40]]  # at the last knot alone
        assert away[SHORT] > 0.8 and solution.cost[SHORT] < 1.05 * plain.cost[SHORT]
        assert solution.statuses[SHORT] == Status.FEASIBLE  # the optimum lies elsewhere


def test_a_problem_that_is_never_caught_has_the_bits_of_the_local_solve() -> None:
    problem, U0 = gates()
    solution, plain = SOLVER.solve(problem, U0), LOCAL.solve(problem, U0)
    index = torch.tensor([FREE])
    assert_same_bits(solution.take(index), plain.take(index))
    free = replace(problem, constraints=problem.constraints[1:])
    assert_same_bits(SOLVER.solve(free, U0), LOCAL.solve(free, U0))


def test_counts_are_those_of_all_attempts_and_candidates(solves: list[Solve], monkeypatch) -> None:
    made, result = [], Round.result
    monkeypatch.setattr(Round, "result", lambda self: made.append(result(self)) or made[-1])
    problem, U0 = gates()
    solution = SOLVER.solve(problem, U0)
    expected = torch.zeros(3, 4, dtype=torch.int64)
    for s in solves:
        expected[:, s.call.rows] += torch.stack((s.end.iterations, s.end.outer, s.end.guided))
        if s.guidance is None and s.penalty is None:
            expected[2, s.call.rows] += 1  # along a path
    assert len(made) == 2 and int(made[0].iterations.min()) == 0 < int(made[0].iterations[:2].min())
    expected[0, PASSES:] += made[0].iterations
    expected[0, CLOSED:] += made[1].iterations
    assert torch.equal(torch.stack((solution.iterations, solution.outer_iterations, solution.guided)), expected)
    assert solution.guided[FREE] == 0 and solution.guided[PASSES] == 1 < int(solution.guided[CLOSED])


def test_restarts_lead_around_a_trap_that_catches_the_solver() -> None:
    problem = cup(B=1, N=120)
    local = AugmentedLagrangian(ILQR(tolerance=1e-2, max_iterations=20), max_outer_iterations=12)
    solver = restarts(local, PathProposals(follow=(Follow(depart=0.1, arrive=0.8),)), SAMPLING, attempts=1)
    stays, passes = (judge(problem, s.solve(problem, controls(problem)).U, GOAL, 0.3) for s in (local, solver))
    assert not bool(stays.reached) and bool(passes.reached)


CHANGES = dict(
    local=replace(SOLVER.local, initial_penalty=1.0),
    passes=SOLVER.passes[:2],
)


@pytest.mark.parametrize("name", CHANGES)
def test_every_option_is_read(name: str, whole: Solution) -> None:
    other = replace(SOLVER, **{name: CHANGES[name]}).solve(*gates(), seed=3)
    assert not (torch.equal(other.U, whole.U) and torch.equal(other.iterations, whole.iterations))


def test_no_option_is_forgotten_above() -> None:
    assert {f.name for f in fields(Restarts)} == {
        *CHANGES,
        "interior",
    }  # see also test_passes


def test_a_single_contact_counts_as_caught_from_the_given_iteration(solves: list[Solve]) -> None:
    problem, U0 = planar_batch(B=1, N=60, obstacles=1, seed=1)
    problem = replace(problem, constraints=[Spheres([[[0.0, 0.2]]], [[0.2]], 0.1), problem.constraints[1]])
    counts = []
    for after in (1, 2, None):
        solves.clear()
        restarts(LOCAL, None, SAMPLING, attempts=1, after=after).solve(problem, U0)
        counts.append((int(solves[0].end.status) == STOPPED, int(solves[0].end.outer), len(solves)))
    assert counts[:2] == [(True, 1, 2), (True, 2, 2)] and counts[2][0] is False and counts[2][2] == 1


@pytest.mark.parametrize("every", [False, True])
def test_the_guidance_of_the_local_solver_serves_passes_from_samples_alone(every: bool, solves: list[Solve]) -> None:
    restarts(LOCAL, PATHS, SAMPLING, attempts=3, every=every).solve(*gates())
    guides = [type(s.guidance) for s in solves]
    assert guides[0] is StopWhenCaught and guides.count(StopWhenCaught) == 1 and guides.count(GCO) == 3
    other = replace(SAMPLING, initial_penalty=9.0)
    no_samples = tuple(one for one in SOLVER.passes if not isinstance(one, FromSamples))
    with_it, without = (Restarts(replace(LOCAL, guidance=g), no_samples).solve(*gates()) for g in (other, None))
    assert_same_bits(with_it, without)


def test_a_caught_problem_without_a_path_or_samples_is_solved_to_its_end() -> None:
    """Among moving spheres there is no roadmap: the stopped solve continues without a proposal."""
    problem, U0 = planar_batch(B=4, N=40, obstacles=8, seed=4)
    spheres = problem.constraints[0]
    centers = spheres.centers.masked_fill(spheres.absent.unsqueeze(-1), torch.nan)
    radii = (spheres.inflated_radii - 0.06).masked_fill(spheres.absent, torch.nan)
    moving = Spheres(centers, radii, 0.06, velocities=torch.full_like(centers, 1e-9))
    problem = Problem(problem.dynamics, problem.cost, [moving, *problem.constraints[1:]], problem.x0, problem.N)
    local = AugmentedLagrangian(ILQR(max_iterations=10), initial_penalty=0.1, max_outer_iterations=12)
    scaled, _ = Call.checked(problem, U0).in_cost_units()
    stopped, reports = local.outer_loop(scaled, StopWhenCaught(None)), []
    assert bool((stopped.status == STOPPED).any())
    end = restarts(local, PathProposals()).solve(problem, U0, callback=reports.append)
    assert reports[-1].finished == problem.B
    caught = stopped.status == STOPPED
    assert bool((end.iterations[caught] > stopped.iterations[caught]).all())
    assert bool((end.violation[caught] < stopped.last.violation[caught]).all())
