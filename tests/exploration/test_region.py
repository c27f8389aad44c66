"""Plans near the faces of the map: they stay within, and ask for what the vehicle can do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.missions.missions import REST
from torchgco import Boxes, ControlBounds, Goal, Problem, QuadraticCost, QuadrotorPlanning, presets
from torchgco.dynamics import Airframe
from torchgco.exploration.explorer import FLYABLE, PLACES, Explorer, unflyable, within_bounds
from torchgco.exploration.pilot import Exploration
from torchgco.exploration.sensing import Lidar
from torchgco.exploration.sensing.grid import FREE, OCCUPIED
from torchgco.kernels import followed
from torchgco.missions import Planner
from torchgco.missions.plant import hovering

LOW, HIGH = -0.5, 3.0  # m: floor and ceiling of the map
LEAST, MOST = [-5.0, -5.0, -5.0, 0.26], [5.0, 5.0, 5.0, 14.9]  # controls


def exploring(height: float) -> tuple[Exploration, Tensor]:
    """A vehicle (1, 17) at a height, m, with 0.85 of the thrust that would carry it; a goal far ahead in free space."""
    start, goal = torch.tensor([REST]).double(), torch.tensor([[12.0, 0.0, height]]).double()
    start[:, 2] = height
    cost = QuadraticCost(Q=[1.0] * 14, R=[1.0] * 4, Qf=[1.0] * 14, x_ref=REST, u_ref=[0, 0, 0, 9.81])
    far = Boxes([[30.0, 0.0, 0.0]], [[0.2, 0.2, 0.2]], 0.1)
    problem = Problem(QuadrotorPlanning(dt=0.05), cost, [far, ControlBounds(LEAST, MOST)], start, 20, Goal(goal, 0.4))
    explorer = Explorer(region=((-2.0, 14.0), (-2.0, 2.0), (LOW, HIGH)), known=20.0)
    planner = Planner(presets.gco(3))
    exploration = Exploration(explorer, planner, Lidar(), "occupied", problem, 0, torch.tensor([0]))
    exploration.sense(0, hovering(Airframe(), start[:, :3]), hovering(Airframe(), start[:, :3]))
    x = hovering(Airframe(), start[:, :3])
    x[:, 13:] *= 0.85
    return exploration, x


def test_the_cheapest_plan_near_the_floor_of_the_map_stays_within() -> None:
    """It would dip on the way: thrust changes slowly, and the reference runs ahead."""
    exploration, x = exploring(LOW + 0.6)
    lowest, best = [], exploration._best

    def choose(X: Tensor, *others: Any) -> int | None:
        lowest.append(float(X[..., 2].min()))
        return best(X, *others)

    exploration._best = choose  # type: ignore[method-assign]
    before = None
    for step in range(3):
        before, _ = exploration.plan(step, x, before)
        assert not before.shifted[0] and exploration.spare(before.X[0].numpy(), 0) >= 0
    assert len(lowest) == 3 and min(lowest) > LOW


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", [0, 1])
def test_what_leaves_the_map_breaks_the_planning_problem(axis: int, side: int) -> None:
    """Also where the former plan, around which half-spaces are made, was there, and for each face."""
    exploration, x = exploring(1.0)
    seen = exploration.scouts[0].seen
    seen.state[:] = FREE
    bias, reference = x.new_zeros(1, 3), exploration._reference(x)
    seed = x[:, None, :3].repeat(1, exploration.explorer.stages, 1)
    seed[..., axis] = float(seen.box(0.0)[side][axis]) + (0.1 if side else -0.1)
    problem = exploration._problem(x, bias, reference, [seed])
    X = reference.clone()
    U = problem.cost.rest_controls(x.new_zeros(1, exploration.explorer.stages, 4))
    X[:, 1:, :3], X[..., 3:6] = seed, 0.0
    assert max(float(problem.constraints[i].value(X, U).max()) for i in PLACES) >= 0.1
    assert exploration.spare(X[0].numpy(), 0) < 0


def test_a_plan_that_cannot_be_flown_is_not() -> None:
    exploration, x = exploring(1.0)
    plan, _ = exploration.plan(0, x, None)
    cost, X = torch.zeros(2).double(), plan.X.repeat(2, 1, 1)
    kept = plan.X[0]
    for excess, best in (([1.0, 0.0], 1), ([1.0, 1.0], None), ([0.0, 0.0], 0), ([0.1, 0.15], None)):
        assert exploration._best(X, cost, torch.tensor(excess), kept, 0) == best
    lost = kept.clone()
    lost[-1, 3] = 2.0  # it doesn't come to rest: rather one that nearly can be flown, and the nearest to that
    for excess, best in (([0.15, 0.1], 1), ([1.0, 1.0], None), ([0.0, 0.1], 0)):
        assert exploration._best(X, cost, torch.tensor(excess), lost, 0) == best
    reference = exploration._reference(x)
    problem = exploration._problem(x, x.new_zeros(1, 3), reference, [reference[:, 1:, :3]])
    assert float(unflyable(problem, plan.X, plan.U)[0]) <= FLYABLE
    for wrong in (plan.U + 9.0, plan.U - 20.0):
        assert float(unflyable(problem, plan.X, wrong)[0]) > 1.0
    falling = plan.X.clone()
    falling[:, -1, 13] -= 2.0  # its velocity is still that of rest, its thrust isn't
    assert float(unflyable(problem, falling, plan.U)[0]) > 1.0


def test_a_vehicle_within_a_margin_has_time_to_leave_it() -> None:
    """What it is asked for grows with the time in which it can get away."""
    exploration, x = exploring(1.0)
    scout = exploration.scouts[0]
    scout.seen.state[:] = FREE
    wall = scout.seen.cell([0.4, 0.0, 1.0])
    scout.seen.state[wall[0], wall[1], wall[2]] = OCCUPIED
    scout.seen.remeasure(np.array([np.ravel_multi_index(tuple(wall), scout.seen.shape)], np.int32))
    gap, keep = float(scout.seen.gaps(x[:, :3].numpy(), 1.0, exploration.kinds)[0]), scout.keep
    assert gap == pytest.approx(0.2) and keep == pytest.approx(0.3)
    reference = exploration._reference(x)
    problem = exploration._problem(x, x.new_zeros(1, 3), reference, [x[:, None, :3].repeat(1, 60, 1)])
    X, U = reference.clone(), problem.cost.rest_controls(x.new_zeros(1, 60, 4))
    X[..., :3], X[..., 3:6] = x[:, None, :3], 0.0
    rows = problem.constraints[0].value(X, U)[0].amax(-1)  # of a vehicle that stays where it is
    assert bool((rows[:10] <= 0).all()) and bool((rows.diff() >= -1e-12).all())
    assert 0.0 < float(rows[15]) < 0.1 and float(rows[-1]) == pytest.approx(keep - gap, abs=1e-6)


def test_a_path_is_followed_until_it_is_blocked_or_another_is_cheaper() -> None:
    exploration, x = exploring(1.0)
    scout, position = exploration.scouts[0], x[0, :3].numpy()
    scout.seen.state[:] = FREE
    scout.seen.remeasure(np.arange(scout.seen.state.size, dtype=np.int32))
    along, goal = np.linspace(0.0, 12.0, 61)[:, None], np.array([1.0, 0.0, 0.0])
    straight = position + along * goal
    around = straight + np.array([0.0, 1.0, 0.0]) * np.sin(np.linspace(0.0, np.pi, 61))[:, None]
    far = straight + np.array([0.0, 1.6, 1.0]) * np.sin(np.linspace(0.0, np.pi, 61))[:, None]
    scout.path = straight
    assert scout._steady(position, around) is not around
    scout.path = far
    assert scout._steady(position, straight) is straight
    scout.path = around
    wall = scout.seen.cell(around[30])
    scout.seen.state[tuple(wall)] = OCCUPIED
    scout.seen.remeasure(np.array([np.ravel_multi_index(tuple(wall), scout.seen.shape)], np.int32))
    assert scout.search.cost(around) == np.inf > scout.search.cost(straight)
    assert scout._steady(position, straight) is straight


def test_a_former_plan_asks_for_no_more_than_the_bounds() -> None:
    exploration, x = exploring(1.0)
    plan, _ = exploration.plan(0, x, None)
    x[:, 2] -= 0.5
    reference = exploration._reference(x)
    problem = exploration._problem(x, x.new_zeros(1, 3), reference, [reference[:, 1:, :3]])
    X, U = followed(problem, plan.X, plan.U, plan.K)
    assert float(unflyable(problem, X, U)[0]) > 1.0
    X, U = within_bounds(problem, plan.X, plan.U, plan.K)
    for i, (low, high) in enumerate(zip(LEAST, MOST, strict=True)):
        assert low <= float(U[..., i].min()) and float(U[..., i].max()) <= high
    state = X[:, 0]
    assert torch.equal(state, problem.x0)
    for k in range(U.shape[1]):
        state = problem.dynamics.at(k).step(state, U[:, k])
        assert torch.allclose(state, X[:, k + 1])


def test_who_stays_in_one_place_looks_elsewhere() -> None:
    exploration, x = exploring(1.0)
    (scout,), points = exploration.scouts, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    for gaps, costly in ((np.array([0.9, 0.9, 0.1]), points[2]), (np.array([0.9, 0.9, 0.9]), points[2])):
        scout.search.price[:] = 0.0
        for period in range(20):  # of patience
            assert (scout.search.price == 0).all(), period
            scout._wait(x[0, :3].numpy(), points, gaps)
        assert scout.search.price[tuple(scout.seen.cell(costly))] > 0
        assert scout.search.price[tuple(scout.seen.cell(costly + np.array([4.0, 0.0, 0.0])))] == 0
    scout.search.price[:] = 0.0
    for period in range(60):  # it moves
        scout._wait(x[0, :3].numpy() + np.array([0.03 * period, 0.0, 0.0]), points, gaps)
    assert (scout.search.price == 0).all()


def test_a_reference_that_no_plan_follows_becomes_slow_until_the_place_is_left() -> None:
    exploration, x = exploring(1.0)
    (scout,), position = exploration.scouts, x[0, :3].numpy()
    exploration.seek(x)
    fast = exploration._reference(x)
    for period in range(4):  # in one place, after one more in `seek`
        assert scout.slow == 0, period
        scout._wait(position, position[None], np.ones(1))
        scout.slow_down(False)
    assert scout.slow == 40 and scout.waited == 0
    slow = exploration._reference(x)
    ways = [(reference[0, 20, :3] - x[0, :3]).norm() for reference in (fast, slow)]  # within the patience of 1 s
    assert 0.3 < float(ways[1]) < 0.5 * float(ways[0])
    scout.slow_down(True)
    assert scout.slow == 39
    scout._wait(position + 1.0, position[None], np.ones(1))
    assert scout.slow == 0


def test_plans_of_a_vehicle_that_has_left_the_map_are_not_confined_to_it() -> None:
    exploration, x = exploring(1.0)
    (scout,) = exploration.scouts
    assert np.array_equal(exploration._region(scout, x[0].numpy()), scout.seen.box(0.0))
    x[:, 2] = LOW - 0.5
    low, high = exploration._region(scout, x[0].numpy())
    assert np.isclose(low[2], LOW - 1.5) and np.array_equal(high, scout.seen.box(0.0)[1])
