"""From paths to trajectories: candidates track paths, are relaxed where that helps, and refined to convergence."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.reference import boxes as brute_force
from tests.search.cup import GOAL, QUICK, controls, cost, cup
from tests.search.rows import proposed, restarts, varied
from tests.search.scenes import NONE, inflated
from tests.search.test_paths import alone
from torchgco import (
    AugmentedLagrangian,
    PathProposals,
    Problem,
    StateBounds,
    compose,
    judge,
)
from torchgco.base.tree import take
from torchgco.dynamics.rollout import open_loop
from torchgco.obstacles.base import Obstacles
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.roadmap.geometry import scene_of
from torchgco.search.candidates import Candidates
from torchgco.search.following import CORNER_DEPTH, Free, Paths, followed, travel, unconstrained
from torchgco.search.nearby import without_obstacles
from torchgco.search.proposals import propose
from torchgco.solvers.ilqr import ILQR

END = torch.tensor([0.7], dtype=torch.float64)


def test_the_vehicle_rests_first_and_last() -> None:
    path = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 1.0]]], dtype=torch.float64)
    center = travel(path, 0.2, END, 0.0, 100)[0]
    assert torch.equal(center[:21], path[0, :1].expand(21, -1)) and torch.equal(
        center[70:], path[0, -1:].expand(31, -1)
    )
    assert float((center[1:] - center[:-1]).square().sum(-1).sqrt().max()) < 1.6 * 2.0 / 50
    rounded = travel(path, 0.2, END, 0.1, 100)[0]
    corner = torch.tensor([1.0, 0.0], dtype=torch.float64)
    assert float((center - corner).norm(dim=-1).min()) < 0.03 < float((rounded - corner).norm(dim=-1).min())


def test_a_spring_is_followed_in_fewer_iterations_than_a_tube(monkeypatch) -> None:
    monkeypatch.setattr("torchgco.search.following.ROUNDS", 1)
    problem, off = cup(B=1, N=120), []
    for tube, stiffness in ((0.05, 20.0), (None, 500.0)):
        follow = replace(QUICK.follow[0], tube=tube, stiffness=(stiffness,), iterations=4)
        path = torch.tensor([[[-1.0, 0.0], [0.0, -0.9], [1.0, 0.4]]], dtype=torch.float64)
        at_rest = make_candidates(problem, controls(problem)[:, None])
        candidates = follow.track(at_rest, known(problem, path[:, None]), None)
        X = open_loop(problem.dynamics, problem.x0, candidates.U)
        torch.testing.assert_close(candidates.X, X)
        center = travel(path, follow.depart, END + 0.1, follow.smoothing, 120)
        off.append(float((X[..., :2] - center).norm(dim=-1).mean()))
    assert off[1] < 0.5 * off[0]


def test_only_a_candidate_far_from_the_goal_takes_more_rounds(monkeypatch) -> None:
    """Of two candidates, the one whose path doesn't lead to the goal goes on; the other has the bits of one round."""
    problem, follow = cup(B=1, N=120), replace(QUICK.follow[0], stiffness=(20.0,), iterations=20)
    paths = torch.tensor([[[-1.0, 0.0], [0.0, -0.9], [1.0, 0.4]], [[-1.0, 0.0], [-0.9, 0.0], [-0.8, 0.0]]])
    at_rest = make_candidates(problem, controls(problem)[:, None].expand(-1, 2, -1, -1))
    ends = []
    for rounds in (1, 5):
        monkeypatch.setattr("torchgco.search.following.ROUNDS", rounds)
        ends.append(follow.track(at_rest, known(problem, paths[None].double()), None))
    once, often = ends
    assert once.arrive.tolist() == [True, False] and often.live.all()
    assert torch.equal(once.X[0], often.X[0]) and not torch.equal(once.X[1], often.X[1])
    assert int(once.iterations) < int(often.iterations)


def make_candidates(problem: Problem, U: torch.Tensor) -> Candidates:
    """Live candidates with controls U (1, count, N, m), and the radius and unit of the cup."""
    R, unit = torch.full((1,), 0.2, dtype=torch.float64), torch.full((1,), 1e4, dtype=torch.float64)
    return Candidates.begin(problem, U, R, unit, torch.ones(1, U.shape[1], dtype=torch.bool))


def known(problem: Problem, paths: torch.Tensor) -> Paths:
    """Paths (1, K, P, 2) that are all followed, in the units of `make_candidates`, without obstacles to cut."""
    R, unit = torch.full((1,), 0.2, dtype=torch.float64), torch.full((1,), 1e4, dtype=torch.float64)
    none = inflated([[[0.0, 0.0]]], [[NONE]])
    every = torch.arange(paths.shape[1]).expand(paths.shape[:2])
    return Paths(paths, every, torch.ones(paths.shape[:2], dtype=torch.bool), R, unit, none)


def test_every_candidate_tracks_its_own_path_at_its_own_pace() -> None:
    """Two paths, each from two starts at two paces: eight candidates; paces vary fastest."""
    problem = cup(B=1, N=120)
    follow = replace(QUICK.follow[0], arrive=(0.9, 0.5), tube=None, stiffness=(1e4,), iterations=20)
    ends = (-1.0, 0.0), (1.0, 0.4)
    paths = torch.tensor([[[ends[0], (0.0, y), ends[1]] for y in (-0.9, 1.2)]], dtype=torch.float64)
    starts = controls(problem)[:, None].repeat(1, 8, 1, 1)
    found = follow.track(make_candidates(problem, starts), known(problem, paths), None)
    for i, X in enumerate(found.X):
        apart = []
        for path in paths[0]:
            for pace in follow.paces:
                arrive = torch.full_like(END, pace)
                center = travel(path[None], follow.depart, arrive, follow.smoothing, 120)[0]
                apart.append(float((X[:, :2] - center).norm(dim=-1).mean()))
        assert apart.index(min(apart)) == i // 4 * 2 + i % 2


def limited(speed: float, N: int = 120) -> Problem:
    """Cups for vehicles with limits of +-speed, m/s, on both parts of the velocity."""
    problem = cup(B=2, N=N)
    bound = [np.inf, np.inf, np.inf, speed, speed, np.inf]
    return replace(problem, constraints=[*problem.constraints, StateBounds([-b for b in bound], bound)])


def free(problem: Problem) -> Free:
    """The trajectories without obstacles, in the unit of `make_candidates`."""
    return unconstrained(problem, controls(problem), 40, torch.full((2,), 1e4, dtype=torch.float64))


def among(corners: torch.Tensor) -> Paths:
    """The paths (B, 1, P, 2) of `known`, for B problems."""
    one, B = known(cup(B=1), corners[:1]), corners.shape[0]
    none = inflated([[[0.0, 0.0]]] * B, [[NONE]] * B)
    R, unit, live = one.R.repeat(B), one.unit.repeat(B), one.live.repeat(B, 1)
    return replace(one, corners=corners, classes=one.classes.repeat(B, 1), obstacles=none, R=R, unit=unit, live=live)


def test_limits_on_speed_make_free_trajectories_slower() -> None:
    """A tenth of the way is left after at least 0.9 of its longer side over the speed."""
    fast, slow, plain = free(limited(50.0)), free(limited(0.5)), free(cup(N=120))
    assert torch.equal(fast.slower, torch.ones(2, dtype=torch.float64)) and torch.equal(fast.slower, plain.slower)
    for one in (fast, slow):
        torch.testing.assert_close(one.share, plain.share)
        torch.testing.assert_close(one.cost, plain.cost)
    least = (2.0 * 0.9 / 0.5) / (120 * 0.05)
    assert bool((slow.share * slow.slower >= 0.95 * least).all()) and bool(
        (slow.slower < 2.0 * least / slow.share).all()
    )


def test_paths_are_followed_as_slowly_as_limits_ask_for() -> None:
    """From departure on, by as much as without obstacles, but never beyond the end of the horizon."""
    problem = limited(0.5)
    follow = replace(QUICK.follow[0], depart=0.1, arrive=(0.3, 0.9), stiffness=(1.0,), iterations=1)
    paths = among(torch.tensor([[[-1.0, 0.0], [0.0, -0.9], [1.0, 0.4]]], dtype=torch.float64).repeat(2, 1, 1, 1))
    U = controls(problem)[:, None].repeat(1, 2, 1, 1)
    at_rest = Candidates.begin(problem, U, paths.R, paths.unit, torch.ones(2, 2, dtype=torch.bool))
    timed = follow.track(at_rest, paths, free(problem)._replace(slower=torch.tensor([1.5, 9.0], dtype=torch.float64)))
    for b, slower in enumerate((1.5, 9.0)):
        for k, arrive in enumerate(follow.paces):
            later = torch.tensor([min(0.1 + (arrive - 0.1) * slower, 1.0)], dtype=torch.float64)
            alone = replace(follow, arrive=float(later))
            torch.testing.assert_close(timed.X[2 * b + k], alone.track(at_rest, paths, None).X[2 * b + k])


def test_kinds_of_obstacles_that_must_stay_set_no_pace(monkeypatch) -> None:
    monkeypatch.setattr(BoundSpheres, "chosen", Obstacles.chosen)
    assert without_obstacles(limited(0.5)) is None and bool((free(limited(0.5)).slower == 1.0).all())


def test_candidates_that_are_not_among_the_first_are_not_relaxed(monkeypatch) -> None:
    relaxed, relax = [], PathProposals.relax

    def noted(self: PathProposals, candidates: Candidates):
        relaxed.append(candidates.live.numel())
        return relax(self, candidates)

    monkeypatch.setattr(PathProposals, "relax", noted)
    problem = cup(B=2, N=60)
    three = varied(QUICK, num_paths=3, iterations=2, relax_iterations=1, max_penetration=9.0)
    proposals = [propose([replace(three, relax_top=top)], problem) for top in (None, 9, 2)]
    assert relaxed == [6, 6, 4] and torch.equal(proposals[0].U, proposals[1].U)
    tracked = [propose([replace(three, relax_top=top, relax_iterations=0)], problem).U for top in (None, 1)]
    assert torch.equal(*tracked)


def test_a_candidate_that_falls_back_into_the_trap_is_not_relaxed() -> None:
    """With such expensive controls, waiting is cheaper: the candidate stays as it was tracked."""
    problem = replace(cup(B=1), cost=cost(controls=20.0))
    long = varied(QUICK, iterations=20, max_penetration=0.1)
    tracked, relaxed = (proposed(replace(long, relax_iterations=n), problem).U for n in (0, 20))
    assert torch.equal(tracked, relaxed)
    assert float(judge(problem, relaxed, GOAL, 0.3).goal_distance) < 0.3


def test_a_relaxed_candidate_is_cheaper() -> None:
    problem = cup(N=120)
    costs = [judge(problem, proposed(replace(QUICK, relax_iterations=n), problem).U, GOAL, 0.3).cost for n in (0, 3)]
    assert bool((costs[0] > costs[1]).all())


def test_a_candidate_deep_within_an_obstacle_is_rejected() -> None:
    problem = cup(B=1)
    proposals = [proposed(replace(QUICK, max_penetration=depth), problem) for depth in (1e-4, 1.0)]
    assert [bool(p.found) for p in proposals] == [False, True]
    assert not bool(proposals[0].multipliers.mu.isnan().any()) and int(proposals[0].iterations) > 0
    X = open_loop(problem.dynamics, problem.x0, proposals[1].U)
    assert float(problem.constraints[0].violation(X, proposals[1].U).max()) > 1e-4 * 0.2


def test_the_cheapest_refined_candidate_is_proposed_and_saves_the_solver_work() -> None:
    problem, four = cup(B=2, N=120), varied(QUICK, num_paths=4, iterations=20)
    relaxed, refined = (proposed(varied(four, top=n), problem) for n in (1, 3))
    verdicts = [judge(problem, proposal.U, GOAL, 0.3) for proposal in (relaxed, refined)]
    assert not bool(verdicts[0].reached.any()) and bool(verdicts[1].reached.all())
    for k in range(2):  # with paths on one side only
        other = judge(problem, alone(varied(four, top=3), problem, k).U, GOAL, 0.3)
        assert bool(other.reached.all()) and bool((verdicts[1].cost <= other.cost).all())
    assert not any(bool(lam.any()) for lam in relaxed.multipliers.lam) and bool(refined.multipliers.lam[0].any())
    local = AugmentedLagrangian(ILQR(tolerance=1e-2, max_iterations=20), max_outer_iterations=20)
    counts = []
    for top in (1, 3):
        solver = restarts(local, varied(four, top=top), attempts=1)
        counts.append(int(solver.solve(problem, controls(problem)).outer_iterations.sum()))
    assert counts[1] < counts[0]


def test_a_refined_candidate_that_cuts_through_an_obstacle_between_two_knots_is_rejected() -> None:
    """If all refined candidates are rejected, the best relaxed one is proposed."""
    problem, one = cup(B=1, N=120), varied(QUICK, num_paths=2, iterations=20, top=2)
    refined = proposed(one, problem)
    assert bool(refined.found) and bool(refined.multipliers.lam[0].any())
    rejected = proposed(replace(one, refine=replace(one.refine, cut=1e-9)), problem)
    assert torch.equal(rejected.U, proposed(varied(one, top=1), problem).U)
    assert not torch.equal(refined.U, rejected.U) and not any(bool(lam.any()) for lam in rejected.multipliers.lam)


def test_corners_are_averaged_less_where_the_average_would_cut_an_obstacle() -> None:
    corner = torch.tensor([[[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]]] * 2, dtype=torch.float64)
    spheres = inflated([[[0.0, 0.6]], [[0.0, -0.6]]], [[0.3], [0.3]])
    options = 0.0, END.expand(2), 0.5, 100
    centers = followed(corner, *options, spheres, torch.full((2,), 0.3, dtype=torch.float64))
    plain = travel(corner, *options)
    assert torch.equal(centers[1], plain[1])
    limit = torch.full((2,), CORNER_DEPTH * 0.3, dtype=torch.float64)
    assert [bool(spheres.deeper(points, limit)[0].any()) for points in (plain, centers)] == [True, False]


def test_every_path_is_averaged_as_it_is_alone() -> None:
    corner = torch.tensor([[[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0]], [[-1.0, 0.0], [0.0, 0.2], [1.0, 0.0]]]).double()
    path, R = corner[[0, 1, 1, 0, 0, 1]], torch.tensor([0.3, 0.3, 0.2]).double()
    spheres = inflated([[[0.0, 0.6]], [[0.0, -0.6]], [[0.1, 0.5]]], [[0.3], [0.3], [0.2]])
    options = 0.0, END.expand(6), 0.5, 100
    whole = followed(path, *options, spheres, R)
    assert not torch.equal(whole, travel(path, *options))
    for i in range(6):
        b = torch.tensor([i // 2])
        assert torch.equal(whole[i : i + 1], followed(path[i : i + 1], 0.0, END, 0.5, 100, take(spheres, b), R[b]))


def test_how_deep_points_lie_against_brute_force() -> None:
    setup = compose(["scenario=mazes", "scenario.walls=1", "study.layouts=2"])
    layouts = setup.layouts()
    task = setup.task(layouts)
    scene = scene_of(task.problem, task.U0)
    assert scene is not None and layouts.box_centers is not None and layouts.box_half_sizes is not None
    assert layouts.box_rotations is not None
    points = np.random.default_rng(3).uniform((3.0, -4.0, -3.0), (16.0, 6.0, 3.0), (2, 150, 3))
    limits = (0.0, 0.1, 0.3)
    found = [scene.obstacles.deeper(torch.as_tensor(points), torch.full((2,), at).double()) for at in limits]
    assert all(0 < int(deep.sum()) < 300 for deep in found)
    for b in range(2):
        boxes = list(zip(layouts.box_centers[b], layouts.box_half_sizes[b], layouts.box_rotations[b], strict=True))
        for i in range(150):
            nearest = min(brute_force.distance(points[b, i], *box, 0.36) for box in boxes)
            assert [bool(deep[b, i]) for deep in found] == [-nearest > at for at in limits]


@pytest.mark.slow
def test_a_path_through_doors_is_followed_closer_where_no_candidate_arrives() -> None:
    setup = compose(["scenario=mazes", "scenario.walls=2", "solver=gco", "study.layouts=4"])
    problem = setup.task(setup.layouts()).problem
    first, _, closer, _ = [one for one in setup.solver.passes.steps if isinstance(one, PathProposals)]
    close, once = propose([first, closer], problem), propose([first], problem)
    assert int(once.found.sum()) < int(close.found.sum())
    assert torch.equal(close.U[once.found], once.U[once.found])
