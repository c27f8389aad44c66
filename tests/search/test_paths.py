"""Proposals along paths: they lead to the goal, report where there is none, and count their iterations."""

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest
import torch

from tests.problems import quadrotor_batch
from tests.search.cup import GOAL, QUICK, controls, cost, cup, cups
from tests.search.rows import proposed, varied
from torchgco import (
    ControlBounds,
    Field,
    Goal,
    InputError,
    PathProposals,
    Planar,
    Problem,
    QuadraticCost,
    Roadmap,
    judge,
    presets,
    solve,
)
from torchgco.dynamics.rollout import open_loop
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.maps import OccupancyGrid
from torchgco.native.cuda.engine import OnDevice, working_on
from torchgco.roadmap.geometry import Inflated
from torchgco.roadmap.homotopy import classes
from torchgco.search import Follow, Refine
from torchgco.search.proposals import Part
from torchgco.solvers.ilqr import descend


def test_rows_that_fit_keep_the_steps_that_they_have_made() -> None:
    space, plane = (presets.gco(d).passes.paths for d in (3, 2))
    assert space.fitting(4) is space and plane.fitting(2) is plane
    assert plane.fitting(3).follow.initial_offsets == ()


def test_a_proposal_ends_near_the_goal_and_has_a_penalty() -> None:
    U, found, multipliers, *_ = proposed(varied(QUICK, iterations=20, max_penetration=0.5), cup())
    assert bool(found.all()) and bool((multipliers.mu > 0).all()) and bool(torch.isfinite(U).all())
    assert float(judge(cup(), U, GOAL, 0.3).goal_distance.max()) < 0.3


def test_a_proposal_scales_with_the_unit_of_cost() -> None:
    """With 100 times the cost a problem has the same proposal, and 100 times the penalty."""
    problem = cup(B=1)
    cents = replace(problem, cost=cost(unit=100.0))
    one, hundred = (proposed(varied(QUICK, iterations=1, relax_iterations=0), p) for p in (problem, cents))
    torch.testing.assert_close(hundred.multipliers.mu, 100 * one.multipliers.mu)
    torch.testing.assert_close(hundred.U, one.U, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "problem",
    [cup(closed=True), cup(velocities=np.zeros((2, 5, 2))), replace(cup(), constraints=())],
    ids=["no path", "moving", "no obstacles"],
)
def test_where_there_is_no_path_nothing_is_proposed(problem: Problem) -> None:
    U, found, multipliers, iterations, cost = proposed(QUICK, problem)
    assert not bool(found.any()) and U.shape == (2, 100, 2) and iterations.tolist() == [0, 0]
    assert bool(multipliers.mu.isnan().all()) and cost.tolist() == [math.inf] * 2


def test_no_problems_have_no_proposals() -> None:
    U, found, _, iterations, _ = proposed(QUICK, cup().take(torch.arange(0)))
    assert U.shape == (0, 100, 2) and found.shape == iterations.shape == (0,)


@contextmanager
def only(k: int) -> Iterator[None]:
    """Keep only the first path of class k."""

    def one(paths: torch.Tensor, obstacles: Inflated) -> torch.Tensor:
        label = classes(paths, obstacles)
        first = label == torch.arange(paths.shape[1])
        return torch.where(first & (first.cumsum(-1) == k + 1), label, -1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchgco.search.proposals.classes", one)
        yield


def alone(options: PathProposals, problem: Problem, k: int):
    with only(k):
        return proposed(options, problem)


def test_the_cheapest_relaxed_candidate_is_proposed() -> None:
    """There is a path on the left and one on the right; with both, the cheaper candidate is proposed."""
    problem, many = cup(B=1), replace(QUICK, num_paths=3)
    left, right, neither = (alone(many, problem, k) for k in range(3))
    assert [bool(p.found) for p in (left, right, neither)] == [True, True, False]
    both, merits = proposed(many, problem), []
    for proposal in (left, right, both):
        X = open_loop(problem.dynamics, problem.x0, proposal.U)
        assert float((X[0, -1, :2] - GOAL).norm()) < 0.5
        merits.append(float(Lagrangian(problem, both.multipliers, None, True).value(X, proposal.U)[1]))
    assert merits[0] != merits[1] and merits[2] == min(merits)


def test_chunks_change_no_result(monkeypatch) -> None:
    problem, two = cups(N=40), varied(QUICK, num_paths=2, iterations=2, relax_iterations=1)
    whole = proposed(two, problem)
    for size in ("proposals.PATHS_AT_ONCE", "candidates.CANDIDATES_AT_ONCE"):
        monkeypatch.setattr(f"torchgco.search.{size}", 4)
    parts = proposed(two, problem)
    assert torch.equal(whole.U, parts.U) and torch.equal(whole.found, parts.found)
    assert torch.equal(whole.multipliers.mu, parts.multipliers.mu) and torch.equal(whole.iterations, parts.iterations)


def test_paths_are_sought_ahead_where_a_device_solves(monkeypatch) -> None:
    """By another thread, with the same bits; errors in it are raised, and nothing is left behind."""
    problem, two = cups(N=40), varied(QUICK, num_paths=2, iterations=2, relax_iterations=1)
    whole, threads, sought = proposed(two, problem), set[str](), Part._sought

    def noted(part: Part, *words: Any) -> Any:
        threads.add(threading.current_thread().name)
        return sought(part, *words)

    monkeypatch.setattr("torchgco.search.proposals.PATHS_AT_ONCE", 2)
    monkeypatch.setattr(Part, "_sought", noted)
    proposed(two, problem)
    assert threads == {threading.main_thread().name}
    with working_on(OnDevice(lambda text: pytest.fail("nothing is compiled"), 10**9)):
        parts = proposed(two, problem)
        assert len(threads) == 2
        monkeypatch.setattr(Part, "_sought", lambda part, *words: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            proposed(two, problem)
    assert torch.equal(whole.U, parts.U) and torch.equal(whole.found, parts.found)
    assert torch.equal(whole.iterations, parts.iterations) and len(problem.x0) > 1


def test_a_proposal_is_the_same_in_every_batch() -> None:
    problem, two = cups(), varied(QUICK, num_paths=2, top=2)
    whole = proposed(two, problem)
    assert bool(whole.found.all())
    for rows in ([1], [2, 0], [2, 1, 0]):
        part, index = proposed(two, problem.take(torch.tensor(rows))), torch.tensor(rows)
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

    for place in ("torchgco.search.candidates.descend", "torchgco.search.candidates.AugmentedLagrangian.outer_loop"):
        monkeypatch.setattr(place, noted(resolve_name(place)))
    options = varied(QUICK, num_paths=3, initial_offsets=((0.7, -0.7),), relax_top=3, relax_iterations=4, top=2)
    problem = cups()
    together = proposed(options, problem)
    assert len(made) >= 4 and int(together.iterations.sum()) == sum(made) and bool(together.found.any())
    for b in range(3):
        made.clear()
        single = proposed(options, problem.take(torch.tensor([b])))
        assert int(single.iterations) == int(together.iterations[b]) == sum(made) > 0


def test_paths_of_one_class_are_tracked_once(monkeypatch) -> None:
    """The cup has two classes: of five paths two are tracked, from every start at each pace."""
    counts = []
    monkeypatch.setattr(
        "torchgco.search.candidates.descend",
        lambda inner, lagrangian, U: counts.append(lagrangian.problem.B) or descend(inner, lagrangian, U),
    )
    five = varied(QUICK, num_paths=5, stiffness=(20.0,), iterations=1, relax_iterations=1)
    for offsets, arrive, rows in (
        ((), 0.8, 2),
        (((0.7, -0.7), (-0.7, 0.7)), 0.8, 6),
        (((0.7, -0.7),), (0.8, 0.6, 0.7), 12),
    ):
        counts.clear()
        proposed(varied(five, initial_offsets=offsets, arrive=arrive), cup(B=1, N=60))
        assert counts[:2] == [rows, rows]


def test_an_offset_turns_the_vehicle_before_it_departs() -> None:
    """Offsets are shares of the distance from rest to the bound on their side, or of 1 where there is none."""
    problem, starts_of = cup(B=3, N=40), Follow(initial_offsets=((0.75, -0.5), (0.0, 0.25))).starts
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
    with pytest.raises(InputError, match=r"follow\.initial_offsets: expected shape \(1, 2\)"):
        proposed(varied(QUICK, initial_offsets=((1.0,),)), cup())


BASE = PathProposals(
    num_paths=2, follow=(Follow(depart=0.1, arrive=0.8, iterations=8, initial_offsets=((-0.7, 0.7),)),),
    max_penetration=1.0, refine=Refine(top=2, rounds=3, violation=0.1),
)  # fmt: skip
# Another value for every field; for `when` and `max_gap`, which say where rows apply, see test_passes.
PASS = dict(
    roadmaps=(Roadmap(num_halton=8),), num_paths=1, follow=(Follow(),), relax_iterations=2, relax_top=1,
    refine=Refine(), max_penetration=1e-3,
)  # fmt: skip
FOLLOW = dict(
    initial_offsets=((0.7, -0.7),), depart=0.2, arrive=(0.7,), smoothing=0.2, tube=None, stiffness=(50.0,),
    iterations=2, pace=0.5, obstacles=50.0,
)  # fmt: skip
REFINE = dict(top=1, rounds=1, violation=1e-9, cut=1e-9, needed=True)
CONSTANTS = {
    "candidates.CANDIDATE_TOLERANCE": 0.5, "proposals.CANDIDATE_PENALTY": 5.0, "following.OFFSET_LASTS": 0.3,
}  # fmt: skip


def outcome(options: PathProposals) -> list[tuple]:
    """In 100 steps no refined candidate counts, in 120 one does."""
    found = [proposed(options, cup(B=1, N=N)) for N in (100, 120)]
    return [(p.U.tolist(), p.found.tolist(), p.multipliers.mu.tolist(), int(p.iterations)) for p in found]


@pytest.fixture(scope="module")
def usual() -> list[tuple]:
    return outcome(BASE)


@pytest.mark.parametrize("name", PASS)
def test_every_option_is_read(name: str, usual: list[tuple]) -> None:
    assert outcome(replace(BASE, **{name: PASS[name]})) != usual


@pytest.mark.parametrize("name", FOLLOW)
def test_every_option_of_following_is_read(name: str, usual: list[tuple]) -> None:
    assert outcome(varied(BASE, **{name: FOLLOW[name]})) != usual


@pytest.mark.parametrize("name", REFINE)
def test_every_option_of_refining_is_read(name: str, usual: list[tuple]) -> None:
    assert outcome(replace(BASE, refine=replace(BASE.refine, **{name: REFINE[name]}))) != usual


def test_no_option_is_forgotten_above() -> None:
    assert {f.name for f in fields(PathProposals)} == {*PASS, "when", "max_gap"}
    assert {f.name for f in fields(Follow)} == set(FOLLOW)
    assert {f.name for f in fields(Refine)} == set(REFINE)


@pytest.mark.parametrize("name", CONSTANTS)
def test_every_constant_is_read(name: str, usual: list[tuple], monkeypatch) -> None:
    monkeypatch.setattr(f"torchgco.search.{name}", CONSTANTS[name])
    assert outcome(BASE) != usual


@pytest.mark.slow
def test_walls_between_rest_and_the_path_dont_bar_the_way() -> None:
    """A flat of 12 x 8 m whose walls join the outer ones: one class, and a path around two corners."""
    walls = np.zeros((120, 80), bool)
    walls[[0, -1]], walls[:, [0, -1]] = True, True
    walls[40:42, 29:], walls[80:82, :50], walls[80:101, 49:51] = True, True, True
    weights = QuadraticCost([5, 5, 0, 1, 1, 0], [0.1, 0.1], [50, 50, 0, 1, 1, 0], x_ref=[11, 4, 0, 0, 0, 0])
    x0 = torch.tensor([[1.0, 4.0, 0, 0, 0, 0]], dtype=torch.float64)
    parts = [Field(OccupancyGrid(walls, [0.0, 0.0], 0.1), 0.15), ControlBounds(-10, 10)]
    problem = Problem(Planar(dt=0.05), weights, parts, x0, 400, Goal([11.0, 4.0], 0.2))
    assert bool(judge(problem, solve(problem).U).reached)


def test_a_quadrotor_is_guided_too() -> None:
    problem, _ = quadrotor_batch(B=2, N=60)
    U = proposed(PathProposals(follow=(Follow(smoothing=0.16),)), problem).U
    verdict = judge(problem, U, problem.cost.goal(problem.x0)[:, :3], 2.0)
    assert float(verdict.goal_distance.max()) < 2.0


def test_lists_of_a_configuration_equal_tuples() -> None:
    lists = Follow(arrive=[0.8, 0.6], stiffness=[20.0], initial_offsets=[[0.7, -0.7]])
    assert lists == Follow(arrive=(0.8, 0.6), stiffness=(20.0,), initial_offsets=((0.7, -0.7),))
    assert hash(lists) == hash(replace(lists)) and lists.paces == (0.8, 0.6) and QUICK.follow[0].paces == (0.8,)
    rows = PathProposals(roadmaps=[Roadmap()], follow=[lists])
    assert rows == PathProposals(roadmaps=(Roadmap(),), follow=(lists,)) and hash(rows) == hash(replace(rows))


@pytest.mark.parametrize(
    ("make", "change", "field"),
    [
        (PathProposals, dict(when="late"), "proposals.when"),
        (PathProposals, dict(roadmaps={"num_halton": 64}), "proposals.roadmaps"),
        (PathProposals, dict(roadmaps=({"num_halton": 64},)), "proposals.roadmaps"),
        (PathProposals, dict(roadmaps=()), "proposals.roadmaps"),
        (PathProposals, dict(roadmaps=(), when="far"), "proposals.roadmaps"),
        (PathProposals, dict(follow=()), "proposals.follow"), (PathProposals, dict(follow=(0.9,)), "proposals.follow"),
        (PathProposals, dict(max_penetration=0.0), "proposals.max_penetration"),
        (PathProposals, dict(max_gap=0.0), "proposals.max_gap"),
        (PathProposals, dict(num_paths=0), "proposals.num_paths"),
        (PathProposals, dict(relax_iterations=-1), "proposals.relax_iterations"),
        (PathProposals, dict(relax_top=0), "proposals.relax_top"),
        (PathProposals, dict(refine=8), "proposals.refine"),
        (Follow, dict(depart=0.9), "follow.depart"), (Follow, dict(depart=-0.1), "follow.depart"),
        (Follow, dict(arrive=1.1), "follow.depart"), (Follow, dict(arrive=(0.5, 1.1)), "follow.depart"),
        (Follow, dict(arrive=()), "follow.depart"), (Follow, dict(arrive="late"), "follow.arrive"),
        (Follow, dict(smoothing=1.0), "follow.smoothing"), (Follow, dict(smoothing=-0.1), "follow.smoothing"),
        (Follow, dict(tube=0.0), "follow.tube"), (Follow, dict(pace=0.0), "follow.pace"),
        (Follow, dict(stiffness=()), "follow.stiffness"), (Follow, dict(stiffness=(0.0,)), "follow.stiffness"),
        (Follow, dict(iterations=0), "follow.iterations"),
        (Follow, dict(initial_offsets=7), "follow.initial_offsets"),
        (Follow, dict(initial_offsets=[["left", "right"]]), "follow.initial_offsets"),
        (Refine, dict(top=0), "refine.top"), (Refine, dict(rounds=0), "refine.rounds"),
        (Refine, dict(violation=0.0), "refine.violation"), (Refine, dict(cut=0.0), "refine.cut"),
        (Refine, dict(needed="no"), "refine.needed"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(make: type, change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field.replace(".", r"\.")) as caught:
        make(**change)
    assert len(str(caught.value).splitlines()) == 1
