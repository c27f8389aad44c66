"""Many guesses: the best is kept, the budget is kept to, and an element's guesses are its own."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from tests.problems import planar_batch
from torchgco import GCO, ILQR, AugmentedLagrangian, InputError
from torchgco.baselines import MultiStart
from torchgco.guidance import Detour
from torchgco.lagrangian import is_better

LOCAL = AugmentedLagrangian(inner=ILQR(max_iterations=4), max_outer_iterations=3, clip=True)
MANY = MultiStart(solver=LOCAL, starts=4, covariance=9.0, knots=5, arrival=0.2)


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


def test_an_element_has_its_own_guesses_whatever_its_company() -> None:
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


def test_the_budget_counts_the_candidates_of_every_start_too(monkeypatch) -> None:
    """No start begins with the budget spent, and none is left out while it isn't, told from the solves themselves."""
    made: dict[int, list[int]] = {b: [] for b in range(4)}
    solve = AugmentedLagrangian.solve

    def noted(self, problem, U0, seed=0, ids=None, *rest, **options):
        end = solve(self, problem, U0, seed, ids, *rest, **options)
        for b, count in zip([] if ids is None else ids.tolist(), end.iterations.tolist(), strict=False):
            made[b].append(count)
        return end

    problem, U0 = planar_batch(B=4, N=25, obstacles=9, seed=4)
    problem.x0[2, :2] = problem.constraints[0].centers[2, 0]  # inside an obstacle: no guess helps
    monkeypatch.setattr(AugmentedLagrangian, "solve", noted)
    guided = replace(LOCAL, guidance=GCO(detour=Detour(iterations=4, settle=2, depth=9.0), patience=1))
    budget = 100
    solution = MultiStart(guided, starts=50, budget=budget, covariance=9.0, knots=5).solve(problem, U0)
    assert solution.iterations.tolist() == [sum(made[b]) for b in range(4)] and made[2] == [0]
    for b in (0, 1, 3):
        assert sum(made[b][:-1]) < budget <= sum(made[b])
        assert len(made[b]) > 1
    assert max(max(starts) for starts in made.values()) > 3 * 4  # more than the loop of one start can make alone


def test_progress_names_problems_by_their_place_in_the_whole_batch() -> None:
    problem, U0 = planar_batch(B=4, N=25, obstacles=8, seed=2)
    first, seen = LOCAL.solve(problem, U0), []
    budget = int(first.iterations.max())
    replace(MANY, budget=budget, starts=2).solve(problem, U0, callback=lambda p: seen.append(set(p.rows.tolist())))
    left = set((first.iterations < budget).nonzero().flatten().tolist())
    again = seen[int(first.outer_iterations.max()) :]
    assert left and set.union(*again) == left != {0, 1, 2, 3}


@pytest.mark.parametrize(
    "change", [dict(covariance=1.0), dict(covariance=[9.0, 1.0]), dict(knots=3), dict(solver=ILQR)]
)
def test_every_option_is_read(change: dict) -> None:
    problem, U0 = planar_batch(B=4, N=25, obstacles=8, seed=2)
    if "solver" in change:
        change = dict(solver=replace(LOCAL, inner=ILQR(max_iterations=2)))
    one, other = (m.solve(problem, U0) for m in (MANY, replace(MANY, **change)))
    assert not torch.equal(one.U, other.U)


def test_one_that_arrives_is_worth_more_than_a_cheaper_one() -> None:
    """With a goal a hand's breadth wide, nothing counts as arrived, and the cheaper path is kept."""
    problem, U0 = planar_batch(B=8, N=25, obstacles=10, seed=7)
    near, far = (replace(MANY, arrival=share).solve(problem, U0) for share in (1e-9, 0.999))
    fits = (near.violation <= LOCAL.violation_tolerance) & (far.violation <= LOCAL.violation_tolerance)
    assert bool((near.cost <= far.cost)[fits].all())


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (dict(starts=0), "multistart.starts"), (dict(knots=1), "multistart.knots"),
        (dict(budget=0), "multistart.budget"), (dict(arrival=1.0), "multistart.arrival"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field.replace(".", r"\.")):
        MultiStart(**change)


@pytest.mark.parametrize("covariance", [-1.0, [1.0, 1.0, 1.0], "wide"])
def test_a_covariance_that_fits_nothing_is_named(covariance) -> None:
    problem, U0 = planar_batch(B=1, N=10)
    with pytest.raises(InputError, match=r"multistart\.covariance"):
        replace(MANY, covariance=covariance).solve(problem, U0)
