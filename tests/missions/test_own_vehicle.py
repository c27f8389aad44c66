"""A quadrotor of one's own: its airframe is said once, and plans, tracker and plant are about it."""

from __future__ import annotations

import pytest
import torch

from tests.slow import mostly
from torchgco import Airframe, InputError, compose, presets
from torchgco.missions import Mission, Outcome, Planner, RotorPlant, endings
from torchgco.missions.planning_problem import acceleration, planning_state
from torchgco.missions.plant import hovering
from torchgco.scenarios import Forest, PlanarTrap, Vehicle

OWN = Airframe(mass=1.2, arm=0.15, thrust_max=4.5, radius=0.3)
CRAZYFLIE = compose(["vehicle=crazyflie"]).vehicle.dynamics.airframe  # type: ignore[attr-defined]
FORESTS = Forest(start=(1, 1, 0))


@pytest.mark.slow
@pytest.mark.parametrize("count", mostly([2, 8], 8))
@pytest.mark.parametrize(
    "airframe", [pytest.param(OWN, id="own"), pytest.param(CRAZYFLIE, id="crazyflie", marks=pytest.mark.slow)]
)
def test_it_flies_through_forests(airframe: Airframe, count: int) -> None:
    task = Vehicle.quadrotor(airframe).among(FORESTS, range(count))
    log = Mission(Planner(presets.gco(3))).fly(task.problem)
    for end in endings(log, task.problem, 0.5):
        assert end.outcome is Outcome.REACHED and end.clearance > 0.0 and end.goal_distance < 0.5
    F = log.x[..., 13:]
    low, high = (torch.tensor(limit).double() for limit in (airframe.thrust_min, airframe.thrust_max))
    assert bool(((low - 1e-9 <= F) & (high + 1e-9 >= F) | F.isnan()).all())


@pytest.mark.slow
def test_one_key_of_a_command_and_the_same_in_python() -> None:
    setup = compose(["experiment=mission", "vehicle.mass=1.2", "vehicle.radius=0.3"])
    task = Vehicle.quadrotor(Airframe(mass=1.2, radius=0.3)).among(FORESTS, [0])
    other = setup.task(setup.layouts(1))
    assert torch.equal(task.problem.x0, other.problem.x0) and task.layouts == other.layouts
    one, two = (
        Mission(Planner(presets.gco(3)), duration=0.3).fly(problem) for problem in (task.problem, other.problem)
    )
    assert torch.equal(one.x[:, :6], two.x[:, :6])


def test_the_planner_knows_the_drag_of_the_airframe_and_not_the_plants_errors() -> None:
    """The acceleration that it expects is the plant's, but for the force by which the plant differs."""
    frame, still = Airframe(mass=1.2, drag=0.8), torch.zeros(5, 3).double()
    x = hovering(frame, still)
    x[:, 3:6] = torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).double()
    x[:, 7:10] = 0.1 * x[:, 3:6]
    x[:, 6:10] /= x[:, 6:10].norm(dim=1, keepdim=True)
    u, h = torch.full((5, 4), frame.hover_speed).double(), 1e-5
    for error in (0.0, 0.5):
        v = RotorPlant(frame, dt=h, drag=error).advance(x, u, still)[:, 3:6]
        beyond = -error / 1.2 * x[:, 3:6]
        torch.testing.assert_close((v - x[:, 3:6]) / h, acceleration(x, frame) + beyond, rtol=0, atol=1e-4)
    vehicle = Vehicle.quadrotor(frame)
    planned = vehicle.dynamics.field(planning_state(x, frame), torch.zeros(5, 4).double())
    torch.testing.assert_close(planned[:, 3:6], acceleration(x, frame))


def test_a_plant_takes_the_airframe_that_is_planned_with() -> None:
    problem = Vehicle.quadrotor(OWN).among(FORESTS, [0]).problem
    given, taken = (Mission(Planner(presets.gco(3)), plant=p, duration=0.2) for p in (RotorPlant(OWN), RotorPlant()))
    assert torch.equal(given.fly(problem).x, taken.fly(problem).x)
    with pytest.raises(InputError, match=r"plant.airframe: expected that of .* mass 1.2, .*got mass 1.6"):
        Mission(Planner(presets.gco(3)), plant=RotorPlant(Airframe())).fly(problem)


def test_endings_are_of_the_problems_that_were_flown() -> None:
    problem = Vehicle.quadrotor(OWN).among(FORESTS, range(2)).problem
    log = Mission(Planner(presets.gco(3)), duration=0.1).fly(problem)
    assert [end.outcome for end in endings(log, problem)] == [Outcome.TIMEOUT] * 2
    with pytest.raises(InputError, match=r"problem: expected the 2 problems .*got 1 problems"):
        endings(log, problem.take(slice(0, 1)))
    with pytest.raises(InputError, match=r"model: expected .* for the 2-D"):
        Vehicle.quadrotor(OWN).among(PlanarTrap(), [0])
    with pytest.raises(InputError, match="airframe: expected an object of class Airframe"):
        Vehicle.quadrotor(1.2)  # type: ignore[arg-type]
