"""Both plants: invariants, order, physics of their fields, agreement with each other, the batch contract, errors."""

import math
import os
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import simpson
from scipy.spatial.transform import Rotation
from torch import Tensor

from tests.problems import HOVER, quadrotor_batch
from torchgco import Airframe, Goal, InputError, Problem, QuadraticCost, QuadrotorPlanning, QuadrotorPlant, presets
from torchgco.missions import drone_models
from torchgco.missions.drone_models import DroneModelsPlant
from torchgco.missions.mission import Mission
from torchgco.missions.planner import Planner
from torchgco.missions.plant import RotorPlant, hovering

needs_drone_models = pytest.mark.skipif(find_spec("drone_models") is None, reason="drone-models isn't installed")
PLANTS = [RotorPlant, DroneModelsPlant]
each_plant = pytest.mark.parametrize("make", [RotorPlant, pytest.param(DroneModelsPlant, marks=needs_drone_models)])
FRAME = Airframe()
GRAVITY = FRAME.gravity
DOUBLE = torch.float64
STEP = torch.tensor([[100.0, -50.0, -120.0, 90.0], [400.0, 300.0, 420.0, 380.0]], dtype=DOUBLE)  # rpm


def at_hover(B: int = 1) -> Tensor:
    return hovering(FRAME, torch.zeros(B, 3, dtype=DOUBLE))


def fly(plant, x: Tensor, commands: Tensor, force: Tensor | None = None) -> Tensor:
    """States (K+1, B, 17) under rotor speeds (K, 4) or (K, B, 4), rpm, and a constant force (B, 3), N."""
    force = torch.zeros_like(x[:, :3]) if force is None else force
    flown = [x]
    for u in commands:
        flown.append(plant.advance(flown[-1], u.expand(x.shape[0], 4), force))
    return torch.stack(flown)


def hover_commands(steps: int) -> Tensor:
    return torch.full((steps, 4), FRAME.hover_speed, dtype=DOUBLE)


def step_commands(seconds: float, dt: float) -> Tensor:
    """(K, 2, 4): hover plus STEP for a quarter of the time, minus STEP for a quarter, and hover. No limit is met."""
    K = round(seconds / dt)
    sign = torch.zeros(K, dtype=DOUBLE)
    sign[: K // 4], sign[K // 4 : K // 2] = 1.0, -1.0
    return FRAME.hover_speed + sign.view(-1, 1, 1) * STEP


def random_states(B: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """States (B, 17), commands (B, 4) and forces (B, 3)."""
    generator = torch.Generator().manual_seed(seed)
    x, u, force = (torch.randn(B, n, generator=generator, dtype=DOUBLE) for n in (17, 4, 3))
    x[:, 6:10] /= x[:, 6:10].norm(dim=-1, keepdim=True)
    x[:, 13:] = 3.0 + x[:, 13:].clamp(-2, 2)
    return x, FRAME.hover_speed + 300.0 * u, force


@pytest.mark.sampled(1)
@each_plant
def test_the_quaternion_keeps_its_length_and_thrusts_their_limits(make) -> None:
    x, _, _ = random_states(5)
    generator = torch.Generator().manual_seed(1)
    commands = 12_000.0 * torch.rand(10, 5, 4, generator=generator, dtype=DOUBLE).round().repeat_interleave(30, dim=0)
    errors = torch.tensor([0.0, 0.1, -0.1, 0.2, -0.2], dtype=DOUBLE)  # better rotors could lift more, worse ones less
    flown = fly(make(thrust_error=errors), x, commands)[1:]
    assert (flown[..., 6:10].norm(dim=-1) - 1).abs().max() < 2e-15
    F = flown[..., 13:]
    assert F.min() == FRAME.thrust_min and F.max() == FRAME.thrust_max


@each_plant
def test_no_rotor_turns_slower_or_faster_than_its_thrust_limits_ask_for(make) -> None:
    x, _, force = random_states(3)
    low, high = FRAME.rotor_speeds
    assert FRAME.thrust_coefficient * high**2 == pytest.approx(FRAME.thrust_max)
    beyond = torch.tensor([[-399.0, 8398.0, low - 1.0, 5000.0]], dtype=DOUBLE).expand(3, 4)
    within = torch.tensor([[low, high, low, 5000.0]], dtype=DOUBLE).expand(3, 4)
    assert torch.equal(make().advance(x, beyond, force), make().advance(x, within, force))
    assert not torch.equal(make().advance(x, within - 1.0, force)[:, 14], make().advance(x, within, force)[:, 14])


@each_plant
def test_energy_in_free_fall(make) -> None:
    """It changes by the work of the least thrusts and of the yaw drag, and by nothing else."""
    dt, m, J = 0.01, FRAME.mass, np.array(FRAME.inertia)
    x, _, _ = random_states(1)
    x[:, 3:6], x[:, 10:13] = torch.tensor([1.0, -0.5, 2.0]), torch.tensor([3.0, -2.0, 4.0])
    x[:, 13:] = FRAME.thrust_min
    least = math.sqrt(FRAME.thrust_min / FRAME.thrust_coefficient)
    flown = fly(make(dt=dt), x, torch.full((100, 4), least, dtype=DOUBLE))[:, 0].numpy()
    p, v, q, w, F = np.split(flown, (3, 6, 10, 13), axis=-1)
    np.testing.assert_allclose(F, FRAME.thrust_min, rtol=1e-12)
    energy = 0.5 * m * (v**2).sum(-1) + 0.5 * ((w @ J) * w).sum(-1) + m * GRAVITY * p[:, 2]
    up = Rotation.from_quat(q, scalar_first=True).apply([0.0, 0.0, 1.0])
    lift, drag = F.sum(-1) * (up * v).sum(-1), -FRAME.rotational_drag * w[:, 2] ** 2
    works = [simpson(power, dx=dt) for power in (lift, drag)]
    assert min(abs(work) for work in works) > 0.01  # J
    assert abs(energy[-1] - energy[0] - sum(works)) < 1e-7


@each_plant
def test_hover_holds(make) -> None:
    flown = fly(make(), at_hover(), hover_commands(200))
    assert (flown - flown[0]).abs().max() < 1e-10


@pytest.mark.sampled(1)
@each_plant
def test_half_the_time_step_leaves_a_sixteenth_of_the_error(make) -> None:
    x, _, force = random_states(3)
    x[:, 13:] = at_hover(3)[:, 13:]
    speeds = FRAME.hover_speed + torch.tensor([[300.0, -200.0, 150.0, -250.0]], dtype=DOUBLE)

    def end(dt: float) -> Tensor:
        flown = fly(make(dt=dt), x, speeds.expand(round(0.32 / dt), 4), force)
        assert FRAME.thrust_min < flown[..., 13:].min() and flown[..., 13:].max() < FRAME.thrust_max
        return flown[-1]

    exact = end(0.00125)
    errors = [float((end(dt) - exact).norm()) for dt in (0.02, 0.01, 0.005)]
    assert errors[-1] > 1e-9  # above rounding
    for coarse, fine in pairwise(errors):
        assert 14 < coarse / fine < 18, errors


def test_without_errors_it_is_the_papers_plant() -> None:
    x, u, _ = random_states(20)
    assert torch.equal(RotorPlant().advance(x, u, torch.zeros(20, 3, dtype=DOUBLE)), QuadrotorPlant().step(x, u))


@each_plant
def test_a_vehicle_hovers_under_its_own_gravity(make) -> None:
    moon = replace(FRAME, gravity=1.62)
    x = hovering(moon, torch.zeros(1, 3, dtype=DOUBLE))
    assert float(x[0, 13:].sum()) == pytest.approx(moon.mass * 1.62)
    torch.testing.assert_close(fly(make(airframe=moon), x, hover_commands(50))[-1], x, rtol=0, atol=1e-9)
    free = x.clone()
    free[:, 13:] = moon.thrust_min
    fallen = fly(make(airframe=moon), free, torch.zeros(50, 1, 4, dtype=DOUBLE))[-1]
    lift = 4 * moon.thrust_min / moon.mass
    torch.testing.assert_close(fallen[:, 5], torch.full_like(x[:, 0], 0.5 * (lift - 1.62)), rtol=1e-6, atol=1e-9)


@each_plant
def test_a_heavier_vehicle_falls(make) -> None:
    errors, t = torch.tensor([0.1, -0.2], dtype=DOUBLE), 0.5
    flown = fly(make(mass_error=errors), at_hover(2), hover_commands(50))[-1]
    acceleration = GRAVITY / (1 + errors) - GRAVITY
    torch.testing.assert_close(flown[:, 5], acceleration * t, rtol=1e-9, atol=0)
    torch.testing.assert_close(flown[:, 2], acceleration * t * t / 2, rtol=1e-9, atol=0)


@pytest.mark.sampled(1)
@each_plant
def test_better_rotors_lift_more(make) -> None:
    errors = torch.tensor([0.1, -0.2], dtype=DOUBLE)
    flown = fly(make(thrust_error=errors), at_hover(2), hover_commands(300))
    hover = FRAME.mass * GRAVITY / 4
    torch.testing.assert_close(flown[-1, :, 13:], (hover * (1 + errors))[:, None].expand(2, 4), rtol=1e-9, atol=0)
    gained = (flown[-1, :, 5] - flown[-2, :, 5]) / 0.01
    torch.testing.assert_close(gained, GRAVITY * errors, rtol=1e-9, atol=0)


@each_plant
def test_drag_slows_the_vehicle_down(make) -> None:
    drag, x = torch.tensor([0.0, 0.3, 0.8], dtype=DOUBLE), at_hover(3)
    x[:, 3:5] = torch.tensor([4.0, -2.0])
    flown = fly(make(drag=drag), x, hover_commands(100))[-1]
    left = torch.exp(-drag / FRAME.mass)
    torch.testing.assert_close(flown[:, 3:5], left[:, None] * x[:, 3:5], rtol=1e-9, atol=0)


@each_plant
def test_a_force_accelerates_the_mass(make) -> None:
    force = torch.tensor([[0.5, -0.3, 0.2], [0.0, 0.0, -1.0]], dtype=DOUBLE)
    flown = fly(make(mass_error=0.25), at_hover(2), hover_commands(100), force)[-1]
    weight = torch.tensor([0.0, 0.0, GRAVITY / 1.25 - GRAVITY], dtype=DOUBLE)
    torch.testing.assert_close(flown[:, 3:6], force / (1.25 * FRAME.mass) + weight, rtol=1e-9, atol=1e-12)
    assert not flown[:, 10:13].any()


@each_plant
def test_the_body_turns_against_rotors_that_speed_up(make) -> None:
    """Their angular momentum about z and the body's stay 0 together, where air does nothing; measured 1e-6 of them."""
    J, J_r = ((0.0366, 0.0, 0.0), (0.0, 0.0327, 0.0), (0.0, 0.0, 0.0187)), 1e-4
    frame = replace(FRAME, inertia=J, rotor_torque=1e-12, rotational_drag=0.0, rotor_inertia=J_r)
    commands = frame.hover_speed + torch.tensor([300.0, -300.0, 300.0, -300.0], dtype=DOUBLE).expand(30, 4)
    x = fly(make(frame, 0.002), at_hover(), commands)[:, 0]
    turning = (x[:, 13:] / frame.thrust_coefficient).sqrt() * 2 * math.pi / 60
    own, rotors = 0.0187 * x[:, 12], J_r * (turning * torch.tensor([1.0, -1, 1, -1])).sum(-1)
    assert own[-1] > 5e-3
    torch.testing.assert_close(own, rotors, rtol=1e-4, atol=1e-8)


@pytest.mark.slow
@needs_drone_models
def test_the_plants_agree_on_a_hover() -> None:
    """Measured 4e-16."""
    flown = [fly(make(), at_hover(), hover_commands(200)) for make in PLANTS]
    torch.testing.assert_close(*flown, rtol=0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(("dt", "tolerance"), [(0.01, 2e-6), (0.002, 3e-9)])
@needs_drone_models
def test_the_plants_agree_on_a_step_command(dt, tolerance) -> None:
    """Measured 1.8e-7 and 2.7e-10.

    One integrates thrusts, the other rotor speeds: what is left is the error of the integrators, of order dt^4.
    """
    a, b = (fly(make(dt=dt), at_hover(2), step_commands(1.0, dt)) for make in PLANTS)
    assert (a[..., 10:13].abs().max() > 0.4) and (a[-1, :, :3].norm(dim=-1) > 0.1).all()
    assert FRAME.thrust_min < a[..., 13:].min() and a[..., 13:].max() < FRAME.thrust_max
    torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


@pytest.mark.slow
@needs_drone_models
def test_the_plants_agree_with_errors_drag_and_wind() -> None:
    """Measured 1.1e-11."""
    x, _, force = random_states(2)
    x[:, 13:] = at_hover(2)[:, 13:]
    given = {"mass_error": torch.tensor([0.1, -0.1]).to(DOUBLE), "thrust_error": -0.05, "drag": 0.3, "dt": 0.001}
    a, b = (fly(make(**given), x, step_commands(0.5, 0.001), force) for make in PLANTS)
    torch.testing.assert_close(a, b, rtol=0, atol=2e-10)


@needs_drone_models
@pytest.mark.parametrize("order", [PLANTS, PLANTS[::-1]])
def test_the_plants_differ_where_one_has_drag(order) -> None:
    a, b = (make(drag=drag) for make, drag in zip(order, (0.3, 0.0), strict=True))
    flown = [fly(plant, at_hover(2), step_commands(1.0, 0.01))[-1] for plant in (a, b)]
    assert ((flown[0] - flown[1])[:, :3].norm(dim=-1) > 1e-3).all()


def mission_problem(free: bool) -> Problem:
    """Two vehicles that fly almost a metre in the first second."""
    problem, _ = quadrotor_batch(B=2)
    goal = torch.tensor([6.0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, GRAVITY], dtype=DOUBLE)
    Q, R, Qf = [10.0] * 3 + [1.0] * 11, [10.0, 10.0, 10.0, 1.0], [100.0] * 3 + [1.0] * 11
    cost = QuadraticCost(Q, R, Qf, x_ref=goal, u_ref=HOVER)
    constraints = problem.constraints[1:] if free else problem.constraints
    goal = Goal([6.0, 1.0, 0.0], radius=0.5)
    return replace(problem, dynamics=QuadrotorPlanning(dt=0.05), cost=cost, constraints=constraints, goal=goal)


@needs_drone_models
@pytest.mark.slow
def test_the_plants_agree_on_a_short_mission() -> None:
    """In closed loop, without obstacles, measured 1.5e-6.

    Among obstacles plans jump: starts 1e-6 m apart led to states 2e-2 apart with one plant alone. See the next test.
    """
    problem = mission_problem(free=True)
    planner = Planner(presets.al_ilqr(problem))
    plants = RotorPlant(), DroneModelsPlant(), DroneModelsPlant(drag=0.3)
    a, b, dragged = (Mission(planner, plant=plant, duration=1.0).fly(problem).samples()[1] for plant in plants)
    assert ((a[:, -1, :3] - a[:, 0, :3]).norm(dim=-1) > 0.5).all()
    torch.testing.assert_close(a, b, rtol=0, atol=2e-5)
    assert (a - dragged).abs().max() > 0.05


@needs_drone_models
@pytest.mark.slow
def test_the_plants_agree_on_the_commands_of_a_mission_among_obstacles() -> None:
    """Measured 4e-6, and 3e-10 with a tenth of the time step."""
    problem = mission_problem(free=False)
    log = Mission(Planner(presets.al_ilqr(problem)), duration=1.0).fly(problem)
    commands = log.commands.flatten(1, 2).transpose(0, 1)
    for finer, tolerance in ((1, 5e-5), (10, 5e-9)):
        a, b = (fly(make(dt=0.01 / finer), log.x[:, 0, 0], commands.repeat_interleave(finer, 0)) for make in PLANTS)
        assert ((a[-1] - a[0])[:, :3].norm(dim=-1) > 0.5).all()
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance)


@each_plant
def test_a_batch_equals_its_parts(make) -> None:
    """Bit by bit, in any order, and next to vehicles that have diverged."""
    B = 24
    x, u, force = random_states(B)
    errors = torch.linspace(-0.2, 0.2, B, dtype=DOUBLE)
    plant = make(mass_error=errors, thrust_error=-0.5 * errors, drag=errors.abs())
    lost = torch.tensor([3, 7, 11])
    x[3], x[7, 6:10], x[11] = torch.nan, 0.0, 1e200 * x[11]
    whole = plant.advance(x, u, force)
    assert (~torch.isfinite(whole).all(-1)).nonzero().flatten().tolist() == lost.tolist()
    sound = torch.tensor([b for b in range(B) if b not in lost])
    shuffled = sound[torch.randperm(len(sound), generator=torch.Generator().manual_seed(0))]
    for rows in (shuffled, shuffled[:7], *sound.split(1)):
        assert torch.equal(plant.take(rows).advance(x[rows], u[rows], force[rows]), whole[rows])


@each_plant
def test_single_precision_stays_single(make) -> None:
    x, u, force = (part.float() for part in random_states(4))
    assert make().advance(x, u, force).dtype == torch.float32


@each_plant
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("dt", 0.0),
        ("dt", math.nan),
        ("dt", math.inf),
        ("mass_error", -1.0),
        ("mass_error", math.inf),
        ("mass_error", torch.tensor([0.1, math.nan])),
        ("thrust_error", torch.tensor([0.0, -1.5])),
        ("thrust_error", torch.zeros(2, 1)),
        ("drag", -0.1),
        ("drag", torch.tensor([0.1, -0.1])),
        ("drag", math.nan),
    ],
)
def test_bad_fields_are_named(make, field, value) -> None:
    with pytest.raises(InputError) as caught:
        make(**{field: value})
    assert caught.value.field == f"plant.{field}"


@pytest.fixture
def fresh_import():
    """drone-models is imported anew in the test."""
    drone_models._dynamics.cache_clear()
    yield
    drone_models._dynamics.cache_clear()


def test_a_missing_package_is_named(fresh_import, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "drone_models.first_principles", None)
    with pytest.raises(InputError, match=r"plant: expected drone-models \(`pip install torchgco\[plants\]`\)"):
        DroneModelsPlant()


@needs_drone_models
@pytest.mark.parametrize("before", [None, "0"])
def test_the_environment_is_left_as_it_was(fresh_import, monkeypatch, before) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "drone_models"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delenv("SCIPY_ARRAY_API", raising=False)
    if before is not None:
        monkeypatch.setenv("SCIPY_ARRAY_API", before)
    DroneModelsPlant()
    assert "drone_models" in sys.modules and os.environ.get("SCIPY_ARRAY_API") == before
