"""Races in closed loop: gates passed in flight, the problems that are left, plans between their knots, and a flight."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from torchgco import ControlBounds, Gates, InputError, NormBounds, Problem, Spheres, compose
from torchgco.constraints.gates import GateBalls
from torchgco.missions import Disturbance, Flight, Outcome, RaceMission, RacePlanner, endings
from torchgco.missions.contact import Contact, Passing
from torchgco.missions.outcome import judge_flight
from torchgco.missions.race import Racer
from torchgco.presets import interior_point

D: dict[str, Any] = {"dtype": torch.float64}
WORDS = ["scenario=race", "scenario.gates=[[-1.1,-1.6,3.6],[9.2,6.6,1.0]]", "scenario.stages=6", "device.threads=1"]
PLANNER = RacePlanner(interior_point(3))


def raced(count: int = 1) -> Problem:
    """Races through two gates, with those of all but the first moved."""
    setup = compose(WORDS)
    return setup.task(setup.layouts(count)).problem


def looped(turns: float = 2.0, T: int = 60) -> np.ndarray:
    """Samples (T, 3) of a flight around a circle of 2 m."""
    angle = np.linspace(0.0, 2.0 * math.pi * turns, T)
    return np.stack((2.0 * np.cos(angle), 2.0 * np.sin(angle), 0.1 * angle), axis=-1)


def passing(centers: list[list[float]], radius: float = 0.3) -> Passing:
    count = len(centers)
    none = torch.zeros(1, dtype=torch.int64)
    return Passing(torch.tensor([centers], **D), torch.full((1, count), radius, **D), none)


def test_gates_are_passed_in_their_order_and_between_samples() -> None:
    """Against many points of every line: the last gate's place is flown over before the first one's, and again."""
    p, gates = torch.from_numpy(looped()), passing([[0.0, 2.1, 0.2], [-2.0, 0.0, 0.3], [2.0, 0.1, 0.7]])
    when, away = gates.along(p)
    share = torch.linspace(0.0, 1.0, 2001, **D).view(-1, 1)
    first, after = 0, replace(gates)
    for g in range(3):
        near = []
        for k in range(first, len(p) - 1):
            line = p[k] + share * (p[k + 1] - p[k])
            near.append(float((line - gates.centers[0, g]).norm(dim=-1).min()))
            if len(near) > 1 and near[-2] <= 0.301 < near[-1]:
                break
        entered = next(i for i, d in enumerate(near) if d <= 0.301)
        assert int(when[g]) == first + entered + 1
        assert float(away[g]) == pytest.approx(min(near[entered:]), abs=1e-5)
        first += entered
    for k in range(len(p) - 1):
        after = replace(after, passed=after.after(p[k : k + 1], p[k + 1 : k + 2]))
        assert int(after.passed) == int((when <= k + 1).sum())
    assert bool(after.done)


def test_a_gate_that_is_missed_stops_the_count() -> None:
    when, away = passing([[0.0, 2.0, 0.2], [0.0, 0.0, 0.0], [2.0, 0.0, 1.2]]).along(torch.from_numpy(looped()))
    assert int(when[0]) < 60 and when[1:].tolist() == [60, 60]
    assert float(away[1]) == pytest.approx(2.0, abs=0.02) and not bool(away[2].isfinite())


def test_a_goal_counts_once_all_gates_are_passed() -> None:
    """The flight begins at its goal and comes back to it twice."""
    p, none = looped(), Contact(())
    gates = passing([[0.0, 2.0, 0.2], [0.0, -2.0, 1.1]])
    end = judge_flight(p, 0.1, none, p[59], 0.3, gates)
    assert (end.outcome, end.gates_passed) == (Outcome.REACHED, 2) and end.gate_distance < 0.3
    assert end.flight_time > 2.9 and judge_flight(p, 0.1, none, p[0], 0.3).flight_time == 0.0
    missed = judge_flight(p, 0.1, none, p[59], 0.3, passing([[0.0, 2.0, 0.2], [0.0, 0.0, 0.0]]))
    assert (missed.outcome, missed.gates_passed) == (Outcome.TIMEOUT, 1)
    assert missed.gate_distance == pytest.approx(2.0, abs=0.02)


def test_the_problems_that_are_left() -> None:
    whole = raced(2)
    next_ = PLANNER.posed(whole, 1, 1)
    assert (next_.N, next_.goal is None or next_.goal.assumed, next_.time.count) == (6, True, 1)
    gates = next(part for part in next_.constraints if isinstance(part, GateBalls))
    own = next(part for part in whole.constraints if isinstance(part, GateBalls))
    assert gates.places.tolist() == [[6], [6]] and torch.equal(gates.centers, own.centers[:, 1:2])
    torch.testing.assert_close(gates.sizes, torch.full((2, 1), 0.25, **D))
    bounds = next(part for part in next_.constraints if isinstance(part, ControlBounds))
    most = whole.dynamics.airframe.thrust_max
    assert bounds.upper.max().item() == pytest.approx(0.95 * most)
    assert bounds.lower.min().item() == pytest.approx(0.05 * most)
    last = PLANNER.posed(whole, 1, 5)
    assert (last.N, last.time.segments, last.goal.required) == (12, (0, 6), True)
    end = PLANNER.posed(whole, 2, 5)
    assert end.N == 6 and not any(isinstance(part, GateBalls) for part in end.constraints)
    assert float(end.time.least.max()) * 6 * end.dynamics.dt <= end.dynamics.dt + 1e-12


def test_a_tracker_follows_the_plan_between_its_knots() -> None:
    """Against short steps from knot to knot; the joint thrust by the mass is the last state, and the end hovers."""
    whole, draws = raced(2), torch.Generator().manual_seed(3)
    racer = Racer(PLANNER, whole, 0.01, 0, torch.arange(2))
    hover = whole.dynamics.airframe.hover_thrust
    U = hover * (1.0 + 0.3 * torch.rand(2, whole.N, 4, generator=draws, **D))
    t = torch.cat((torch.zeros(2, 1, **D), (0.02 + 0.03 * torch.rand(2, whole.N, generator=draws, **D)).cumsum(1)), 1)
    fine, path, at = replace(whole.dynamics, dt=1.0), [whole.x0], [t[:, 0]]
    for k in range(whole.N):
        h = (t[:, k + 1] - t[:, k]).unsqueeze(-1) / 20
        for j in range(20):
            half = path[-1] + 0.5 * h * fine.field(path[-1], U[:, k])
            path.append(path[-1] + h * fine.field(half, U[:, k]))
            at.append(t[:, k] + (j + 1) * h[:, 0])
    X, every = torch.stack(path[::20], 1), torch.stack(path, 1).numpy()
    racer._keep(torch.arange(2), 0, SimpleNamespace(X=X, U=U, t=t), 0.3)  # type: ignore[arg-type]
    for now in (0.3, 0.35, 0.471):
        ahead = racer._ahead(now)
        assert ahead.shape == (2, 201, 14)
        for b in range(2):
            place = now - 0.3 + 0.01 * np.arange(201)
            within = place < float(t[b, -1])
            for i in (0, 1, 2, 6, 7, 8, 9):
                told = np.interp(place[within], [float(moment[b]) for moment in at], every[b, :, i])
                assert np.abs(ahead[b, within, i].numpy() - told).max() < 2e-4
            k = np.searchsorted(t[b].numpy(), place[within], side="right") - 1
            lift = U[b, k].sum(-1) / whole.dynamics.airframe.mass
            torch.testing.assert_close(ahead[b, within, 13], lift)
            assert bool((ahead[b, ~within, 13] == whole.dynamics.airframe.gravity).all())


def squares() -> Problem:
    problem = raced()
    parts = [part for part in problem.constraints[:-1] if not isinstance(part, GateBalls)]
    parts.append(Gates([[1.0, 0, 1]], normals=[[1.0, 0, 0]], half_widths=0.3))
    return replace(problem, constraints=parts)


def elsewhere() -> Problem:
    """A leg that ends two knots before its gate."""
    problem = raced()
    return replace(problem, time=replace(problem.time, segments=(0, 4, 12)))


def more(part: Any) -> Problem:
    problem = raced()
    return replace(problem, constraints=[part, *problem.constraints[:-1]])


WRONG: dict[str, tuple[Any, str]] = {
    "squares": (squares, "constraints"),
    "no time": (lambda: replace(raced(), time=None), "time"),
    "elsewhere": (elsewhere, "time.segments"),
    "stones": (lambda: more(Spheres(torch.zeros(1, 1, 3, **D), torch.ones(1, 1, **D), 0.1)), "constraints[0]"),
    "speed": (lambda: more(NormBounds(("x", [3, 4, 5]), upper=20.0)), "constraints[0]"),
}


@pytest.mark.parametrize("name", WRONG)
def test_other_problems_are_refused(name: str) -> None:
    make, field = WRONG[name]
    with pytest.raises(InputError) as caught:
        RaceMission(PLANNER).fly(make())
    assert caught.value.field == field


def test_missions_and_races_refuse_each_others_problems() -> None:
    setup = compose(["experiment=mission", "study.layouts=1"])
    with pytest.raises(InputError, match="constraints: expected Gates with a radius in a race, got none"):
        RaceMission(PLANNER).fly(setup.task(setup.layouts(1)).problem)
    with pytest.raises(InputError, match="time: expected None for a mission, whose control periods are fixed"):
        setup.mission.fly(raced())
    with pytest.raises(InputError, match="scenario: expected race, or a layout file with gates"):
        compose(["experiment=race", "scenario=forest"])
    with pytest.raises(InputError, match=r"mission\.latency: expected 0 in a race, got 1"):
        RaceMission(PLANNER, latency=1)


@pytest.mark.slow
def test_races_are_flown_through_all_gates() -> None:
    """Two at once, in wind; one of them alone is the same, bit by bit."""
    problem, windy = raced(2), Disturbance(wind=0.5, gust=0.2)
    mission = RaceMission(PLANNER, duration=6.0, disturbance=windy)
    log = mission.fly(problem, seed=1)
    for b, end in enumerate(endings(log, problem, mission.goal_radius)):
        assert (end.outcome, end.gates_passed) == (Outcome.REACHED, 2)
        assert end.gate_distance <= 0.3 and end.flight_time <= 1.05 * float(log.cost[b, 0])
    assert bool((log.violation.nan_to_num() <= 1e-3).all()) and float(log.shifted.nan_to_num().mean()) < 0.1
    alone = Flight(mission, problem.take([1]), seed=1, ids=torch.tensor([1])).run()
    assert torch.equal(alone.x[0].nan_to_num(9e9), log.x[1].nan_to_num(9e9))
