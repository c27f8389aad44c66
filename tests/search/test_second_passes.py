"""Where a first pass isn't enough: more paths for costly proposals, and samples only where a whole solve fails."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.search.rows import proposed, varied, without
from torchgco import ControlBounds, PathProposals, Problem, Restarts, Status, compose, presets
from torchgco.dynamics.rollout import open_loop
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.roadmap.geometry import has_paths
from torchgco.search import Converge, Follow, Timed
from torchgco.search.following import Paths, followed
from torchgco.search.proposals import Part, Proposal, propose
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian
from torchgco.solvers.caught import StopWhenCaught
from torchgco.solvers.ilqr import ILQR, descend
from torchgco.solvers.interior import InteriorPoint

LAYOUTS = 4


@pytest.fixture(scope="module")
def woods() -> Problem:
    """Some problems that a vehicle crosses almost straight, and some with long detours."""
    setup = compose(["scenario=woods", "scenario.density=0.2", "scenario.stages=160", "seed=1"])
    return setup.task(setup.layouts(LAYOUTS)).problem


ROWS = [one for one in presets.gco(3).passes.steps if isinstance(one, PathProposals)]
FIRST, COSTLY, CLOSER = (replace(one, num_paths=one.num_paths // 2) for one in ROWS[:3])


def costly(gap: float) -> list[PathProposals]:
    """The rows of the first round, where a proposal may cost this much more than without constraints, as a share."""
    return [FIRST, replace(COSTLY, max_gap=gap), CLOSER]


def noted(passes: Sequence[PathProposals], problem: Problem) -> tuple[Proposal, list[tuple[int, int, bool]]]:
    """The proposals, and of each time that paths were followed, of how many paths and problems, and whether closer."""
    times, along = [], PathProposals._along

    def note(self: PathProposals, part: Part, rows: Tensor, problem, paths: Paths, follow: Follow, *words) -> Proposal:
        times.append((paths.corners.shape[1], problem.B, follow.smoothing < FIRST.follow[0].smoothing))
        return along(self, part, rows, problem, paths, follow, *words)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PathProposals, "_along", note)
        return propose(passes, problem), times


def gaps(problem: Problem, U: Tensor) -> Tensor:
    """How much more than without constraints the controls U cost, as a share, (B,)."""
    lagrangian = Lagrangian(problem, Multipliers.zero(problem, 0.0), None, True)
    rest = problem.cost.rest_controls(torch.zeros_like(U))
    free, _ = descend(ILQR(tolerance=1e-9, max_iterations=100), lagrangian, rest)
    return problem.cost.total(open_loop(problem.dynamics, problem.x0, U), U) / free.cost - 1


@pytest.mark.slow
def test_costly_proposals_are_compared_with_those_along_more_paths(woods) -> None:
    once, times = noted([FIRST, replace(CLOSER, refine=FIRST.refine)], woods)
    assert times == [(3, LAYOUTS, False)] and bool(once.found.all())
    gap = gaps(woods, once.U)
    limit = float(gap.sort().values[1:3].mean())  # two of four problems cost more
    twice, times = noted(costly(limit), woods)
    both = 2 * 6  # paths of two searches
    assert times == [(3, LAYOUTS, False), (both, 2, False), (both, 2, True)]
    cheap = gap <= limit
    assert torch.equal(twice.U[cheap], once.U[cheap]) and bool((twice.U[~cheap] != once.U[~cheap]).any())
    assert bool((twice.iterations[~cheap] > once.iterations[~cheap] + 50).all())
    # The new proposals are refined, which removes contacts at some cost; those with a cheaper path are cheaper.
    assert bool((gaps(woods, twice.U) < gap + 0.05).all())


@pytest.mark.slow
def test_a_candidate_that_is_too_deep_counts_where_refining_mends_it(woods) -> None:
    shallow = replace(FIRST, max_penetration=1e-9)
    some, times = noted([shallow, CLOSER], woods)
    again = times[1][1]
    assert times == [(3, LAYOUTS, False), *len(CLOSER.follow) * [(3, again, True)]] and again > 0
    X = open_loop(woods.dynamics, woods.x0, some.U)
    depth = torch.stack([c.worst(X, some.U) for c in woods.geometric]).amax(0)
    refined = some.cost.isfinite()
    assert bool(refined.any()) and torch.equal(refined, some.found) and bool((depth[refined] < 1e-2 + 1e-9).all())
    torch.testing.assert_close(woods.cost.total(X, some.U)[refined], some.cost[refined])
    few, _ = noted([shallow, replace(CLOSER, refine=FIRST.refine, max_penetration=1e-9)], woods)  # nothing is refined
    assert bool((some.found & ~few.found).any())


def test_a_proposal_within_the_gap_keeps_its_bits(woods) -> None:
    once, _ = noted([FIRST, CLOSER], woods)
    same, times = noted(costly(100.0), woods)
    assert torch.equal(once.U, same.U) and len(times) == 1


def test_no_path_is_followed_more_slowly_than_the_pace(woods, monkeypatch) -> None:
    """The time without constraints, measured here as it is defined, times the stretch of each path, is the limit."""
    seen, first = [], []
    monkeypatch.setattr("torchgco.search.following.followed", lambda *words: seen.append(words) or followed(*words))
    for pace in (None, 1.2, 0.9):
        seen.clear()
        proposed(varied(FIRST, pace=pace, arrive=0.9), woods)
        first.append(seen[0])
    (path, _, slow, *_), (_, _, limited, *_), (_, _, fast, *_) = first
    assert bool((slow == 0.9).all())
    lagrangian = Lagrangian(woods, Multipliers.zero(woods, 0.0), None, True)
    rest = woods.cost.rest_controls(torch.zeros(LAYOUTS, woods.N, woods.m, dtype=torch.float64))
    X = descend(ILQR(tolerance=1e-9, max_iterations=100), lagrangian, rest)[0].X
    left = (X[..., :3] - woods.goal.position.unsqueeze(1)).norm(dim=-1)
    share = (left > 0.1 * left[:, :1]).sum(-1).double() / woods.N
    stretch = path.diff(dim=1).norm(dim=-1).sum(-1) / (path[:, 0] - path[:, -1]).norm(dim=-1)
    for found, pace in ((limited, 1.2), (fast, 0.9)):
        expected = torch.minimum(slow, pace * share.repeat_interleave(FIRST.num_paths) * stretch)
        torch.testing.assert_close(found, expected, atol=1.5 / woods.N, rtol=0)
    assert bool((fast < limited).all())


@pytest.mark.slow
def test_costly_problems_in_small_parts_keep_their_bits(woods, monkeypatch) -> None:
    whole, times = noted(costly(1e-9), woods)
    monkeypatch.setattr("torchgco.search.proposals.PATHS_AT_ONCE", 2 * FIRST.num_paths)
    parts, more = noted(costly(1e-9), woods)
    assert [size for _, size, _ in times] == [4, 4, 4] and [size for _, size, _ in more] == [2, 2, *[1] * 8]
    assert torch.equal(parts.U, whole.U) and torch.equal(parts.iterations, whole.iterations)


def test_the_gap_depends_on_no_other_problem(woods) -> None:
    whole = propose(costly(0.15), woods)
    index = torch.tensor([2, 0])
    part = propose(costly(0.15), woods.take(index))
    assert torch.equal(part.U, whole.U[index]) and torch.equal(part.iterations, whole.iterations[index])


@pytest.mark.slow
def test_among_moving_obstacles_the_first_solve_runs_to_its_end(monkeypatch) -> None:
    """Problems that arrive have the bits of the local solve; the others are solved again, stopped and sampled."""
    setup = compose(["scenario=crossing", "scenario.num_obstacles=30", "seed=3"])
    layouts = setup.layouts(8)
    task = setup.task(layouts)
    problem, U0 = task.problem, task.U0
    solver = without(presets.gco(3), Converge)
    assert not has_paths(problem) and isinstance(solver, Restarts)
    local = replace(solver.local, max_outer_iterations=10)  # too few for some
    unguided = replace(local, guidance=None)
    guides, iterate = [], AugmentedLagrangian.outer_loop

    def note(self, call, guidance=None, *words, **more):
        guides.append((type(guidance), call.problem.B))
        return iterate(self, call, guidance, *words, **more)

    monkeypatch.setattr(AugmentedLagrangian, "outer_loop", note)
    alone = unguided.solve(problem, U0)
    guides.clear()
    found = replace(solver, local=local).solve(problem, U0)
    arrived = (alone.violation <= local.violation_tolerance) & (
        (alone.X[:, -1, :3] - task.goal).norm(dim=-1) < task.goal_radius
    )
    left = int((~arrived).sum())
    assert guides[0] == (type(None), 8) and guides[1] == (StopWhenCaught, left) and 0 < left < 8
    assert bool((found.cost[arrived] <= alone.cost[arrived]).all())  # ways in space and time may be cheaper
    assert bool((found.iterations[~arrived] > alone.iterations[~arrived]).all())


@pytest.mark.slow
def test_a_converged_solve_is_enough_where_the_goal_is_assumed() -> None:
    """With x_ref beyond the horizon no solve arrives; a goal that is given is still sought by further attempts."""
    setup = compose(["scenario=crossing", "scenario.stages=30"])
    problem = setup.task(setup.layouts(2)).problem
    given, assumed = problem, replace(problem, goal=None)
    assert assumed.goal is not None and assumed.goal.assumed
    solver = without(presets.gco(3), Converge, Timed)  # which asks what the trajectory would cost without obstacles
    U0 = problem.cost.rest_controls(torch.zeros(2, problem.N, problem.m, dtype=torch.float64))
    alone = replace(solver.local, guidance=None).solve(assumed, U0)
    assert alone.statuses == [Status.CONVERGED] * 2 and float(assumed.goal.distance(alone.X[:, -1, :3]).min()) > 2
    assert torch.equal(solver.solve(assumed, U0).iterations, alone.iterations)
    assert bool((solver.solve(given, U0).iterations > alone.iterations).all())


@pytest.mark.slow
def test_what_the_bounds_on_controls_cost_is_no_reason_for_more_paths(woods) -> None:
    """A vehicle that can hardly tilt takes long without trunks, too."""
    rest = woods.cost.rest_controls(woods.x0.new_zeros(woods.B, woods.N, woods.m))
    half = 0.04 * (woods.control_bounds.upper - woods.control_bounds.lower)[:1, :1]
    weak = ControlBounds(rest[:1, 0] - half[0], rest[:1, 0] + half[0])
    tight = replace(woods, constraints=[*woods.obstacles, weak])
    bare = replace(woods, constraints=[weak])
    limited = InteriorPoint(tolerance=1e-8).solve(bare, rest)
    assert bool((limited.violation <= 1e-6).all())
    part = Part(tight, rest, torch.arange(tight.B), None)
    torch.testing.assert_close(part.limited(torch.tensor([2, 0])), limited.cost[[2, 0]], rtol=1e-3, atol=0)
    assert (part.proposal.iterations > 0).tolist() == [True, False, True, False]
    assert part.limited(torch.tensor([], dtype=torch.int64)).shape == (0,)
    unbounded = Part(replace(woods, constraints=woods.obstacles), rest, torch.arange(woods.B), None)
    assert bool(torch.isinf(unbounded.limited(torch.tensor([1]))).all())
    once, _ = noted([FIRST], tight)
    cost = tight.cost.total(open_loop(tight.dynamics, tight.x0, once.U), once.U)
    over, free = cost / limited.cost - 1, gaps(tight, once.U)
    assert bool((free > over + 0.05).all())
    limit = float((over.max() + free.min()) / 2) if bool(over.max() < free.min()) else float(over.max()) + 1e-3
    assert bool((free > limit).any())
    _, times = noted([FIRST, replace(COSTLY, max_gap=limit)], tight)
    assert times == [(3, LAYOUTS, False)]
