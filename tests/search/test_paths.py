"""Proposals along paths: they lead to the goal, report where there is none, and count their iterations."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pkgutil import resolve_name

import numpy as np
import pytest
import torch

from tests.problems import quadrotor_batch
from tests.search.cup import GOAL, QUICK, controls, cost, cup, cups
from torchgco import ControlBounds, InputError, PathProposals, Problem, Roadmap, judge
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.lagrangian.rollout import open_loop
from torchgco.roadmap.geometry import Inflated
from torchgco.roadmap.homotopy import one_per_class
from torchgco.solvers.ilqr import descend


def test_a_proposal_ends_near_the_goal_and_has_a_penalty() -> None:
    U, found, multipliers, *_ = replace(QUICK, track_iterations=20, max_penetration=0.5).propose(cup())
    assert bool(found.all()) and bool((multipliers.mu > 0).all()) and bool(torch.isfinite(U).all())
    assert float(judge(cup(), U, GOAL, 0.3).goal_distance.max()) < 0.3


def test_a_proposal_scales_with_the_unit_of_cost() -> None:
    """With 100 times the cost a problem has the same proposal, and 100 times the penalty."""
    problem = cup(B=1)
    cents = replace(problem, cost=cost(unit=100.0))
    one, hundred = (replace(QUICK, track_iterations=1, relax_iterations=0).propose(p) for p in (problem, cents))
    torch.testing.assert_close(hundred.multipliers.mu, 100 * one.multipliers.mu)
    torch.testing.assert_close(hundred.U, one.U, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "problem",
    [cup(closed=True), cup(velocities=np.zeros((2, 5, 2))), replace(cup(), constraints=())],
    ids=["no path", "moving", "no obstacles"],
)
def test_where_there_is_no_path_nothing_is_proposed(problem: Problem) -> None:
    U, found, multipliers, iterations, cost = QUICK.propose(problem)
    assert not bool(found.any()) and U.shape == (2, 100, 2) and iterations.tolist() == [0, 0]
    assert bool(multipliers.mu.isnan().all()) and cost.tolist() == [math.inf] * 2


def test_no_problems_have_no_proposals() -> None:
    U, found, _, iterations, _ = QUICK.propose(cup().take(torch.arange(0)))
    assert U.shape == (0, 100, 2) and found.shape == iterations.shape == (0,)


@contextmanager
def only(k: int) -> Iterator[None]:
    """Keep only the first path of class k."""

    def one(paths: torch.Tensor, obstacles: Inflated) -> torch.Tensor:
        first = one_per_class(paths, obstacles)
        return first & (first.cumsum(-1) == k + 1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchgco.search.paths.one_per_class", one)
        yield


def alone(options: PathProposals, problem: Problem, k: int):
    with only(k):
        return options.propose(problem)


def test_the_cheapest_relaxed_candidate_is_proposed() -> None:
    """There is a path on the left and one on the right; with both, the cheaper candidate is proposed."""
    problem, many = cup(B=1), replace(QUICK, num_paths=3)
    left, right, neither = (alone(many, problem, k) for k in range(3))
    assert [bool(p.found) for p in (left, right, neither)] == [True, True, False]
    both, merits = many.propose(problem), []
    for proposal in (left, right, both):
        X = open_loop(problem.dynamics, problem.x0, proposal.U)
        assert float((X[0, -1, :2] - GOAL).norm()) < 0.5
        merits.append(float(Lagrangian(problem, both.multipliers, None, True).value(X, proposal.U)[1]))
    assert merits[0] != merits[1] and merits[2] == min(merits)


def test_chunks_change_no_result(monkeypatch) -> None:
    problem, two = cups(N=40), replace(QUICK, num_paths=2, track_iterations=2, relax_iterations=1)
    whole = two.propose(problem)
    for size in ("paths.MOST", "candidates.AT_ONCE"):
        monkeypatch.setattr(f"torchgco.search.{size}", 4)
    parts = two.propose(problem)
    assert torch.equal(whole.U, parts.U) and torch.equal(whole.found, parts.found)
    assert torch.equal(whole.multipliers.mu, parts.multipliers.mu) and torch.equal(whole.iterations, parts.iterations)


def test_a_proposal_is_the_same_in_every_batch() -> None:
    problem, two = cups(), replace(QUICK, num_paths=2, refine_top=2)
    whole = two.propose(problem)
    assert bool(whole.found.all())
    for rows in ([1], [2, 0], [2, 1, 0]):
        part, index = two.propose(problem.take(torch.tensor(rows))), torch.tensor(rows)
        assert torch.equal(part.U, whole.U[index]) and torch.equal(part.iterations, whole.iterations[index])
        for lam, expected in zip(part.multipliers.lam, whole.multipliers.lam, strict=True):
            assert torch.equal(lam, expected[index])


def test_the_iterations_of_every_candidate_are_counted(monkeypatch) -> None:
    """The iterations of all candidates, tracked, relaxed and refined, equal the sum over their solves."""
    made = []

    def noted(solve):
        def call(*args, **options):
            end = solve(*args, **options)
            made.append(int((end[0] if isinstance(end, tuple) else end).iterations.sum()))
            return end

        return call

    for place in ("torchgco.search.candidates.descend", "torchgco.search.candidates.AugmentedLagrangian.solve"):
        monkeypatch.setattr(place, noted(resolve_name(place)))
    options = replace(QUICK, num_paths=3, initial_offsets=((0.7, -0.7),), relax_top=3, relax_iterations=4, refine_top=2)
    problem = cups()
    together = options.propose(problem)
    assert len(made) == 4 and int(together.iterations.sum()) == sum(made) and bool(together.found.any())
    for b in range(3):
        made.clear()
        single = options.propose(problem.take(torch.tensor([b])))
        assert int(single.iterations) == int(together.iterations[b]) == sum(made) > 0


def test_paths_of_one_class_are_tracked_once(monkeypatch) -> None:
    """The cup has two classes: of five paths two are tracked, from every start at each pace."""
    counts = []
    monkeypatch.setattr(
        "torchgco.search.candidates.descend",
        lambda inner, lagrangian, U: counts.append(lagrangian.problem.B) or descend(inner, lagrangian, U),
    )
    five = replace(QUICK, num_paths=5, stiffness=(20.0,), track_iterations=1, relax_iterations=1)
    for offsets, arrive, rows in (
        ((), 0.8, 2),
        (((0.7, -0.7), (-0.7, 0.7)), 0.8, 6),
        (((0.7, -0.7),), (0.8, 0.6, 0.7), 12),
    ):
        counts.clear()
        replace(five, initial_offsets=offsets, arrive=arrive).propose(cup(B=1, N=60))
        assert counts[:2] == [rows, rows]


def test_an_offset_turns_the_vehicle_before_it_departs() -> None:
    """Offsets are shares of the distance from rest to the bound on their side, or of 1 where there is none."""
    problem, starts_of = cup(B=3, N=40), replace(QUICK, initial_offsets=((0.75, -0.5), (0.0, 0.25))).starts
    limits = ControlBounds([[-10.0, -4.0], [-10.0, -4.0], [-10.0, -torch.inf]], [10.0, 10.0])
    problem = Problem(problem.dynamics, problem.cost, [problem.constraints[0], limits], problem.x0, problem.N)
    starts = starts_of(problem, controls(problem))
    assert starts.shape == (3, 3, 40, 2) and not bool(starts[:, 0].any()) and not bool(starts[:, :, 4:].any())
    assert starts[0, 1, 3].tolist() == [7.5, -2.0] and starts[0, 2, 0].tolist() == [0.0, 2.5]
    assert starts[2, 1, 3].tolist() == [7.5, -0.5]
    off_centre = starts_of(problem, controls(problem) + 2.0)  # rest lies nearer to the upper bounds
    assert off_centre[0, 1, 3].tolist() == [8.0, -1.0]
    free = Problem(problem.dynamics, problem.cost, [problem.constraints[0]], problem.x0, problem.N)
    assert starts_of(free, controls(free))[0, 1, 3].tolist() == [0.75, -0.5]
    with pytest.raises(InputError, match=r"paths\.initial_offsets: expected shape \(1, 2\)"):
        replace(QUICK, initial_offsets=((1.0,),)).propose(cup())


# Another value for every option.
CHANGES = dict(
    roadmap=Roadmap(num_halton=8), num_paths=1, initial_offsets=((0.7, -0.7),), depart=0.2, arrive=(0.7,),
    smoothing=0.2, tube=None, stiffness=(50.0,), track_iterations=2, relax_iterations=2, relax_top=1, refine_top=2,
    max_penetration=1e-3, pace=0.5, max_gap=1e-3,
)  # fmt: skip
CONSTANTS = {
    "paths.TOLERANCE": 0.5, "paths.TRACK_PENALTY": 50.0, "paths.PENALTY": 5.0,
    "paths.OFFSET_LASTS": 0.3,
}  # fmt: skip
BASE = PathProposals(
    num_paths=2, depart=0.1, arrive=0.8, track_iterations=3, initial_offsets=((-0.7, 0.7),), max_penetration=1.0
)


def outcome(options: PathProposals) -> tuple:
    proposal = options.propose(cup(B=1))
    return proposal.U.tolist(), proposal.found.tolist(), proposal.multipliers.mu.tolist(), int(proposal.iterations)


@pytest.fixture(scope="module")
def usual() -> tuple:
    return outcome(BASE)


@pytest.mark.parametrize("name", CHANGES)
def test_every_option_is_read(name: str, usual: tuple) -> None:
    assert outcome(replace(BASE, **{name: CHANGES[name]})) != usual


def test_no_option_is_forgotten_above() -> None:
    assert {f.name for f in fields(PathProposals)} == set(CHANGES)


@pytest.mark.parametrize("name", CONSTANTS)
def test_every_constant_is_read(name: str, usual: tuple, monkeypatch) -> None:
    monkeypatch.setattr(f"torchgco.search.{name}", CONSTANTS[name])
    assert outcome(BASE) != usual


def test_a_quadrotor_is_guided_too() -> None:
    problem, _ = quadrotor_batch(B=2, N=60)
    U = PathProposals(smoothing=0.16).propose(problem).U
    verdict = judge(problem, U, problem.cost.goal(problem.x0)[:, :3], 2.0)
    assert float(verdict.goal_distance.max()) < 2.0


def test_lists_of_a_configuration_equal_tuples() -> None:
    lists = PathProposals(arrive=[0.8, 0.6], stiffness=[20.0], initial_offsets=[[0.7, -0.7]])
    assert lists == PathProposals(arrive=(0.8, 0.6), stiffness=(20.0,), initial_offsets=((0.7, -0.7),))
    assert hash(lists) == hash(replace(lists)) and lists.paces == (0.8, 0.6) and QUICK.paces == (0.8,)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (dict(roadmap={"num_halton": 64}), "paths.roadmap"),
        (dict(depart=0.9), "paths.depart"), (dict(depart=-0.1), "paths.depart"), (dict(arrive=1.1), "paths.depart"),
        (dict(arrive=(0.5, 1.1)), "paths.depart"), (dict(arrive=()), "paths.depart"),
        (dict(smoothing=1.0), "paths.smoothing"), (dict(smoothing=-0.1), "paths.smoothing"),
        (dict(tube=0.0), "paths.tube"), (dict(max_penetration=0.0), "paths.max_penetration"),
        (dict(max_gap=0.0), "paths.max_gap"), (dict(pace=0.0), "paths.pace"), (dict(stiffness=()), "paths.stiffness"),
        (dict(stiffness=(0.0,)), "paths.stiffness"),
        (dict(num_paths=0), "paths.num_paths"), (dict(track_iterations=0), "paths.track_iterations"),
        (dict(relax_iterations=-1), "paths.relax_iterations"), (dict(relax_top=0), "paths.relax_top"),
        (dict(refine_top=0), "paths.refine_top"), (dict(initial_offsets=7), "paths.initial_offsets"),
        (dict(initial_offsets=[["left", "right"]]), "paths.initial_offsets"), (dict(arrive="late"), "paths.arrive"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field.replace(".", r"\.")):
        PathProposals(**change)
