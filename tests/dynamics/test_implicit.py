"""Implicit steps: against SciPy's Radau and finite differences, in PyTorch and in C; algebraic states; what fails."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import ControlBounds, FreeTime, FunctionDynamics, Problem, QuadraticCost, kernels
from torchgco.base.autodiff import gradient_and_hessian, jacobian
from torchgco.base.errors import InputError
from torchgco.dynamics.base import IMPLICIT, INTEGRATORS
from torchgco.judging.steps import ORDER_OF
from torchgco.native.compiler import find_compiler

compiled = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
METHODS = list(IMPLICIT)


@pytest.fixture(autouse=True)
def double_precision():
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(default)
    kernels.use_native(True)


def van_der_pol(x: Tensor, u: Tensor, stiffness: float = 100.0) -> Tensor:
    (y, v), w = x.unbind(-1), u[..., 0]
    return torch.stack((v, stiffness * ((1.0 - y * y) * v + w) - y), dim=-1)


def robertson(x: Tensor, u: Tensor) -> Tensor:
    a, b, c = x.unbind(-1)  # b: 1e4 times its share
    first, second, third = 0.04 * (1.0 + u[..., 0]) * a, b * c, 0.3 * b * b
    return torch.stack((second - first, 1e4 * (first - second - third), third), dim=-1)


def lagging(x: Tensor, u: Tensor, rate: float = 100.0) -> Tensor:
    return torch.stack((x[..., 1], x[..., 2], rate * (u[..., 0] - x[..., 2])), dim=-1)


def oscillator(stiffness: float = 100.0, integrator: str = "radau5", B: int = 1) -> Problem:
    """Steering a Van der Pol oscillator to 1.2: its true cost is 4.3022 at 100 and 4.3112 at 1,000."""
    model = FunctionDynamics(lambda x, u: van_der_pol(x, u, stiffness), n=2, m=1, dt=0.05, integrator=integrator)
    starts = torch.tensor([[2.0, 0.0]]) + 0.2 * torch.randn(B, 2, generator=torch.Generator().manual_seed(3)) * (B > 1)
    cost = QuadraticCost(Q=[1.0, 0.0], R=[0.1], Qf=[10.0, 0.0], x_ref=[1.2, 0.0])
    return Problem(model, cost, [ControlBounds(-2.0, 2.0)], starts, N=40)


def exact_cost(problem: Problem, U: Tensor) -> float:
    """Of a first problem's controls, each held, by SciPy's Radau."""
    x, total, cost = problem.x0[:1].clone(), 0.0, problem.cost
    for k in range(problem.N):
        u = U[:1, k]
        total += float(cost.take(slice(0, 1)).stage(x, u, k))
        rates = lambda t, z, u=u: problem.dynamics.field(torch.tensor(z)[None], u)[0].numpy()
        end = solve_ivp(rates, (0.0, problem.dynamics.dt), x[0].numpy(), method="Radau", rtol=1e-9, atol=1e-11)
        x = torch.tensor(end.y[:, -1])[None]
    return total + float(cost.take(slice(0, 1)).terminal(x))


@pytest.mark.parametrize("method", METHODS)
def test_a_step_has_its_order(method: str) -> None:
    x, u = torch.tensor([[2.0, -0.6], [1.5, 0.3]]), torch.tensor([[0.5], [-0.2]])
    rates = lambda z: van_der_pol(z, u, 2.0)
    errors = []
    for steps in (8, 16):
        z = x
        for _ in range(steps):
            z = INTEGRATORS[method](rates, z, 1.0 / steps)
        exact = [
            solve_ivp(
                lambda t, z, i=i: van_der_pol(torch.tensor(z), u[i], 2.0).numpy(), (0.0, 1.0), x[i].numpy(),
                method="DOP853", rtol=1e-13, atol=1e-13,
            ).y[:, -1]
            for i in range(2)
        ]  # fmt: skip
        errors.append(float((z - torch.tensor(np.array(exact))).abs().max()))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(ORDER_OF[method], abs=0.35)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("field", mostly([van_der_pol, robertson, lagging], robertson))
def test_derivatives_are_those_of_the_implicit_function(method: str, field) -> None:
    n = {van_der_pol: 2, robertson: 3, lagging: 3}[field]
    generator = torch.Generator().manual_seed(7)
    x, u = 0.3 + torch.rand(4, n, generator=generator), torch.rand(4, 1, generator=generator)
    step = lambda x, u: INTEGRATORS[method](lambda z: field(z, u), x, 0.05)
    fx, fu = jacobian(step, x, u)
    z, h = torch.cat((x, u), -1), 1e-6
    of = lambda z: step(z[..., :n], z[..., n:])
    for i in range(n + 1):
        e = h * torch.eye(n + 1)[i]
        slope = (of(z + e) - of(z - e)) / (2.0 * h)
        assert torch.allclose(torch.cat((fx, fu), -1)[..., i], slope, rtol=1e-5, atol=1e-6)
    weights = torch.linspace(0.5, 1.5, n)
    _, hessian = gradient_and_hessian(lambda z: (weights * of(z)).sum(-1), z)
    for i in range(n + 1):
        e = 1e-5 * torch.eye(n + 1)[i]
        slope = (jacobian(of, z + e)[0] - jacobian(of, z - e)[0]).mul(weights[:, None]).sum(-2) / 2e-5
        assert torch.allclose(hessian[..., i], slope, rtol=1e-4, atol=1e-4 * float(hessian.abs().max()))


@pytest.mark.slow
@compiled
@pytest.mark.parametrize(
    ("stiffness", "least"), mostly([(100.0, 4.3022), (1000.0, 4.3112)], (100.0, 4.3022), several=True)
)
def test_a_stiff_oscillator_costs_what_it_says(stiffness: float, least: float) -> None:
    problem = oscillator(stiffness)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = torchgco.solve(problem)
    assert solution.statuses[0].name == "CONVERGED"
    assert float(solution.cost) == pytest.approx(least, rel=1e-3)
    assert exact_cost(problem, solution.U) == pytest.approx(float(solution.cost), rel=1e-3)


@compiled
def test_a_problem_does_not_depend_on_its_batch() -> None:
    whole = torchgco.solve(oscillator(B=11), verbose=False)
    for i in (0, 4, 10):
        alone = torchgco.solve(oscillator(B=11).take(slice(i, i + 1)), verbose=False)
        assert torch.equal(alone.U[0], whole.U[i]) and torch.equal(alone.X[0], whole.X[i])


@pytest.mark.slow
@compiled
@pytest.mark.parametrize("method", mostly(METHODS, "radau3", "radau5"))
def test_c_and_pytorch_find_the_same(method: str) -> None:
    problem = replace(oscillator(integrator=method, B=2), N=6)
    in_c = torchgco.solve(problem, solver="al_ilqr", verbose=False)
    kernels.use_native(False)
    in_pytorch = torchgco.solve(problem, solver="al_ilqr", verbose=False)
    assert torch.allclose(in_c.U, in_pytorch.U, atol=1e-6)
    assert torch.allclose(in_c.cost, in_pytorch.cost, rtol=1e-9)


@pytest.mark.slow
@compiled
def test_a_lag_is_flown_as_it_is_planned() -> None:
    model = FunctionDynamics(lagging, n=3, m=1, dt=0.1, integrator="radau5")
    cost = QuadraticCost(Q=[0.0] * 3, R=[0.01], Qf=[100.0, 100.0, 0.0], x_ref=[1.0, 0.0, 0.0])
    problem = Problem(model, cost, [ControlBounds(-1.0, 1.0)], torch.zeros(1, 3), N=40)
    solution = torchgco.solve(problem, verbose=False)
    assert exact_cost(problem, solution.U) == pytest.approx(float(solution.cost), rel=1e-3)
    explicit = replace(problem, dynamics=replace(model, integrator="rk4"))
    with pytest.warns(torchgco.StepWarning):
        torchgco.solve(explicit, verbose=False)


def pendulum(x: Tensor, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """A mass on a rod with its force as the algebraic state: the constraint on the velocity's derivative, index 1."""
    (px, py, vx, vy), force, turn = x.unbind(-1), z[..., 0], u[..., 0]
    ax, ay = -force * px - turn * py, -force * py + turn * px - 9.81
    return torch.stack((vx, vy, ax, ay), -1), (vx * vx + vy * vy + px * ax + py * ay).unsqueeze(-1)


def pendulum_on_its_circle(x: Tensor, z: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The same with position and velocity on the circle, index 2 (Gear, Gupta and Leimkuhler, 1985)."""
    (px, py, vx, vy), (force, push), turn = x.unbind(-1), z.unbind(-1), u[..., 0]
    ax, ay = -force * px - turn * py, -force * py + turn * px - 9.81
    on_circle = torch.stack((px * px + py * py - 1.0, px * vx + py * vy), -1)
    return torch.stack((vx - push * px, vy - push * py, ax, ay), -1), on_circle


def swing_up(function, algebraic: int, integrator: str = "radau5") -> Problem:
    model = FunctionDynamics(function, n=4, m=1, dt=0.05, integrator=integrator, algebraic=algebraic)
    cost = QuadraticCost(Q=[0.0] * 4, R=[0.01], Qf=[100.0, 100.0, 10.0, 10.0], x_ref=[0.0, 1.0, 0.0, 0.0])
    return Problem(model, cost, [ControlBounds(-6.0, 6.0)], torch.tensor([[0.0, -1.0, 0.0, 0.0]]), N=60)


@pytest.mark.sampled(0)
@compiled
@pytest.mark.parametrize(("function", "count", "drift"), [(pendulum_on_its_circle, 2, 1e-8), (pendulum, 1, 1e-5)])
def test_algebraic_states(function, count: int, drift: float) -> None:
    problem = swing_up(function, count)
    solution = torchgco.solve(problem, solver="interior_point", U0=torch.full((1, 60, 1), 0.5), verbose=False)
    assert float(solution.cost) == pytest.approx(3.6551, rel=1e-4)
    assert float((solution.X[..., :2].norm(dim=-1) - 1.0).abs().max()) < drift
    if count == 1:  # of index 1, the force is a function of state and control
        z = problem.dynamics.algebraic_states(solution.X[:, :-1], solution.U)
        assert float(pendulum(solution.X[:, :-1], z, solution.U)[1].abs().max()) < 1e-9


@pytest.mark.slow
@compiled
def test_free_time_and_gradients() -> None:
    problem = replace(oscillator(), time=FreeTime(least=0.5, most=2.0, weight=1.0))
    assert torchgco.solve(problem, verbose=False).statuses[0].name == "CONVERGED"

    def cost_of(stiffness: Tensor) -> Tensor:
        field = lambda x, u, stiffness: van_der_pol(x, u, stiffness)
        values = {"stiffness": stiffness}
        model = FunctionDynamics(field, n=2, m=1, dt=0.05, integrator="radau5", values=values)
        problem = replace(oscillator(), dynamics=model)
        return torchgco.solve(problem, solver="interior_point", verbose=False).U[0, 3:9].sum()

    stiffness = torch.tensor([100.0], requires_grad=True)
    cost_of(stiffness).backward()
    with torch.no_grad():
        slope = (cost_of(stiffness + 0.01) - cost_of(stiffness - 0.01)) / 0.02
    assert float(stiffness.grad) == pytest.approx(float(slope), rel=1e-3)


@compiled
@pytest.mark.parametrize("peer", ["ipopt", "fatrop"])
def test_peers_solve_the_same_collocation(peer: str) -> None:
    problem = oscillator()
    ours = torchgco.solve(problem, solver="interior_point", verbose=False)
    assert torch.allclose(torchgco.solve(problem, solver=peer, verbose=False).cost, ours.cost, rtol=1e-6)


@pytest.mark.slow
@compiled
def test_a_step_without_a_root_is_not_finite() -> None:
    """x' = x^2 + 1 has, over a second, no implicit Euler step from 1."""
    model = FunctionDynamics(lambda x, u: x * x + 1.0 + u, n=1, m=1, dt=1.0, integrator="implicit_euler")
    assert bool(model.step(torch.ones(1, 1), torch.zeros(1, 1)).isnan().all())
    starts = torch.tensor([[1.0], [-1.0]])
    problem = Problem(model, QuadraticCost(Q=[1.0], R=[1.0], Qf=[1.0]), [ControlBounds(-3.0, 3.0)], starts, N=3)
    U0 = torch.tensor([0.0, -1.0])[:, None, None].expand(2, 3, 1)
    solution = torchgco.solve(problem, solver="interior_point", U0=U0, verbose=False)
    assert solution.statuses[1].name == "CONVERGED"


@pytest.mark.parametrize("native", [pytest.param(True, marks=compiled), False])
def test_roots_are_found_where_slopes_change(native: bool) -> None:
    """z^3 + z = x has one root, whose slope grows from 1 to 7 or more on the way from 0."""
    starts = torch.linspace(-4.0, 4.0, 801).unsqueeze(-1)
    cubic = lambda x, z, u: (z + 0.0 * u, z**3 + z - x)
    model = FunctionDynamics(cubic, n=1, m=1, dt=0.1, integrator="euler", algebraic=1)
    problem = Problem(model, QuadraticCost(Q=[1.0], R=[1.0], Qf=[1.0]), [], starts, N=1)
    kernels.use_native(native)
    z = (kernels.open_loop(problem, torch.zeros(801, 1, 1))[:, 1] - starts) / 0.1
    assert float((z**3 + z - starts).abs().max()) < 1e-12
    with pytest.raises(InputError, match="algebraic"):
        replace(model, algebraic=0).algebraic_states(starts, starts)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"integrator": "gauss"}, "radau5"),
        ({"algebraic": -1}, "algebraic"),
        ({"algebraic": 1}, "shapes"),
        ({"algebraic": 2, "function": pendulum}, "shapes"),
        ({"algebraic": 1, "integrator": "none", "function": pendulum}, "integrator"),
    ],
)
def test_wrong_use_is_told(change: dict, word: str) -> None:
    given = {"function": lambda x, u, *more: x, "n": 4, "m": 1, "dt": 0.1, "integrator": "radau5"} | change
    with pytest.raises(InputError, match=word):
        cost = QuadraticCost(Q=[1.0] * 4, R=[1.0], Qf=[1.0] * 4)
        Problem(FunctionDynamics(**given), cost, [], torch.ones(1, 4), N=4)
