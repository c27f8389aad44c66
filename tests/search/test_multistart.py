"""MultiStart: the best solution is kept, the budget holds, and a problem's guesses do not depend on its batch."""

from dataclasses import fields, replace
from itertools import pairwise

import pytest
import torch

from tests.problems import planar_batch
from torchgco import GCO, ILQR, MPPI, AugmentedLagrangian, Goal, InputError, LineSearch, MultiStart, QuadraticCost
from torchgco.lagrangian.quality import has_arrived, is_better

LOCAL = AugmentedLagrangian(ILQR(max_iterations=4), max_outer_iterations=3)
MANY = MultiStart(LOCAL, starts=4, covariance=9.0, noise_knots=5)


def test_the_best_of_all_starts_is_kept() -> None:
    problem, U0 = planar_batch(B=4, N=25, obstacles=8, seed=2)
    results = [replace(MANY, starts=n).solve(problem, U0, seed=3) for n in (1, 2, 4)]
    alone = LOCAL.solve(problem, U0, seed=3)
    assert torch.equal(results[0].U, alone.U) and torch.equal(results[0].iterations, alone.iterations)
    for few, many in pairwise(results):
        assert bool((many.iterations > few.iterations).all())
        worse = is_better(few.cost, few.violation, many.cost, many.violation, LOCAL.violation_tolerance)
        assert not bool(worse.any())
    assert not torch.equal(results[0].U, results[2].U)


def test_a_problem_has_its_own_guesses_in_any_batch() -> None:
    problem, U0 = planar_batch(B=4, N=25, obstacles=8, seed=2)
    whole = MANY.solve(problem, U0, seed=1)
    rows = torch.tensor([3, 1])
    part = MANY.solve(problem.take(rows), U0[rows], seed=1, ids=rows)
    assert torch.equal(part.U, whole.U[rows]) and torch.equal(part.iterations, whole.iterations[rows])


def test_a_spent_budget_ends_the_starts() -> None:
    problem, U0 = planar_batch(B=3, N=25, obstacles=8, seed=2)
    first = LOCAL.solve(problem, U0)
    limit = int(first.iterations.min())
    bounded = replace(MANY, budget=limit).solve(problem, U0)
    spent = first.iterations >= limit
    assert bool(spent.any()) and torch.equal(bounded.iterations[spent], first.iterations[spent])
    generous = replace(MANY, budget=limit + 1).solve(problem, U0)
    assert bool((generous.iterations >= limit + 1).all())


def test_the_budget_counts_the_iterations_of_every_start(monkeypatch) -> None:
    """A start begins if and only if the iterations of the earlier solves are below the budget."""
    made: dict[int, list[int]] = {b: [] for b in range(4)}
    iterate = AugmentedLagrangian.outer_loop

    def noted(self, call, *rest, **options):
        end = iterate(self, call, *rest, **options)
        for b, count in zip(call.rows.tolist(), end.iterations.tolist(), strict=True):
            made[b].append(count)
        return end

    problem, U0 = planar_batch(B=4, N=25, obstacles=9, seed=4)
    problem.x0[2, :2] = problem.constraints[0].centers[2, 0]  # inside an obstacle: no guess helps
    monkeypatch.setattr(AugmentedLagrangian, "outer_loop", noted)
    guided = replace(LOCAL, guidance=GCO(MPPI(samples=8)))
    budget = 40
    solution = MultiStart(guided, starts=50, budget=budget, covariance=9.0, noise_knots=5).solve(problem, U0)
    assert solution.iterations.tolist() == [sum(made[b]) for b in range(4)] and made[2] == [0]
    assert bool((solution.guided > 0).any())
    for b in (0, 1, 3):
        assert sum(made[b][:-1]) < budget <= sum(made[b])
        assert len(made[b]) > 1


def test_progress_names_problems_by_their_place_in_the_whole_batch() -> None:
    problem, U0 = planar_batch(B=4, N=25, obstacles=8, seed=2)
    first, seen = LOCAL.solve(problem, U0), []
    budget = int(first.iterations.max())
    replace(MANY, budget=budget, starts=2).solve(problem, U0, callback=lambda p: seen.append(set(p.rows.tolist())))
    left = set((first.iterations < budget).nonzero().flatten().tolist())
    again = seen[int(first.outer_iterations.max()) :]
    assert left and set.union(*again) == left != {0, 1, 2, 3}


CHANGES = dict(
    local=replace(LOCAL, inner=ILQR(max_iterations=2)), starts=2, budget=13, covariance=[9.0, 1.0], noise_knots=3
)  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_every_option_is_read(name: str) -> None:
    problem, U0 = planar_batch(B=4, N=25, obstacles=8, seed=2)
    one, other = (m.solve(problem, U0) for m in (MANY, replace(MANY, **{name: CHANGES[name]})))
    assert not torch.equal(one.U, other.U)


def test_no_option_is_forgotten_above() -> None:
    assert {f.name for f in fields(MultiStart)} == set(CHANGES)


def test_an_arrived_trajectory_is_preferred_to_a_cheaper_one(monkeypatch) -> None:
    """No step is accepted, so that every guess stays as it is; that of the vehicle at rest is the cheapest."""
    problem, U0 = planar_batch(B=4, N=25, obstacles=3, seed=7)
    cost = QuadraticCost(Q=[1e-3] * 6, R=[5.0, 5.0], Qf=[1, 1, 0, 0, 0, 0], x_ref=[1, 0.4, 0, 0, 0, 0])
    problem = replace(problem, cost=cost, goal=Goal([1.0, 0.4], 1e3))
    monkeypatch.setattr(LineSearch, "ratio_min", 1e9)
    stays = replace(LOCAL, inner=ILQR(max_iterations=1))
    many = replace(MANY, local=replace(stays, violation_tolerance=10.0), starts=20)
    solutions = []
    for share in (1e-9, 0.9):
        monkeypatch.setattr("torchgco.lagrangian.quality.GOAL_TOLERANCE", share)
        solutions.append(many.solve(replace(problem), U0))  # another problem, of which nothing is known yet
    rests, arrives = solutions
    nearer = has_arrived(problem, arrives.X)
    assert not bool(rests.U.any()) and bool(nearer.any()) and bool((arrives.cost > rests.cost)[nearer].all())
    assert not bool(arrives.U[~nearer].any())


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (dict(starts=0), "multistart.starts"), (dict(noise_knots=1), "multistart.noise_knots"),
        (dict(budget=0), "multistart.budget"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field.replace(".", r"\.")):
        MultiStart(**change)


@pytest.mark.parametrize("covariance", [-1.0, [1.0, 1.0, 1.0], "wide"])
def test_a_malformed_covariance_is_named(covariance) -> None:
    problem, U0 = planar_batch(B=1, N=10)
    with pytest.raises(InputError, match=r"multistart\.covariance"):
        replace(MANY, covariance=covariance).solve(problem, U0)
