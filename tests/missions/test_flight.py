"""Missions that are stepped: what `fly` flies, other pilots, and plans of somebody else's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.missions.missions import DOUBLE, DT, REST, SOLVER, far, mission, varied
from torchgco import FunctionCost, InputError, Problem
from torchgco.kernels.in_c import NativeKernels
from torchgco.missions import Disturbance, Flight, Outcome, endings, pilot, planner
from torchgco.missions.planner import MissionPlan
from torchgco.missions.planning_problem import continued, planning_state, settled


@pytest.mark.parametrize("latency", [0, 1])
def test_steps_are_the_mission(latency: int) -> None:
    """Bit by bit, and frames are what the log holds."""
    problem = varied(2)
    flown = mission(SOLVER, 0.4, latency=latency, disturbance=Disturbance(wind=0.3, position_noise=0.01))
    log, flight, frames = flown.fly(problem, seed=4), Flight(flown, problem, seed=4), []
    while not flight.done:
        frames.append(flight.step())
    for name in ("x", "commands", "plan", "cost", "violation", "shifted"):
        assert torch.equal(getattr(log, name).nan_to_num(9e9), getattr(flight.log, name).nan_to_num(9e9)), name
    assert [frame.step for frame in frames] == list(range(8)) and frames[-1].t == pytest.approx(0.4)
    for frame in frames:
        assert torch.equal(frame.x, log.x[frame.rows, frame.step, -1])
        assert torch.equal(frame.plan.X[..., :3], log.plan[frame.rows, frame.step])
        assert not bool(frame.ended.any()) and float(frame.seconds) > 0
        away = (frame.measured[:, :3] - log.x[frame.rows, frame.step, 0, :3]).norm(dim=1)
        assert bool((away > 0).all() & (away < 0.1).all())


def resting(x: Tensor, knots: int) -> Tensor:
    """Plans (b, knots, 14) that stay upright, with the weight carried."""
    plan = torch.zeros(len(x), knots, 14).double()
    plan[..., :3], plan[..., 6], plan[..., 13] = x[:, None, :3], 1.0, 9.81
    return plan


@pytest.mark.parametrize("knots", [2, 5, 200])
def test_a_plan_of_somebody_elses(knots: int) -> None:
    """It is flown and logged; the pilot plans anew after it."""
    problem = varied(2)
    flight = Flight(mission(SOLVER, 0.4), problem)
    for _ in range(3):
        frame = flight.step(resting(flight.x, knots))
    assert bool((frame.x[:, 3:6].abs() < 1e-3).all()) and bool(flight.log.cost[:, :3].isnan().all())
    kept = flight.log.plan[:, 2]
    torch.testing.assert_close(kept, problem.x0[:, None, :3].expand_as(kept), rtol=0, atol=1e-3)
    after, again = flight.step(), flight.step()
    assert bool(after.plan.cost.isfinite().all()) and not bool(again.plan.shifted.any())
    later = flight.step(replace(again.plan, X=again.plan.X.roll(-1, 1)))  # a MissionPlan, too
    assert torch.equal(later.plan.X, again.plan.X.roll(-1, 1))
    assert bool((flight.log.steps() == 6).all())


class Waiting:
    """A pilot that stays where it is, and counts."""

    knots, seen = 3, ()

    def __init__(self, problem: Problem, x: Tensor, seed: int, ids: Tensor) -> None:
        self.model, self.calls, self.ids = problem.dynamics, list[str](), ids

    def sense(self, step: int, x: Tensor, measured: Tensor) -> None:
        self.calls.append(f"sense {len(x)}")

    def plan(
        self, step: int, x: Tensor, before: MissionPlan | None, measured: Tensor | None = None
    ) -> tuple[MissionPlan, float]:
        assert (before is None) == (step == 0) or len(before.X) == len(x)
        self.calls.append(f"plan {len(x)}")
        return MissionPlan.of_states(resting(x, 3), x, self.model, step * DT, DT), 0.25

    def take(self, index: Tensor) -> None:
        self.ids = self.ids[index]

    def parts(self) -> Mapping[str, Tensor]:
        return {"search_seconds": torch.full((len(self.ids),), 0.125).double()}


def test_another_pilot() -> None:
    """It is asked in every period for those that still fly: one vehicle begins at its goal, and ends at once."""
    problem = varied(2)
    position = problem.goal.position.clone()  # type: ignore[union-attr]
    position[1] = problem.x0[1, :3]
    problem = replace(problem, goal=replace(problem.goal, position=position))  # type: ignore[type-var]
    flight = Flight(mission(SOLVER, 4 * DT), problem, begin=Waiting)  # type: ignore[arg-type]
    frames = []
    while not flight.done:
        frames.append(flight.step())
    assert flight.pilot.calls == ["sense 2", "plan 2", *["sense 1", "plan 1"] * 3]  # type: ignore[attr-defined]
    assert frames[0].ended.tolist() == [False, True] and frames[1].rows.tolist() == [0]
    found = endings(flight.log, problem, 0.5)
    assert [end.outcome for end in found] == [Outcome.TIMEOUT, Outcome.REACHED]
    assert flight.log.planner_seconds[0].tolist() == [0.125, 0.25, 0.25, 0.25]  # shared by those that fly
    assert flight.log.search_seconds[0].tolist() == [0.125] * 4


def test_what_is_kept_from_call_to_call_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tracker's packed problems, and plans whose code is looked at once; also where others end earlier."""
    problem = varied(3)
    x0 = problem.x0.clone()
    x0[0, 0] = -0.2
    problem = replace(problem, x0=x0)
    flown = mission(SOLVER, 0.4, disturbance=Disturbance(wind=0.3, position_noise=0.01), goal_radius=1.99)
    kept = flown.fly(problem, seed=4)
    monkeypatch.setattr(NativeKernels, "kept_descent", lambda *arguments: None)
    for module in (pilot, planner):
        monkeypatch.setattr(module, "settled", lambda problem: problem)
    anew = flown.fly(problem, seed=4)
    assert len({*kept.steps().tolist()}) > 1 and kept.steps().max() > 2
    for name in ("x", "commands", "tracking_violation", "plan", "cost", "violation", "iterations"):
        assert torch.equal(getattr(kept, name).nan_to_num(9e9), getattr(anew, name).nan_to_num(9e9)), name


def test_the_code_of_users_is_looked_at_in_every_plan() -> None:
    """It may read what changes while a vehicle flies."""
    problem = far()
    weight = torch.tensor(1.0, **DOUBLE)
    end = torch.tensor(REST, **DOUBLE)
    user = FunctionCost(
        lambda x, u: weight * (x - end).square().sum(-1) + u.square().sum(-1), lambda x: (x - end).square().sum(-1)
    )
    own, users = settled(problem), settled(replace(problem, cost=user))
    assert own.known.current and not users.known.current
    x0 = problem.x0 + 0.1
    assert continued(own, x0).known is own.known and continued(users, x0).known is not users.known
    assert torch.equal(continued(own, x0).x0, x0) and torch.equal(continued(users, x0).x0, x0)


@pytest.mark.parametrize(
    ("plan", "line"),
    [
        (torch.zeros(1, 1, 14).double(), r"plan: expected states \(1, K, 14\) .* got \(1, 1, 14\)"),
        (torch.zeros(2, 5, 14).double(), r"plan: expected states \(1, K, 14\)"),
        ([[0.0] * 14] * 3, r"plan: expected states .* got list"),
        (torch.full((1, 3, 14), torch.nan).double(), "plan: expected finite states, got NaN"),
        (torch.zeros(1, 3, 14), "plan: expected dtype torch.float64"),
    ],
)
def test_a_plan_that_doesnt_fit_gets_one_line(plan: Any, line: str) -> None:
    flight = Flight(mission(SOLVER, DT), far())
    with pytest.raises(InputError, match=line):
        flight.step(plan)
    flight.step()
    with pytest.raises(InputError, match=r"flight: expected one that isn't done"):
        flight.step()


def test_states_are_those_of_the_plants_that_fly() -> None:
    flight = Flight(mission(SOLVER, 0.1), far())
    assert torch.equal(planning_state(flight.x, flight.airframe), far().x0)
    assert torch.equal(flight.step().x, flight.x)
