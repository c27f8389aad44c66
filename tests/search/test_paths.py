"""The geometric proposal: it leads to the goal, says where it can't, and is followed undisturbed."""

from dataclasses import replace
from pkgutil import resolve_name

import numpy as np
import pytest
import torch
from torchgco.guidance.detour import Proposal
from torchgco.guidance.plans import Plans
from torchgco.guidance.scene import depth_between
from torchgco.solvers.descent import descend

from tests.problems import planar_batch, quadrotor_batch
from torchgco import (
    GCO,
    ILQR,
    MPPI,
    AugmentedLagrangian,
    ControlBounds,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    Spheres,
    judge,
)
from torchgco.draws import DrawKey
from torchgco.guidance import Detour, Roadmap
from torchgco.lagrangian import Lagrangian, Multipliers
from torchgco.rollout import open_loop

QUICK = Detour(begin=0.1, end=0.8, iterations=8, depth=1.0)
END = torch.tensor([0.7], dtype=torch.float64)
GOAL = torch.tensor([1.0, 0.4], dtype=torch.float64)
WEIGHTS = [5, 5, 1e-8, 1, 1, 1e-8]


def cup(B: int = 2, N: int = 100, closed: bool = False, **spheres) -> Problem:
    """A wall of discs on the straight way, bent towards the vehicle; closed: all around its start."""
    if closed:
        angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        centers, radius = np.stack((-1 + 0.5 * np.cos(angle), 0.5 * np.sin(angle)), axis=-1), 0.08
    else:
        y = np.linspace(-0.35, 0.55, 5)
        centers, radius = np.stack((0.2 - 1.2 * (y - 0.1) ** 2, y), axis=-1), 0.14
    discs = Spheres(np.tile(centers, (B, 1, 1)), np.full((B, len(centers)), radius), 0.06, **spheres)
    return Problem(
        dynamics=Planar(dt=0.05),
        cost=QuadraticCost(Q=WEIGHTS, R=[0.1, 0.1], Qf=WEIGHTS, x_ref=[1, 0.4, 0, 0, 0, 0]),
        constraints=[discs, ControlBounds([-10, -10], [10, 10])],
        x0=torch.tensor([[-1.0, 0, 0, 0, 0, 0]], dtype=torch.float64).repeat(B, 1),
        N=N,
    )


def controls(problem: Problem) -> torch.Tensor:
    return torch.zeros(problem.B, problem.N, problem.m, dtype=torch.float64)


def test_it_leads_around_a_trap_that_catches_the_solver() -> None:
    problem = cup(B=1, N=120)
    alone = AugmentedLagrangian(
        inner=ILQR(tolerance=1e-2, max_iterations=20), max_outer_iterations=12, grow_when_feasible=False, clip=True
    )
    guided = replace(alone, guidance=GCO(detour=Detour(begin=0.1, end=0.8), patience=3), cost_tolerance=1e-3)
    stays, passes = (judge(problem, s.solve(problem, controls(problem)).U, GOAL, 0.3) for s in (alone, guided))
    assert not bool(stays.reached) and bool(passes.sound)


def test_a_plan_ends_near_the_goal_and_has_a_penalty() -> None:
    U, found, duals, _ = Detour(begin=0.1, end=0.8, depth=0.5).propose(cup())
    assert bool(found.all()) and bool((duals.mu > 0).all()) and bool(torch.isfinite(U).all())
    assert float(judge(cup(), U, GOAL, 0.3).goal_distance.max()) < 0.3


def test_units_are_the_problems_own() -> None:
    """A problem whose cost is counted in cents is led the same way, with penalties in cents."""
    problem = cup(B=1)
    cents = replace(problem, cost=QuadraticCost(
        Q=[100 * w for w in WEIGHTS], R=[10.0, 10.0], Qf=[100 * w for w in WEIGHTS], x_ref=[1, 0.4, 0, 0, 0, 0]
    ))  # fmt: skip
    one, hundred = (replace(QUICK, iterations=1, settle=0).propose(p) for p in (problem, cents))
    torch.testing.assert_close(hundred.duals.mu, 100 * one.duals.mu)
    torch.testing.assert_close(hundred.U, one.U, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "problem",
    [cup(closed=True), cup(velocities=np.zeros((2, 5, 2))), replace(cup(), constraints=())],
    ids=["no way", "moving", "no obstacles"],
)
def test_where_there_is_no_way_nothing_is_proposed(problem: Problem) -> None:
    U, found, _, iterations = QUICK.propose(problem)
    assert not bool(found.any()) and U.shape == (2, 100, 2) and iterations.tolist() == [0, 0]
    advice = GCO(detour=QUICK, sampler=MPPI(samples=4)).update(
        problem, torch.zeros(2, 101, 6, dtype=torch.float64), U,
        GCO().start(problem, torch.zeros(2, 101, 6, dtype=torch.float64)),
        DrawKey(0, torch.arange(2), torch.ones(2, dtype=torch.int64)),
    )  # fmt: skip
    assert not bool(advice.taken.any())


def test_the_vehicle_rests_first_and_last() -> None:
    way = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [1.0, 1.0]]], dtype=torch.float64)
    center = replace(QUICK, begin=0.2, end=0.7, smoothing=0.0)._travel(way, END, 100)[0]
    assert torch.equal(center[:21], way[0, :1].expand(21, -1)) and torch.equal(center[70:], way[0, -1:].expand(31, -1))
    assert float((center[1:] - center[:-1]).square().sum(-1).sqrt().max()) < 1.6 * 2.0 / 50
    rounded = replace(QUICK, begin=0.2, end=0.7, smoothing=0.1)._travel(way, END, 100)[0]
    corner = torch.tensor([1.0, 0.0], dtype=torch.float64)
    assert float((center - corner).norm(dim=-1).min()) < 0.03 < float((rounded - corner).norm(dim=-1).min())


class Turns(Detour):
    """Notes who asked, and finds nothing."""

    asked: list = []  # noqa: RUF012

    def propose(self, problem: Problem, rank: torch.Tensor | None = None) -> Proposal:
        self.asked.append(rank.tolist())
        U = controls(problem)
        none = torch.zeros(problem.B, dtype=torch.int64)
        return Proposal(U, none.bool(), Multipliers.zero(problem, 0.0), none)


@pytest.mark.parametrize(
    ("at", "detours", "ranks"), [(1, 1, [[0, 0]]), (2, 1, [[0]]), (4, 1, []), (1, 2, [[0, 1, 0]]), (2, 5, [[0, 1]])]
)
def test_some_attempts_are_detours(at: int, detours: int, ranks: list[list[int]]) -> None:
    problem, _ = planar_batch(B=4, N=25, obstacles=9, seed=4)
    X = problem.x0[:, None].repeat(1, 26, 1)
    X[:, 5:, :2] = torch.as_tensor(problem.geometric[0].centers[:, :1])  # in a disc: caught, at this patience
    guidance = GCO(detour=Turns(), detour_at=at, detours=detours, sampler=MPPI(samples=4), patience=0)
    key = DrawKey(0, torch.arange(4), torch.ones(4, dtype=torch.int64), None, torch.tensor([1, 2, 3, 1]))
    Turns.asked.clear()
    guidance.update(problem, X, controls(problem), guidance.start(problem, X), key)
    assert Turns.asked == ranks


def test_the_way_that_settles_best_is_kept_and_the_others_follow_by_rank() -> None:
    problem, many = cup(B=1), replace(QUICK, ways=3)
    plans = [many.propose(problem, torch.tensor([rank])) for rank in range(4)]
    assert torch.equal(plans[0].U, many.propose(problem).U)
    assert [bool(plan.found) for plan in plans] == [True, True, False, False]  # on the left or on the right
    duals = plans[0].duals
    paths = [open_loop(problem.dynamics, problem.x0, plan.U) for plan in plans[:2]]
    merits = [
        float(Lagrangian(problem, duals, None, True).value(X, p.U)[1]) for X, p in zip(paths, plans, strict=False)
    ]
    back = [float((X[0, -1, :2] - GOAL).norm()) > 0.5 for X in paths]
    ranked = list(zip(back, merits, strict=True))
    assert ranked == sorted(ranked) and len(set(merits)) > 1


def test_many_ways_are_followed_by_chunks_that_nobody_notices(monkeypatch) -> None:
    x0 = torch.tensor([[-1.0, y, 0, 0, 0, 0] for y in (-0.2, 0.0, 0.1)], dtype=torch.float64)
    problem, two = replace(cup(B=3, N=40), x0=x0), replace(QUICK, ways=2, iterations=2, settle=1)
    whole = two.propose(problem)
    for size in ("detour.MOST", "plans.AT_ONCE"):
        monkeypatch.setattr(f"torchgco.guidance.{size}", 4)
    parts = two.propose(problem)
    assert torch.equal(whole.U, parts.U) and torch.equal(whole.found, parts.found)
    assert torch.equal(whole.duals.mu, parts.duals.mu) and torch.equal(whole.iterations, parts.iterations)


class Settles(Detour):
    """Notes how many it settles."""

    settled: list = []  # noqa: RUF012

    def _settle(self, plans: Plans) -> tuple[Plans, torch.Tensor]:
        self.settled.append(plans.live.numel())
        return super()._settle(plans)


def test_ways_that_are_not_kept_are_not_settled() -> None:
    problem, three = cup(B=2, N=60), Settles(ways=3, iterations=2, settle=1, depth=9.0)
    plans = [replace(three, keep=keep).propose(problem) for keep in (None, 9, 2)]
    assert Settles.settled == [6, 6, 4] and torch.equal(plans[0].U, plans[1].U)
    assert not bool(replace(three, keep=2).propose(problem, torch.tensor([2, 2])).found.any())
    followed = [replace(three, keep=keep, settle=0).propose(problem).U for keep in (None, 1)]
    assert torch.equal(*followed)


def test_a_plan_that_falls_back_into_the_trap_is_not_settled() -> None:
    """Flying is so dear that waiting is cheaper: the plan stays as it was followed."""
    problem = replace(cup(B=1), cost=QuadraticCost(Q=WEIGHTS, R=[20.0, 20.0], Qf=WEIGHTS, x_ref=[1, 0.4, 0, 0, 0, 0]))
    followed, settled = (Detour(begin=0.1, end=0.8, settle=n).propose(problem).U for n in (0, 20))
    assert torch.equal(followed, settled)
    assert float(judge(problem, settled, GOAL, 0.3).goal_distance) < 0.3


def test_settling_makes_a_plan_cheaper() -> None:
    problem = cup(N=120)
    costs = [judge(problem, replace(QUICK, settle=n).propose(problem).U, GOAL, 0.3).cost for n in (0, 3)]
    assert bool((costs[0] > costs[1]).all())


def test_a_plan_deep_within_an_obstacle_is_refused() -> None:
    problem = cup(B=1)
    plans = [replace(QUICK, depth=depth).propose(problem) for depth in (1e-4, 1.0)]
    assert [bool(plan.found) for plan in plans] == [False, True]
    X = open_loop(problem.dynamics, problem.x0, plans[1].U)
    assert float(problem.constraints[0].violation(X, plans[1].U).max()) > 1e-4 * 0.2


def test_where_a_plan_is_refused_the_sampled_one_is_held_by_its_penalty() -> None:
    problem = cup(B=2)
    guidance = GCO(
        detour=replace(QUICK, depth=1e-4), sampler=MPPI(samples=64, knots=4, linger=1.0), adopt=True, patience=0
    )
    X = problem.x0[:, None].repeat(1, 101, 1)
    X[:, 5:, :2] = torch.as_tensor(problem.geometric[0].centers[:, :1])  # in a disc: caught, at this patience
    key = DrawKey(0, torch.arange(2), torch.ones(2, dtype=torch.int64))
    advice = guidance.update(problem, X, controls(problem), guidance.start(problem, X), key)
    refused = guidance.detour.propose(problem)
    assert not bool(refused.found.any()) and bool(advice.taken.all())
    assert torch.equal(advice.duals.mu, refused.duals.mu) and not bool(advice.duals.mu.isnan().any())
    nowhere = QUICK.propose(cup(closed=True))
    assert bool(nowhere.duals.mu.isnan().all())


def test_a_spring_is_followed_in_fewer_iterations_than_a_tube() -> None:
    problem, off = cup(B=1, N=120), []
    for tube, stiffness in ((0.05, 20.0), (None, 500.0)):
        detour = replace(QUICK, tube=tube, stiffness=(stiffness,), iterations=4, settle=0, depth=9.0)
        way = torch.tensor([[[-1.0, 0.0], [0.0, -0.9], [1.0, 0.4]]], dtype=torch.float64)
        R, unit = torch.full((1,), 0.2, dtype=torch.float64), torch.full((1,), 1e4, dtype=torch.float64)
        plans = Plans.begin(problem, controls(problem)[:, None], R, unit, torch.ones(1, 1, dtype=torch.bool))
        plans = replace(detour, end=0.8)._follow(plans, way[:, None])
        X = open_loop(problem.dynamics, problem.x0, plans.U)
        torch.testing.assert_close(plans.X, X)
        off.append(float((X[..., :2] - detour._travel(way, 0.8 * torch.ones_like(R), 120)).norm(dim=-1).mean()))
    assert off[1] < 0.5 * off[0]


def test_finalists_are_solved_to_their_end_and_the_cheapest_there_is_handed_over() -> None:
    problem, four = cup(B=2, N=120), replace(QUICK, ways=4, iterations=20)
    settled, ended = (replace(four, finalists=n).propose(problem) for n in (1, 3))
    rest = replace(four, finalists=3).propose(problem, torch.tensor([1, 2]))
    verdicts = [judge(problem, plan.U, GOAL, 0.3) for plan in (settled, ended, rest)]
    assert not bool(verdicts[0].sound.any()) and bool(verdicts[1].sound.all())
    assert bool((verdicts[1].cost < verdicts[2].cost).all())
    assert not any(bool(lam.any()) for lam in settled.duals.lam) and bool(ended.duals.lam[0].any())
    counts = []
    for finalists in (1, 3):
        guidance = GCO(detour=replace(four, finalists=finalists), patience=1)
        solver = AugmentedLagrangian(
            inner=ILQR(tolerance=1e-2, max_iterations=20), guidance=guidance, max_outer_iterations=20,
            grow_when_feasible=False, clip=True, cost_tolerance=1e-3,
        )  # fmt: skip
        solution = solver.solve(problem, controls(problem))
        counts.append((int(solution.outer_iterations.sum()), int(solution.iterations.sum())))
    assert counts[1][0] < counts[0][0]


def test_the_iterations_of_every_plan_are_counted(monkeypatch) -> None:
    """Those followed, those settled, and the finalists: the same as by asking every solve, whatever is handed over."""
    made = []

    def noted(solve):
        def call(*args, **options):
            end = solve(*args, **options)
            made.append(int(end.iterations.sum()))
            return end

        return call

    for place in ("torchgco.guidance.plans.descend", "torchgco.guidance.detour.AugmentedLagrangian.solve"):
        monkeypatch.setattr(place, noted(resolve_name(place)))
    x0 = torch.tensor([[-1.0, y, 0, 0, 0, 0] for y in (-0.2, 0.0, 0.1)], dtype=torch.float64)
    problem = replace(cup(B=3), x0=x0)
    detour = replace(QUICK, ways=3, pushes=((0.7, -0.7),), keep=3, settle=4, stiffness=(20.0, 200.0), finalists=2)
    together = detour.propose(problem)
    assert len(made) == 4 and int(together.iterations.sum()) == sum(made) and bool(together.found.any())
    for b in range(3):
        made.clear()
        alone = detour.propose(problem.take(torch.tensor([b])), torch.tensor([2]))  # no rank changes what is solved
        assert int(alone.iterations) == int(together.iterations[b]) == sum(made) > 0


def begun(problem: Problem, U: torch.Tensor, *words: torch.Tensor) -> Plans:
    """Plans with the paths of their controls (1, count, N, m)."""
    plans = Plans.begin(problem, U, *words)
    return replace(plans, X=open_loop(problem.dynamics, problem.x0.repeat(plans.count, 1), plans.U))


def test_paths_that_are_alike_count_once() -> None:
    problem = cup(B=1)
    U, one = controls(problem).repeat(1, 3, 1, 1).view(1, 3, -1, 2), torch.ones(1, dtype=torch.float64)
    U[:, 2] = -1.0  # drives away, which costs more
    plans = begun(problem, U, one, one, torch.ones(1, 3, dtype=torch.bool))
    first = torch.ones(3, dtype=torch.bool)
    assert plans.order(80.0, first).tolist() == [[0, 1, 2]]
    assert plans.order(80.0, first, alike=1e-3).tolist() == [[0, 2, 1]]
    first[0] = False  # what isn't sound stands for nobody
    assert plans.order(80.0, first, alike=1e-3).tolist() == [[1, 2, 0]]


def test_what_is_not_live_is_left_as_it_is_and_comes_last() -> None:
    problem = cup(B=1, N=60)
    R, unit = torch.full((1,), 0.2, dtype=torch.float64), torch.full((1,), 1e4, dtype=torch.float64)
    U = controls(problem).repeat(1, 2, 1, 1).view(1, 2, -1, 2)
    U[:, 1] = -1.0  # drives away, which costs more
    plans = begun(problem, U, R, unit, torch.tensor([[False, True]]))
    assert plans.order(80.0, torch.ones(2, dtype=torch.bool)).tolist() == [[1, 0]]
    settled, sound = replace(QUICK, settle=2)._settle(plans)
    assert 1 <= int(settled.iterations) <= 2
    assert torch.equal(settled.U[0], U[0, 0]) and not torch.equal(settled.U[1], U[0, 1]) and not bool(sound[0])


def test_ways_of_one_class_are_followed_once(monkeypatch) -> None:
    """The cup has a left and a right side: of five ways two are followed, from every start to each end."""
    counts = []
    monkeypatch.setattr(
        "torchgco.guidance.plans.descend",
        lambda inner, lagrangian, U: counts.append(lagrangian.problem.B) or descend(inner, lagrangian, U),
    )
    five = replace(QUICK, ways=5, stiffness=(20.0,), iterations=1, settle=1)
    for pushes, end, rows in (
        ((), 0.8, 2),
        (((0.7, -0.7), (-0.7, 0.7)), 0.8, 6),
        (((0.7, -0.7),), (0.8, 0.6, 0.7), 12),
    ):
        counts.clear()
        replace(five, pushes=pushes, end=end).propose(cup(B=1, N=60))
        assert counts == [rows, rows]


def test_a_push_turns_the_vehicle_before_it_sets_out() -> None:
    """By shares of the range from rest to the bound on that side, or by 1 where there is none."""
    problem, begin = cup(B=3, N=40), replace(QUICK, pushes=((0.75, -0.5), (0.0, 0.25)))._begun
    limits = ControlBounds([[-10.0, -4.0], [-10.0, -4.0], [-10.0, -torch.inf]], [10.0, 10.0])
    problem = Problem(problem.dynamics, problem.cost, [problem.constraints[0], limits], problem.x0, problem.N)
    starts = begin(problem, controls(problem))
    assert starts.shape == (3, 3, 40, 2) and not bool(starts[:, 0].any()) and not bool(starts[:, :, 4:].any())
    assert starts[0, 1, 3].tolist() == [7.5, -2.0] and starts[0, 2, 0].tolist() == [0.0, 2.5]
    assert starts[2, 1, 3].tolist() == [7.5, -0.5]
    off_centre = begin(problem, controls(problem) + 2.0)  # rest lies nearer to the upper bounds
    assert off_centre[0, 1, 3].tolist() == [8.0, -1.0]
    free = Problem(problem.dynamics, problem.cost, [problem.constraints[0]], problem.x0, problem.N)
    assert begin(free, controls(free))[0, 1, 3].tolist() == [0.75, -0.5]
    with pytest.raises(InputError, match=r"detour\.pushes: expected shape \(1, 2\)"):
        replace(QUICK, pushes=((1.0,),)).propose(cup())


def test_a_finalist_that_cuts_through_an_obstacle_between_two_knots_is_refused(monkeypatch) -> None:
    problem, one = cup(B=1, N=120), replace(QUICK, ways=2, iterations=20, finalists=2)
    assert bool(one.propose(problem).found)
    plan = one.propose(problem)
    monkeypatch.setattr("torchgco.guidance.detour.BETWEEN", -9.0)  # nobody keeps such a distance
    refused = one.propose(problem)
    assert not torch.equal(plan.U, refused.U) and not any(bool(lam.any()) for lam in refused.duals.lam)


def test_depth_between_the_knots() -> None:
    """A step across a disc is as deep as its middle, whatever lies at its ends; an absent disc counts for nothing."""
    problem = cup(B=1, N=2)
    X = torch.zeros(1, 3, 6, dtype=torch.float64)
    X[0, :, 0] = torch.tensor([-5.0, 5.0, 6.0])
    X[0, :, 1] = 0.1  # through the middle of the third disc
    torch.testing.assert_close(depth_between(problem, X), torch.tensor([0.2], dtype=torch.float64))
    X[0, :, 1] = 5.0
    assert float(depth_between(problem, X)) < 0


def test_a_plan_with_its_own_penalty_is_left_alone() -> None:
    """Guidance isn't asked again while it is followed, and the penalty is the one it came with."""
    problem, seen = cup(B=2), []

    def look(progress) -> None:
        state = progress.state
        if bool(state.led.any()):
            seen.append((state.outer.clone(), state.guided.clone(), state.duals.mu.clone(), state.rows.clone()))

    guidance = GCO(detour=replace(QUICK, hold=500.0), patience=1)
    solver = AugmentedLagrangian(
        inner=ILQR(max_iterations=4), guidance=guidance, max_outer_iterations=4, clip=True, grow_when_feasible=False
    )
    solver.solve(problem, controls(problem), callback=look)
    penalty = replace(QUICK, hold=500.0).propose(problem.in_cost_units()).duals.mu
    assert seen and torch.equal(seen[0][2], penalty[seen[0][3]])
    assert all(int(guided.max()) == 1 for _, guided, _, _ in seen) and int(seen[-1][0].max()) >= 3


CHANGES = dict(
    roadmap=Roadmap(margin=1.0), begin=0.2, end=0.7, smoothing=0.2, tube=0.2, stiffness=(50.0,), obstacle_penalty=50.0,
    hold=5.0, tolerance=0.5, iterations=2, settle=2
)  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_every_option_is_read(name: str) -> None:
    problem, base = cup(B=1, N=60), Detour(begin=0.1, end=0.8, iterations=3)
    one, other = base.propose(problem), replace(base, **{name: CHANGES[name]}).propose(problem)
    assert not (torch.equal(one.U, other.U) and torch.equal(one.duals.mu, other.duals.mu))


def test_a_quadrotor_is_led_too() -> None:
    problem, _ = quadrotor_batch(B=2, N=60)
    verdict = judge(problem, Detour(smoothing=0.16).propose(problem).U, problem.cost.goal(problem.x0)[:, :3], 2.0)
    assert float(verdict.goal_distance.max()) < 2.0


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (dict(roadmap={"nodes": 64}), "detour.roadmap"),
        (dict(begin=0.9), "detour.begin"), (dict(begin=-0.1), "detour.begin"), (dict(end=1.1), "detour.begin"),
        (dict(end=(0.5, 1.1)), "detour.begin"), (dict(end=()), "detour.begin"),
        (dict(smoothing=1.0), "detour.smoothing"), (dict(tube=0.0), "detour.tube"), (dict(hold=0.0), "detour.hold"),
        (dict(obstacle_penalty=0.0), "detour.obstacle_penalty"), (dict(stiffness=()), "detour.stiffness"),
        (dict(stiffness=(0.0,)), "detour.stiffness"), (dict(iterations=0), "detour.iterations"),
        (dict(ways=0), "detour.ways"), (dict(keep=0), "detour.keep"),
        (dict(settle=-1), "detour.settle"), (dict(depth=0.0), "detour.depth"),
        (dict(tolerance=0.0), "detour.tolerance"), (dict(finalists=0), "detour.finalists"),
        (dict(pushes=7), "detour.pushes"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=field.replace(".", r"\.")):
        Detour(**change)
