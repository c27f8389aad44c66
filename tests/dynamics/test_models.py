"""Models and their derivatives against the NumPy reference, and the order of the integrators."""

import numpy as np
import pytest
import torch

from tests.reference import models as reference
from torchgco import (
    Airframe,
    Bicycle,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    QuadrotorPlant,
    QuadrotorThrusts,
    RotorTracking,
    Unicycle,
)
from torchgco.dynamics import PointMass
from torchgco.lagrangian.lagrangian import linearise

MODELS = [Planar, QuadrotorPlanning, QuadrotorPlant, RotorTracking, Unicycle, Bicycle, PointMass]
FIELDS = {
    Planar: reference.planar_field,
    QuadrotorPlanning: reference.quadrotor_planning_field,
    QuadrotorPlant: reference.plant_field,
    RotorTracking: reference.rotor_field,
    Unicycle: reference.unicycle_field,
    Bicycle: reference.bicycle_field,
    PointMass: lambda x, u: np.concatenate((x[2:], u)),
}


def states_of(model, lead=(3, 5), seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(*lead, model.n, generator=generator, dtype=torch.float64)
    u = torch.randn(*lead, model.m, generator=generator, dtype=torch.float64)
    if model.n in (17, 7):  # thrusts in N, rotor speeds in rpm
        x[..., -4:] = 3.0 + x[..., -4:].clamp(-2, 2)
        u = 5000.0 + 300.0 * u
    return x, u


def test_thrusts_move_as_the_plants_do_whose_rotors_have_got_there() -> None:
    """And a quaternion of another norm is the same attitude."""
    own, plant = QuadrotorThrusts(airframe=Airframe(drag=0.2)), QuadrotorPlant(airframe=Airframe(drag=0.2))
    x, u = states_of(own)
    x[..., 6:10] /= x[..., 6:10].norm(dim=-1, keepdim=True)
    u = 3.0 + u
    expected = plant.field(torch.cat((x, u), dim=-1), 5000.0 * torch.ones_like(u))[..., :13]
    torch.testing.assert_close(own.field(x, u), expected)
    longer = torch.cat((x[..., :6], 1.3 * x[..., 6:10], x[..., 10:]), dim=-1)
    torch.testing.assert_close(own.field(longer, u)[..., 3:6], expected[..., 3:6])


@pytest.mark.parametrize("kind", [QuadrotorPlanning, QuadrotorPlant])
def test_drag_slows_the_velocity_alone(kind):
    own, free = (kind(airframe=Airframe(mass=1.2, drag=drag)) for drag in (0.3, 0.0))
    x, u = states_of(own)
    slope = torch.zeros(own.n, dtype=torch.float64)
    slope[3:6] = -0.3 / 1.2
    torch.testing.assert_close(own.field(x, u) - free.field(x, u), slope * x, rtol=0, atol=1e-12)


def differences(step, x, u, h=1e-6):
    """[fx, fu] (..., n, n+m) by central differences of `step`."""
    z = torch.cat((x, u), dim=-1)
    columns = []
    for i in range(z.shape[-1]):
        shift = torch.zeros_like(z)
        shift[..., i] = h * z[..., i].abs().clamp(min=1.0)
        ahead, behind = (step(*(z + sign * shift).split((x.shape[-1], u.shape[-1]), dim=-1)) for sign in (1.0, -1.0))
        columns.append((ahead - behind) / (2.0 * shift[..., i : i + 1]))
    return torch.stack(columns, dim=-1)


def reference_step(model, integrator):
    """step(x, u) of one state and one control in NumPy."""
    if type(model) is QuadrotorPlant:
        return reference.plant_step(model.dt, integrator=getattr(reference, integrator))
    return getattr(reference, integrator)(FIELDS[type(model)], model.dt)


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4"])
@pytest.mark.parametrize("cls", MODELS)
def test_jacobians_equal_differences_of_the_reference(cls, integrator) -> None:
    model = cls(integrator=integrator)
    x, u = states_of(model, lead=(6,))
    step = reference_step(model, integrator)

    def steps(x, u):
        return torch.stack([torch.from_numpy(step(a, b)) for a, b in zip(x.numpy(), u.numpy(), strict=True)])

    expected = differences(steps, x, u)
    torch.testing.assert_close(torch.cat(model.jacobians(x, u), dim=-1), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("cls", [Planar, QuadrotorPlanning])
def test_the_linearisation_holds_the_jacobians(cls) -> None:
    """F (N, B, n+1, n+1+m) in homogeneous form, for vehicles with different parameters."""
    model = cls(**{cls.per_element[0]: torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)})
    x, u = states_of(model)
    n, knots = model.n, torch.cat((x, x[:, :1]), dim=1)
    cost = QuadraticCost(Q=[1.0] * n, R=[1.0] * model.m, Qf=[1.0] * n)
    F = linearise(Problem(model, cost, [], x[:, 0], N=5), knots, u)
    fx, fu = model.jacobians(x, u)
    assert torch.equal(F[:, :, :n, :n].transpose(0, 1), fx) and torch.equal(F[:, :, :n, n + 1 :].transpose(0, 1), fu)
    assert torch.equal(F[:, :, n], torch.eye(n + 1 + model.m).double()[n].expand(5, 3, -1))
    assert not F[:, :, :n, n].any()


def test_a_subclass_steps_and_is_linearised_by_its_own_step() -> None:
    class Towed(Planar):
        def step(self, x, u):
            return super().step(0.5 * x, u)

    model, plain = Towed(), Planar()
    x, u = states_of(model)
    torch.testing.assert_close(model.jacobians(x, u)[0], 0.5 * plain.jacobians(0.5 * x, u)[0], rtol=1e-12, atol=0)


def test_plant_at_a_thrust_limit() -> None:
    """A thrust beyond its limit is clamped to it for any controls; a thrust of zero is too, with finite derivatives."""
    model = QuadrotorPlant()
    x, u = states_of(model, lead=(3,))
    x[0, -4], u[0, 0] = 6.0, 9000.0
    x[1, -1], u[1, 3] = 0.1046, 0.0
    x[2, -1] = 0.0
    fx, fu = model.jacobians(x, u)
    assert bool(fx.isfinite().all()) and bool(fu.isfinite().all())
    after = model.step(x, u)
    for b, rotor, limit in ((0, 13, 6.0), (1, 16, 0.1046), (2, 16, 0.1046)):
        assert float(after[b, rotor]) == limit
        assert not fx[b, rotor].any() and not fu[b, rotor].any()


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4"])
@pytest.mark.parametrize("cls", MODELS)
def test_step_equals_the_reference(cls, integrator) -> None:
    model = cls(integrator=integrator)
    x, u = states_of(model, lead=(6,))
    step = reference_step(model, integrator)
    expected = np.stack([step(a, b) for a, b in zip(x.numpy(), u.numpy(), strict=True)])
    np.testing.assert_allclose(model.step(x, u).numpy(), expected, rtol=1e-12, atol=1e-13)


def test_plant_keeps_the_quaternion_and_the_limits() -> None:
    model = QuadrotorPlant()
    x, u = states_of(model, lead=(4,))
    for _ in range(50):
        x = model.step(x, u)
    torch.testing.assert_close(x[:, 6:10].norm(dim=-1), torch.ones(4, dtype=torch.float64))
    assert bool(((x[:, 13:] >= 0.1046) & (x[:, 13:] <= 6.0)).all())


def test_a_unicycle_at_constant_speed_and_turn_rate_drives_on_a_circle() -> None:
    """Against the closed form: radius speed / turn rate, to the error of Runge and Kutta's steps."""
    model, x = Unicycle(dt=0.02), torch.tensor([[0.5, -1.0, 0.3, 1.2]], dtype=torch.float64)
    for _ in range(100):
        x = model.step(x, torch.tensor([[0.0, 0.8]], dtype=torch.float64))
    radius, heading = 1.2 / 0.8, 0.3 + 0.8 * 2.0
    across, along = np.sin(heading) - np.sin(0.3), np.cos(0.3) - np.cos(heading)
    expected = [0.5 + radius * across, -1.0 + radius * along, heading, 1.2]
    np.testing.assert_allclose(x[0].numpy(), expected, rtol=0, atol=1e-9)


def test_hover_is_an_equilibrium_of_plant_and_planner() -> None:
    frame = Airframe()
    rest = torch.zeros(1, 17, dtype=torch.float64)
    rest[0, 6], rest[0, 13:] = 1.0, frame.mass * 9.81 / 4
    speed = torch.full((1, 4), 5000.0, dtype=torch.float64)
    torch.testing.assert_close(QuadrotorPlant().step(rest, speed), rest, rtol=0, atol=1e-12)
    plan = torch.cat((rest[:, :13], torch.full((1, 1), 9.81, dtype=torch.float64)), dim=-1)
    u = torch.tensor([[0.0, 0, 0, 9.81]], dtype=torch.float64)
    torch.testing.assert_close(QuadrotorPlanning().step(plan, u), plan, rtol=0, atol=1e-12)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
def test_order_of_the_integrators(integrator: str, order: int) -> None:
    """The error of a pendulum over one second, fitted over step sizes, against a fine solution."""

    def swing(steps: int, name: str) -> torch.Tensor:
        model = FunctionDynamics(
            lambda x, u: torch.stack((x[..., 1], -x[..., 0].sin() + u[..., 0]), -1), 2, 1, 1.0 / steps, name
        )
        x = torch.tensor([1.0, 0.3], dtype=torch.float64)
        for _ in range(steps):
            x = model.step(x, torch.tensor([0.2], dtype=torch.float64))
        return x

    exact = swing(4096, "rk4")
    counts = np.array([16, 32, 64])
    errors = [float((swing(int(c), integrator) - exact).norm()) for c in counts]
    slope = np.polyfit(np.log(1.0 / counts), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.15)


def test_parameters_per_problem() -> None:
    """Vehicles with different coefficients step in a batch as each does alone."""
    drag = torch.tensor([5.0, 10.0, 20.0], dtype=torch.float64)
    model = Planar(drag=drag)
    x, u = states_of(model)
    together, (fx, fu) = model.step(x, u), model.jacobians(x, u)
    for b in range(3):
        alone = Planar(drag=float(drag[b]))
        torch.testing.assert_close(together[b], alone.step(x[b], u[b]), rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(fx[b], alone.jacobians(x[b], u[b])[0], rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(fu[b], alone.jacobians(x[b], u[b])[1], rtol=1e-14, atol=1e-14)
    half = model.take(torch.tensor([2, 0]))
    torch.testing.assert_close(half.step(x[[2, 0]], u[[2, 0]]), together[[2, 0]])


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Planar(dt=0.0), "planar.dt"),
        (lambda: QuadrotorPlanning(integrator="heun"), "quadrotor.integrator"),
        (lambda: Unicycle(dt=-0.1), "unicycle.dt"),
        (lambda: Unicycle(integrator="heun"), "unicycle.integrator"),
        (lambda: Airframe(mass=-1.0), "airframe.mass"),
        (lambda: Airframe(thrust_min=7.0), "airframe.thrust_min"),
        (lambda: Airframe(thrust_min=4.0), "airframe.thrust_min"),
        (lambda: Airframe(thrust_max=3.9), "airframe.thrust_max"),
    ],
)
def test_bad_parameters_are_named(make, field) -> None:
    with pytest.raises(InputError, match=field):
        make()
