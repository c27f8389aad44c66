"""Models against the NumPy reference, derivatives against autodiff, order of the integrators."""

import numpy as np
import pytest
import torch

from tests.reference import models as reference
from torchgco import (
    Airframe,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    QuadrotorPlant,
    RotorTracking,
)
from torchgco.expansion import linearise

MODELS = [Planar, QuadrotorPlanning, QuadrotorPlant, RotorTracking]
FIELDS = {
    Planar: reference.planar_field,
    QuadrotorPlanning: reference.quadrotor_planning_field,
    QuadrotorPlant: reference.plant_field,
    RotorTracking: reference.rotor_field,
}


def states_of(model, lead=(3, 5), seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(*lead, model.n, generator=generator, dtype=torch.float64)
    u = torch.randn(*lead, model.m, generator=generator, dtype=torch.float64)
    if model.n in (17, 7):  # thrusts in N, rotor speeds in rpm
        x[..., -4:] = 3.0 + x[..., -4:].clamp(-2, 2)
        u = 5000.0 + 300.0 * u
    return x, u


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4"])
@pytest.mark.parametrize("cls", MODELS)
def test_jacobians_equal_autodiff(cls, integrator) -> None:
    model = cls(integrator=integrator)
    x, u = states_of(model)
    for analytic, auto in zip(model.jacobians(x, u), model.autodiff_jacobians(x, u), strict=True):
        torch.testing.assert_close(analytic, auto, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("integrator", ["euler", "rk4"])
@pytest.mark.parametrize("cls", [Planar, QuadrotorPlanning])
def test_what_is_known_to_be_zero_is_left_out_of_the_linearisation(cls, integrator) -> None:
    """F from the entries of a sparse model, in memory that a pass with other states has left, equals autodiff."""
    model = cls(integrator=integrator, **{cls.per_element[0]: torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)})
    x, u = states_of(model)
    n, other = model.n, torch.cat((x, x[:, :1]), dim=1)
    cost = QuadraticCost(Q=[1.0] * n, R=[1.0] * model.m, Qf=[1.0] * n)
    problem = Problem(model, cost, [], x[:, 0], N=5)
    F = linearise(problem, other, u, out=linearise(problem, -other, 2.0 * u))
    fx, fu = model.autodiff_jacobians(x, u)
    torch.testing.assert_close(F[:, :, :n, :n].transpose(0, 1), fx, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(F[:, :, :n, n + 1 :].transpose(0, 1), fu, rtol=1e-10, atol=1e-12)
    assert torch.equal(F[:, :, n], torch.eye(n + 1 + model.m).double()[n].expand(5, 3, -1))
    assert not F[:, :, :n, n].any()


def test_a_subclass_with_derivatives_of_its_own_is_linearised_by_them() -> None:
    class Towed(Planar):
        def step(self, x, u):
            return super().step(0.5 * x, u)

        def jacobians(self, x, u):
            return self.autodiff_jacobians(x, u)

    model = Towed()
    x, u = states_of(model)
    problem = Problem(model, QuadraticCost(Q=[1.0] * 6, R=[1.0] * 2, Qf=[1.0] * 6), [], x[:, 0], N=5)
    F = linearise(problem, torch.cat((x, x[:, :1]), dim=1), u)
    torch.testing.assert_close(F[:, :, :6, :6].transpose(0, 1), model.autodiff_jacobians(x, u)[0], rtol=1e-10, atol=0)


@pytest.mark.parametrize("lead", [(4,), (4, 5)])
def test_the_quadrotor_of_few_operations_is_the_one_of_components(lead) -> None:
    T_w = torch.tensor([0.5, 1.0, 1.5, 2.0], dtype=torch.float64)
    for model in (QuadrotorPlanning(), QuadrotorPlanning(rate_time_constant=T_w, thrust_time_constant=2 * T_w)):
        x, u = states_of(model, lead)
        rates = torch.stack(model.rates(x.unbind(-1), u.unbind(-1)), dim=-1)
        torch.testing.assert_close(model.field(x, u), rates, rtol=1e-14, atol=1e-14)


def test_plant_jacobians_at_a_thrust_limit() -> None:
    model = QuadrotorPlant()
    x, u = states_of(model, lead=(2,))
    x[0, -4], u[0, 0] = 6.0, 9000.0
    x[1, -1], u[1, 3] = 0.1046, 0.0
    for analytic, auto in zip(model.jacobians(x, u), model.autodiff_jacobians(x, u), strict=True):
        torch.testing.assert_close(analytic, auto, rtol=1e-10, atol=1e-12)
    assert float(model.step(x, u)[0, -4]) == 6.0 and float(model.step(x, u)[1, -1]) == 0.1046


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4"])
@pytest.mark.parametrize("cls", MODELS)
def test_step_equals_the_reference(cls, integrator) -> None:
    model = cls(integrator=integrator)
    x, u = states_of(model, lead=(6,))
    if cls is QuadrotorPlant:
        step = reference.plant_step(model.dt, integrator=getattr(reference, integrator))
    else:
        step = getattr(reference, integrator)(FIELDS[cls], model.dt)
    expected = np.stack([step(a, b) for a, b in zip(x.numpy(), u.numpy(), strict=True)])
    np.testing.assert_allclose(model.step(x, u).numpy(), expected, rtol=1e-12, atol=1e-13)


def test_plant_keeps_the_quaternion_and_the_limits() -> None:
    model = QuadrotorPlant()
    x, u = states_of(model, lead=(4,))
    for _ in range(50):
        x = model.step(x, u)
    torch.testing.assert_close(x[:, 6:10].norm(dim=-1), torch.ones(4, dtype=torch.float64))
    assert bool(((x[:, 13:] >= 0.1046) & (x[:, 13:] <= 6.0)).all())


def test_hover_is_an_equilibrium_of_plant_and_planner() -> None:
    frame = Airframe()
    rest = torch.zeros(1, 17, dtype=torch.float64)
    rest[0, 6], rest[0, 13:] = 1.0, frame.mass * 9.81 / 4
    speed = torch.full((1, 4), 5000.0, dtype=torch.float64)
    torch.testing.assert_close(QuadrotorPlant().step(rest, speed), rest, rtol=0, atol=1e-12)
    plan = torch.cat((rest[:, :13], torch.full((1, 1), 9.81, dtype=torch.float64)), dim=-1)
    u = torch.tensor([[0.0, 0, 0, 9.81]], dtype=torch.float64)
    torch.testing.assert_close(QuadrotorPlanning().step(plan, u), plan, rtol=0, atol=1e-12)


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


def test_parameters_per_element() -> None:
    """A batch of vehicles with different coefficients steps as each does alone."""
    drag = torch.tensor([5.0, 10.0, 20.0], dtype=torch.float64)
    model = Planar(drag=drag)
    x, u = states_of(model)
    together, (fx, fu) = model.step(x, u), model.jacobians(x, u)
    for b in range(3):
        alone = Planar(drag=float(drag[b]))
        torch.testing.assert_close(together[b], alone.step(x[b], u[b]), rtol=1e-14, atol=1e-14)
        torch.testing.assert_close(fx[b], alone.jacobians(x[b], u[b])[0], rtol=1e-14, atol=1e-14)
    auto = model.autodiff_jacobians(x, u)
    torch.testing.assert_close(fx, auto[0])
    torch.testing.assert_close(fu, auto[1])
    half = model.take(torch.tensor([2, 0]))
    torch.testing.assert_close(half.step(x[[2, 0]], u[[2, 0]]), together[[2, 0]])


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Planar(dt=0.0), "planar.dt"),
        (lambda: QuadrotorPlanning(integrator="heun"), "quadrotor.integrator"),
        (lambda: Airframe(mass=-1.0), "airframe.mass"),
        (lambda: Airframe(thrust_min=7.0), "airframe.thrust_min"),
    ],
)
def test_bad_parameters_are_named(make, field) -> None:
    with pytest.raises(InputError, match=field):
        make()
