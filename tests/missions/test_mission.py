"""Missions: how they end, the batch contract in closed loop, latency, moving spheres, and bad input."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from tests.missions.missions import DOUBLE, DT, REST, SOLVER, Recording, far, mission, scene, varied
from tests.obstacles.test_obstacles import HalfPlane
from torchgco import Airframe, Cost, Goal, InputError, Planar, Problem, QuadraticCost, QuadrotorPlanning
from torchgco.missions.contact import Contact
from torchgco.missions.disturbance import Disturbance
from torchgco.missions.log import MissionLog
from torchgco.missions.mission import Mission
from torchgco.missions.outcome import Ending, Outcome, ending
from torchgco.missions.planner import Planner
from torchgco.missions.planning_problem import planning_state
from torchgco.missions.plant import RotorPlant, hovering
from torchgco.missions.tracker import Reference, Tracker

TIMES = ("planner_seconds", "tracker_seconds")


@dataclass(frozen=True)
class Faulty(RotorPlant):
    """Once the vehicle has flown `after` m: NaN where fault is 1, thrown away by 2 km where it is 2."""

    fault: Tensor = torch.zeros(1, **DOUBLE)
    after: float = 1e-4

    per_element: ClassVar[tuple[str, ...]] = (*RotorPlant.per_element, "fault")

    def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Tensor:
        moved = super().advance(x, u, force)
        due = (x[:, 0] > self.after).unsqueeze(-1)
        fault = self.fault.expand(len(x)).unsqueeze(-1)
        moved = torch.where(due & (fault == 1), torch.nan, moved)
        return torch.where(due & (fault == 2), moved + 2e3, moved)


def ends(log: MissionLog, problem: Problem, radius: Tensor) -> list[Ending]:
    """How the judge says that missions ended."""
    assert problem.goal is not None
    contact, arrays, goals = Contact.among(problem), log.arrays(), problem.goal.position.numpy()
    return [ending(arrays, b, log.period, contact, goals[b], float(radius[b])) for b in range(problem.B)]


def assert_same_flights(part: MissionLog, whole: MissionLog, rows: Sequence[int]) -> None:
    """Assert that missions of `part` have the bits of missions `rows` of `whole`, all but the times they took."""
    for f in fields(MissionLog):
        if f.name not in ("period", "seen", *TIMES):
            mine, theirs = getattr(part, f.name), getattr(whole, f.name)[list(rows)]
            assert torch.equal(mine.isnan(), theirs.isnan()), f.name
            assert torch.equal(mine.nan_to_num(9e9), theirs.nan_to_num(9e9)), f.name


NAMES = ["reached", "collision", "timeout", "nan", "thrown away", "in contact"]
RADII = torch.tensor([1.9999, 0.3, 0.3, 0.3, 0.3, 0.3], **DOUBLE)


def six() -> tuple[Problem, Mission]:
    """Six missions that end in six ways: see NAMES."""
    centers, velocities = torch.zeros(6, 2, 3, **DOUBLE), torch.zeros(6, 2, 3, **DOUBLE)
    centers[:, :, 1], centers[2:, 1] = 9.0, torch.nan
    centers[1, 0], velocities[1, 0] = torch.tensor([0.0, 0.6, 0.0]), torch.tensor([0.0, -1.0, 0.0])
    centers[5, 0] = torch.tensor([0.0, 0.3, 0.0])
    problem = scene(centers, velocities=velocities)
    assert problem.goal is not None
    problem = replace(problem, goal=Goal(problem.goal.position, RADII))
    plant = Faulty(fault=torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 0.0], **DOUBLE))
    return problem, mission(duration=0.3, plant=plant, goal_radius=None)


@pytest.mark.slow
def test_every_end_by_construction() -> None:
    problem, flown = six()
    seen: list[tuple[int, int]] = []
    log = flown.fly(problem, report=lambda step, flying: seen.append((step, flying)))
    found = dict(zip(NAMES, ends(log, problem, RADII), strict=True))
    assert {name: end.outcome.name for name, end in found.items()} == {
        "reached": "REACHED", "collision": "COLLISION", "timeout": "TIMEOUT", "nan": "DIVERGED",
        "thrown away": "DIVERGED", "in contact": "COLLISION",
    }  # fmt: skip
    assert 0.1 < found["collision"].flight_time < 0.15  # 0.6 m - 0.475 m at 1 m/s
    assert found["timeout"].flight_time == pytest.approx(0.3)
    assert found["in contact"].flight_time == 0.0 and found["in contact"].clearance == pytest.approx(0.3 - 0.475)
    steps = dict(zip(NAMES, log.steps().tolist(), strict=True))
    assert steps["timeout"] == 6 and steps["collision"] == 3 and steps["in contact"] == 0
    for name in ("reached", "nan", "thrown away"):
        assert 0 < steps[name] < 6 and (steps[name] - 1) * DT < found[name].flight_time <= steps[name] * DT + 1e-9
    assert [step for step, _ in seen] == list(range(6))
    assert [flying for _, flying in seen] == [sum(n > k + 1 or n == 6 for n in steps.values()) for k in range(6)]


@pytest.mark.slow
def test_a_vehicle_that_ends_changes_no_other() -> None:
    problem, flown = six()
    whole = flown.fly(problem)
    for rows in ([0], [1], [2], [3], [4], [5], [4, 2, 0], [5, 4, 3, 2, 1, 0]):
        index = torch.tensor(rows)
        part = replace(flown, plant=flown.plant.take(index)).fly(problem.take(index), ids=index)
        assert_same_flights(part, whole, rows)


def test_the_log_is_nan_after_the_end() -> None:
    problem, flown = six()
    log = flown.fly(problem)
    for b, K in enumerate(log.steps().tolist()):
        for name in ("commands", "cost", "violation", "shifted", "guided", "plan", *TIMES):
            assert bool(getattr(log, name)[b, K:].isnan().all()), name
        assert bool(log.x[b, max(K, 1) :].isnan().all())
        assert bool(torch.isfinite(log.cost[b, :K]).all()) and bool((log.planner_seconds[b, :K] > 0).all())
        flown_x = log.x[b, :K]
        assert torch.equal(flown_x[1:, 0].nan_to_num(), flown_x[: max(K - 1, 0), -1].nan_to_num())
        assert torch.equal(log.x[b, 0, 0], hovering(Airframe(), problem.x0[b : b + 1, :3])[0])
    t, x = log.samples()
    assert t.shape == (31,) and x.shape == (6, 31, 17) and float(t[-1]) == pytest.approx(0.3)


def disturbed(B: int = 4) -> tuple[Problem, Mission]:
    """Different missions in every respect: spheres that move, wind, noise, masses."""
    disturbance = Disturbance(
        wind=0.5, gust=0.3, position_noise=0.01, velocity_noise=0.01, attitude_noise=1e-3, rate_noise=1e-3
    )
    plant = RotorPlant(mass_error=torch.tensor([0.1, -0.1, 0.05, 0.0], **DOUBLE)[:B], drag=0.1)
    planner = {"margin": 0.02, "margin_growth": 0.02}
    return varied(B, moving=True), mission(duration=0.3, plant=plant, disturbance=disturbance, planner=planner)


@pytest.mark.slow
def test_a_mission_has_the_same_bits_in_any_batch_and_order() -> None:
    problem, flown = disturbed()
    whole = flown.fly(problem, seed=5)
    assert torch.equal(whole.x.nan_to_num(9e9), flown.fly(problem, seed=5).x.nan_to_num(9e9))
    for rows in ([2], [3, 1], [3, 2, 1, 0]):
        index = torch.tensor(rows)
        part = replace(flown, plant=flown.plant.take(index)).fly(problem.take(index), seed=5, ids=index)
        assert_same_flights(part, whole, rows)
    other = flown.fly(problem, seed=5, ids=torch.tensor([9, 1, 2, 3]))
    assert not torch.equal(other.x[0], whole.x[0]) and torch.equal(other.x[1:], whole.x[1:])
    assert not torch.equal(flown.fly(problem, seed=6).x, whole.x)


@pytest.mark.parametrize("latency", [0, 1])
def test_first_plans_are_those_of_the_flight(latency: int) -> None:
    problem, flown = disturbed(3)
    flown, ids = replace(flown, latency=latency), torch.tensor([4, 1, 7])
    log = flown.fly(problem, seed=5, ids=ids)
    posed, found = flown.first_plans(problem, seed=5, ids=ids)
    assert torch.equal(log.plan[:, 0], found.X[..., :3]) and torch.equal(log.cost[:, 0], found.cost)
    assert torch.equal(posed.x0, found.X[:, 0]) and not torch.equal(posed.x0, problem.x0)  # measured with noise


@pytest.mark.parametrize("latency", [0, 1])
def test_commands_follow_the_plan_of_their_period(latency: int) -> None:
    """With latency, from the second period on, a plan starts from where the former plan was to lead."""
    solver, problem = Recording(), varied(2)
    log = mission(solver, 0.2, latency=latency).fly(problem)
    tracker, before = Tracker(), None
    for step in range(4):
        reference = Reference(solver.solutions[step].X, DT, Airframe())
        for j in range(5):
            before = tracker.track(log.x[:, step, j], reference, 0.01 * j, before)
            assert torch.equal(log.commands[:, step, j], before.commands)
            moved = RotorPlant().advance(log.x[:, step, j], before.commands, torch.zeros(2, 3, **DOUBLE))
            assert torch.equal(log.x[:, step, j + 1], moved)
    assert len(solver.calls) == 4 + latency
    for step, call in enumerate(solver.calls[:4]):
        start, true = call["problem"].x0, log.x[:, step, 0, :13]
        near = 1e-12 if latency == 0 or step == 0 else 0.05
        torch.testing.assert_close(start[:, :13], true, rtol=0, atol=near)
        if latency == 1 and step > 0:
            now = solver.calls[step - 1]["problem"]
            led = now.dynamics.step(
                planning_state(log.x[:, step - 1, 0], Airframe()), solver.solutions[step - 1].U[:, 0]
            )
            torch.testing.assert_close(start[:, :6], led[:, :6], rtol=0, atol=1e-9)
        assert torch.equal(log.plan[:, step], solver.solutions[step].X[..., :3])


def test_spheres_move_for_the_planner_and_for_the_plant() -> None:
    solver = Recording()
    centers = torch.tensor([[[0.9, 0.6, 0.0]], [[0.9, -0.2, 0.5]]], **DOUBLE)
    velocities = torch.tensor([[[0.0, -0.4, 0.1]], [[-0.2, 0.1, -0.3]]], **DOUBLE)
    problem = scene(centers, velocities=velocities, N=25)
    log = mission(solver, 0.4).fly(problem)
    knots = DT * torch.arange(problem.N + 1, **DOUBLE).view(1, -1, 1)
    for step, call in enumerate(solver.calls):
        shifted = centers + step * DT * velocities
        torch.testing.assert_close(call["problem"].constraints[0].centers, shifted, rtol=0, atol=1e-12)
        distance = (log.plan[:, step] - shifted - knots * velocities).norm(dim=-1)[:, 1:].amin(-1)
        assert bool((distance >= 0.5 - log.violation[:, step] - 1e-6).all())
    static = mission(duration=0.4).fly(scene(centers, N=25))
    assert not torch.equal(static.plan, log.plan)


def test_draws_are_keyed_by_seed_and_mission() -> None:
    some = Disturbance(wind=2.0, gust=0.5, gust_time=0.2, position_noise=0.1, attitude_noise=0.01)
    force, noise = some.draw(4, [0, 1, 2, 3], 400, DT)
    for rows in ([3], [2, 0]):
        part = some.draw(4, rows, 400, DT)
        assert torch.equal(part[0], force[rows]) and torch.equal(part[1], noise[rows])
    assert not torch.equal(some.draw(5, [0], 400, DT)[0], force[:1])
    wind = Disturbance(wind=2.0).draw(4, [0, 1, 2, 3], 400, DT)[0]
    assert bool((wind[..., 2] == 0).all()) and torch.equal(wind[:, :1].expand_as(wind), wind)
    torch.testing.assert_close(wind.norm(dim=-1), torch.full((4, 400), 2.0, **DOUBLE))
    gust = force - wind  # the same direction: the draws of the wind come first
    assert float(gust[:, 50:].std()) == pytest.approx(0.5, rel=0.1)
    neighbours = (gust[:, 51:] * gust[:, 50:-1]).mean() / gust[:, 50:].square().mean()
    assert float(neighbours) == pytest.approx(torch.exp(torch.tensor(-0.25)).item(), abs=0.08)
    assert float(noise[..., :3].std()) == pytest.approx(0.1, rel=0.1)
    assert float(noise[..., 6:10].std()) == pytest.approx(0.01, rel=0.1)
    assert not bool(noise[..., 3:6].any()) and not bool(noise[..., 10:].any())


class Effort(Cost):
    """Squared controls: no goal follows from it."""

    def stage(self, x: Tensor, u: Tensor, k: Any) -> Tensor:
        return u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return 0.0 * x.square().sum(-1)


def planar() -> Problem:
    cost = QuadraticCost([1.0] * 6, [1.0, 1.0], [1.0] * 6)
    return Problem(Planar(dt=DT), cost, [], torch.zeros(1, 6, **DOUBLE), 5)


def unknown() -> Problem:
    """With obstacles of a kind that the judge doesn't know."""
    plain = far()
    return Problem(plain.dynamics, plain.cost, [HalfPlane(9.0)], plain.x0, plain.N, plain.goal)


def coarse() -> Problem:
    plain = far()
    return replace(plain, dynamics=QuadrotorPlanning(dt=0.025))


PROBLEMS = {
    "scenario.dt": coarse,
    "model": planar,
    "constraints": unknown,
    "goal": lambda: replace(far(), cost=Effort(), goal=None),
    "x0": lambda: far().cast(torch.float32),
    "horizon": lambda: replace(far(), horizon=[far().N] * far().B),
}
FIELDS = {
    "mission.duration": {"duration": 0.0},
    "mission.latency": {"latency": 2},
    "mission.goal_radius": {"goal_radius": -1.0},
    "tracker.dt": {"plant": RotorPlant(dt=0.005)},
}


@pytest.mark.parametrize("field", PROBLEMS)
def test_bad_problems_are_named(field: str) -> None:
    with pytest.raises(InputError) as caught:
        mission().fly(PROBLEMS[field]())
    assert caught.value.field == field


@pytest.mark.parametrize("field", FIELDS)
def test_bad_fields_are_named(field: str) -> None:
    with pytest.raises(InputError) as caught:
        mission(**FIELDS[field])
    assert caught.value.field == field


def on_the_moon(airframe: Airframe) -> Problem:
    """From rest to a point ahead, planned for a vehicle."""
    g, there = airframe.gravity, far(N=40)
    rest = torch.tensor([*REST[:13], g], **DOUBLE)
    goal = rest + torch.tensor([2.0, *[0.0] * 13], **DOUBLE)
    cost = QuadraticCost([20, 20, 50, *[1] * 11], [1] * 4, [100] * 3 + [1] * 11, x_ref=goal, u_ref=[0, 0, 0, g])
    return replace(there, dynamics=QuadrotorPlanning(dt=DT, airframe=airframe), cost=cost, x0=rest.repeat(1, 1))


@pytest.mark.slow
def test_a_mission_flies_where_it_is_planned() -> None:
    """On the moon plans, tracker and plant weigh a sixth: the plant goes where the first plan leads."""
    moon = Airframe(gravity=1.62)
    plan = Planner(SOLVER, margin=0.0, estimation=0.0)
    log = Mission(plan, duration=0.5).fly(on_the_moon(moon))
    assert bool((log.x[0, :, 0, 2].abs() < 0.02).all())  # it doesn't fall, nor rise: 8.19 / 2 m in a second
    torch.testing.assert_close(log.x[0, -1, -1, :3], log.plan[0, 0, 10], rtol=0, atol=0.02)
    assert float(log.x[0, 0, 0, 13:].sum()) == pytest.approx(moon.mass * 1.62)


def test_a_plant_of_another_airframe_than_the_planned_one_is_refused() -> None:
    moon = Airframe(gravity=1.62)
    line = r"plant.airframe: expected that of the planning model, gravity 1.62, got gravity 9.81"
    with pytest.raises(InputError, match=line):
        mission(plant=RotorPlant(Airframe())).fly(on_the_moon(moon))
    with pytest.raises(InputError, match=r"mass 1.608, arm 0.216, got mass 1.2, arm 0.2"):
        mission(plant=RotorPlant(Airframe(mass=1.2, arm=0.2))).fly(far())
    errors = RotorPlant(mass_error=0.1, thrust_error=-0.1, drag=0.1)  # deviations, not another vehicle
    assert mission(plant=errors, duration=0.05).fly(far()).x.isfinite().all()


@pytest.mark.parametrize(
    ("answer", "got"), [(lambda x: x.numpy(), "ndarray"), (lambda x: x[:, :13], r"\(1, 13\)")], ids=["numpy", "short"]
)
def test_what_a_plant_of_ones_own_returns_is_checked(answer: Callable[[Tensor], Any], got: str) -> None:
    @dataclass(frozen=True)
    class Own(RotorPlant):
        def advance(self, x: Tensor, u: Tensor, force: Tensor) -> Any:
            return answer(x)

    with pytest.raises(InputError, match=rf"plant.advance: expected .*1, 17.*, got {got}"):
        mission(plant=Own(), duration=0.05).fly(far())


@pytest.mark.slow
def test_a_full_mission_reaches_its_goal() -> None:
    problem = varied(2)
    log = mission(SOLVER, 6.0, goal_radius=0.5).fly(problem)
    found = ends(log, problem, torch.full((2,), 0.5, **DOUBLE))
    assert [end.outcome for end in found] == [Outcome.REACHED] * 2
    assert all(end.clearance >= 0 for end in found)
