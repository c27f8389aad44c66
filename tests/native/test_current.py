"""A solve uses a user's code as it is at that moment: no kernel of other dynamics, costs, constraints or values."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import engine_of
from torchgco import (
    Boxes,
    ControlBounds,
    Cost,
    Dynamics,
    FunctionConstraint,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    certify,
    judge,
)
from torchgco.base.shapes import lead
from torchgco.kernels import EagerWarning, choice
from torchgco.native import engine
from torchgco.native.identity import signature

D = torch.float64
N = 25
X0 = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.1, 0.0]], dtype=D)
WEIGHTS = QuadraticCost(Q=[1, 1, 0, 0], R=[0.1, 0.1], Qf=[50, 50, 1, 1], x_ref=[4, 1, 0, 0])


@dataclass(frozen=True)
class Boat(Dynamics):
    drag: float | Tensor = 0.2
    dt: float = 0.1
    integrator: str = "rk4"
    n, m, position = 4, 2, slice(0, 2)
    per_element = ("drag",)

    def field(self, x: Tensor, u: Tensor) -> Tensor:
        v = x[..., 2:]
        return torch.cat((v, u - lead(self.drag, v) * v), dim=-1)


@dataclass(frozen=True)
class Toward(Cost):
    target: float = 1.0

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return (x[..., :2] - self.target).square().sum(-1) + 0.1 * u.square().sum(-1)

    def terminal(self, x: Tensor) -> Tensor:
        return 50.0 * (x[..., :2] - self.target).square().sum(-1)


def field(x: Tensor, u: Tensor, drag: Any = 0.2) -> Tensor:
    return torch.cat((x[..., 2:], u - drag * x[..., 2:]), dim=-1)


def boat(function: Callable[..., Tensor] = field, constraints: Any = (), cost: Cost = WEIGHTS, **more: Any) -> Problem:
    dynamics = FunctionDynamics(function, 4, 2, 0.1, position=slice(0, 2), **more)
    return Problem(dynamics, cost, list(constraints), X0, N)


def same(problem: Problem, fresh: Problem) -> None:
    """Both problems have the same solution, and the native one is that of PyTorch's own rollout and cost."""
    one, other = torchgco.solve(problem), torchgco.solve(fresh)
    assert torch.equal(one.X, other.X) and torch.equal(one.cost, other.cost)
    eager = torchgco.dynamics.rollout.open_loop(fresh.dynamics, fresh.x0, one.U)
    torch.testing.assert_close(one.X, eager, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(one.cost, fresh.cost.total(one.X, one.U), rtol=1e-12, atol=1e-12)


BASE = Problem(Boat(), WEIGHTS, [ControlBounds(-3, 3)], X0, N)
SPEED = [FunctionConstraint(lambda x: x[..., 2:3] - 1.0)]


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("base", "change"),
    [
        (BASE, {"dynamics": Boat(drag=3.0)}),
        pytest.param(BASE, {"dynamics": Boat(dt=0.2)}, marks=pytest.mark.slow),
        pytest.param(BASE, {"dynamics": Boat(integrator="euler")}, marks=pytest.mark.slow),
        (BASE, {"dynamics": FunctionDynamics(lambda x, u: field(x, u.flip(-1)), 4, 2, 0.1, position=slice(0, 2))}),
        (BASE, {"cost": replace(WEIGHTS, Q=[[2, 1, 0, 0], [1, 2, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])}),
        (BASE, {"cost": Toward(2.0)}),
        (Problem(Boat(), Toward(1.0), [], X0, N), {"cost": Toward(2.0)}),
        (Problem(Boat(), WEIGHTS, SPEED, X0, N), {"constraints": [FunctionConstraint(lambda x: x[..., 2:3] - 0.5)]}),
        (Problem(Boat(), WEIGHTS, SPEED, X0, N), {"constraints": [replace(SPEED[0], knots=[3, 4])]}),
    ],
    ids=["parameter", "dt", "integrator", "another model", "dense", "another cost", "target", "limit", "knots"],
)
def test_started_at_with_other_parts_solves_these(base: Problem, change: dict[str, Any]) -> None:
    torchgco.solve(base)  # compiles the former kernels
    x0 = X0 + 0.1
    parts = {"constraints": base.constraints, "cost": base.cost, "dynamics": base.dynamics} | change
    same(base.started_at(x0, **{"constraints": base.constraints} | change), Problem(x0=x0, N=N, **parts))


def test_started_at_refuses_dynamics_that_do_not_fit() -> None:
    with pytest.raises(InputError, match="dynamics: expected 4 states and 2 controls, got 6 and 2"):
        BASE.started_at(X0, BASE.constraints, dynamics=Planar())
    with pytest.raises(InputError, match="dynamics: expected a Dynamics, got int"):
        BASE.started_at(X0, BASE.constraints, dynamics=5)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"cost\.stage"):
        BASE.started_at(X0, BASE.constraints, cost=Scalar())


class Memory:
    """Values that a function captures, in several kinds, each with a way to change it."""

    def __init__(self) -> None:
        self.number = 0.2
        self.tensor, self.data = torch.tensor(0.2, dtype=D), torch.tensor(0.2, dtype=D)
        self.array = np.array(0.2)
        self.module = torch.nn.Linear(1, 1, bias=False, dtype=D)
        torch.nn.init.constant_(self.module.weight, 0.2)

    def set_number(self) -> None:
        self.number = 2.0

    def set_tensor(self) -> None:
        self.tensor.fill_(2.0)

    def set_data(self) -> None:
        self.data.data = torch.tensor(2.0, dtype=D)

    def set_array(self) -> None:
        self.array[...] = 2.0

    def set_module(self) -> None:
        with torch.no_grad():
            self.module.weight.fill_(2.0)


READ: dict[str, Callable[[Memory, Tensor], Tensor]] = {
    "number": lambda memory, v: memory.number * v,
    "tensor": lambda memory, v: memory.tensor * v,
    "data": lambda memory, v: memory.data * v,
    "array": lambda memory, v: torch.from_numpy(memory.array) * v,  # shares its memory
    "module": lambda memory, v: memory.module(v.unsqueeze(-1)).squeeze(-1),
}


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("place", "kind"),
    [*(("dynamics", kind) for kind in READ), ("cost", "number"), ("cost", "tensor"), ("constraint", "array")],
)
def test_captured_values_are_those_of_the_solve(place: str, kind: str) -> None:
    memory, read = Memory(), READ[kind]

    class Drags(Cost):
        def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
            return (read(memory, x) + 1.0).square().sum(-1) + u.square().sum(-1)

        def terminal(self, x: Tensor) -> Tensor:
            return 50.0 * (x[..., :2] - 1.0).square().sum(-1)

    def made() -> Problem:
        if place == "dynamics":
            return boat(lambda x, u: torch.cat((x[..., 2:], u - read(memory, x[..., 2:])), dim=-1))
        if place == "cost":
            return boat(cost=Drags())
        return boat(constraints=[FunctionConstraint(lambda x: read(memory, x[..., 2:3]) - 0.5)])

    problem = made()
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        before = torchgco.solve(problem)
        getattr(memory, f"set_{kind}")()
        assert not torch.equal(torchgco.solve(problem).X, before.X)
        same(problem, made())


def test_kernels_are_those_of_the_same_computation_only() -> None:
    first, again = engine_of(BASE.renewed()), engine_of(BASE.renewed())
    assert first is not None and again is not None and first.captured is again.captured
    planar = Problem(Planar(drag=torch.tensor([1.0, 2.0], dtype=D)), QuadraticCost([1] * 6, [1, 1], [1] * 6), [],
                     torch.zeros(2, 6, dtype=D), N)  # fmt: skip
    other = planar.started_at(planar.x0 + 1, (), dynamics=Planar(drag=torch.tensor([5.0, 7.0], dtype=D)))
    key = lambda problem: found.key if (found := signature(problem)) is not None else None
    assert key(planar) == key(other) is not None
    shared = planar.started_at(planar.x0, (), dynamics=Planar(drag=3.0))
    assert key(shared) not in (key(planar), None)
    boxed = Problem(planar.dynamics, planar.cost, [Boxes([[9.0, 9.0]], [[1.0, 1.0]])], planar.x0, N)
    assert key(boxed) != key(planar)
    reader = open(__file__)  # noqa: SIM115
    assert signature(boat(lambda x, u: field(x, u) if reader else u)) is None
    reader.close()


@pytest.mark.parametrize("solver", ["gco", "gco_paper", "al_ilqr", "interior_point"])
def test_a_solve_traces_a_model_once(monkeypatch, solver: str) -> None:
    traced: list[Problem] = []
    trace = engine.trace_model
    monkeypatch.setattr(engine, "trace_model", lambda problem: traced.append(problem) or trace(problem))
    far = torchgco.Spheres([[2.0, 0.4], [50.0, 50.0], [60.0, 50.0], [70.0, 50.0]], [0.3] * 4, 0.1)
    problem = boat(constraints=[ControlBounds(-3, 3), far])
    first = torchgco.solve(problem, solver=solver)
    torchgco.solve(problem, solver=solver, warm=first)
    torchgco.solve(problem, first.U, solver)
    assert len(traced) <= 1  # in an earlier test, maybe
    clock = boat(lambda x, u: field(x, u) if time.time() > 0.0 else u, [ControlBounds(-3, 3), far])
    torchgco.solve(clock, solver=solver)
    torchgco.solve(clock, solver=solver)
    assert len(traced) <= 3


class Scalar(Cost):
    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return u.square().sum()

    def terminal(self, x: Tensor) -> Tensor:
        return x.square().sum(-1)


class WithoutEnd(Toward):
    def terminal(self, x: Tensor) -> Any:
        return 0.0


class Coupled(Toward):
    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return super().stage(x - x.mean(0), u, k)


class WrongSlope(Boat):
    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        fx, fu = super().jacobians(x, u)
        return fx, 2.0 * fu


DROPOUT = torch.nn.Sequential(torch.nn.Linear(6, 4, dtype=D), torch.nn.Dropout(0.5))
GOALS = torch.tensor([[1.0, 0.0], [2.0, 1.0]], dtype=D)
MISTAKES: dict[str, tuple[Callable[[], Problem], str]] = {
    "one derivative for four": (
        lambda: boat(lambda x, u: u[..., :1]), r"dynamics.field: expected derivatives \(..., 4\)",
    ),
    "one cost for all": (
        lambda: boat(cost=Scalar()),
        "cost.stage: expected a number in torch.float64, the type of x0, per state",
    ),
    "no tensor": (lambda: boat(cost=WithoutEnd()), "cost.terminal: .* got float"),
    "problems coupled": (lambda: boat(cost=Coupled()), "cost.stage: expected values of a problem that depend on its"),
    "wrong Jacobian": (
        lambda: Problem(WrongSlope(), WEIGHTS, [], X0, N), "dynamics.step: expected a function with derivatives",
    ),
    "NumPy in a model": (
        lambda: boat(lambda x, u: field(x, torch.tensor(np.sin(u.detach().numpy())))), "dynamics.step: .*Tensor.numpy",
    ),
    "NumPy in a cost": (
        lambda: boat(cost=ByNumPy()), "cost.stage: .*Tensor.numpy",
    ),
    "NumPy in a constraint": (
        lambda: boat(constraints=[FunctionConstraint(lambda x: torch.tensor(x.detach().numpy()[..., :1]))]),
        "constraint.function: .*Tensor.numpy",
    ),
    "dropout": (lambda: boat(lambda x, u: DROPOUT(torch.cat((x, u), dim=-1))), "dynamics.field: .*draws at random"),
    "random numbers": (lambda: boat(lambda x, u: field(x, u) + torch.randn(4, dtype=D)), "draws at random"),
    "NumPy's random numbers": (
        lambda: boat(lambda x, u: field(x, u, float(np.random.rand()))), "dynamics.field: .*draws at random",
    ),
    "a goal per row": (
        lambda: boat(constraints=[FunctionConstraint(lambda x: x[..., :2] - GOALS.unsqueeze(1))]),
        "constraint.function: expected values of a problem that depend on its own row",
    ),
    "unknown value": (lambda: boat(values={"mass": [1, 2]}), r"dynamics.values\['mass'\]: .*doesn't take"),
    "too few values": (lambda: boat(values={"drag": [1.0]}), r"dynamics.values\['drag'\]: expected shape \(2, ...\)"),
}  # fmt: skip


class ByNumPy(Toward):
    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return torch.as_tensor(np.square(x.detach().numpy())).sum(-1) + u.square().sum(-1)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_a_users_code_ends_in_one_line(mistake: str) -> None:
    make, line = MISTAKES[mistake]
    with pytest.raises(InputError, match=line) as caught:
        make()
    assert "\n" not in str(caught.value)


class InNumPy(Boat):
    """The step in NumPy, with its own derivatives."""

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        x, u = x.numpy(), u.numpy()
        return torch.from_numpy(np.concatenate((x[..., :2] + self.dt * x[..., 2:], x[..., 2:] + self.dt * u), axis=-1))

    def jacobians(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        fx = torch.eye(4, dtype=D) + self.dt * torch.eye(4, dtype=D).roll(2, 1).triu()
        fu = self.dt * torch.eye(4, dtype=D)[:, 2:]
        return fx.expand(*x.shape[:-1], 4, 4), fu.expand(*x.shape[:-1], 4, 2)


def test_numpy_with_derivatives_of_its_own_is_solved_by_pytorch() -> None:
    problem = Problem(InNumPy(), WEIGHTS, [], X0, N)
    with pytest.warns(EagerWarning, match="dynamics.step: .*hands its tensors to NumPy"):
        eager = torchgco.solve(problem)
    native = Problem(Boat(drag=0.0, integrator="euler"), WEIGHTS, [], X0, N)
    torch.testing.assert_close(eager.X, torchgco.solve(native).X, rtol=1e-8, atol=1e-8)


def test_constants_may_be_read_by_numpy() -> None:
    table = torch.tensor([0.1, 0.3], dtype=D)
    problem = boat(lambda x, u: field(x, u, float(np.mean(table.numpy()))))
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        torch.testing.assert_close(torchgco.solve(problem).X, torchgco.solve(boat()).X, rtol=1e-9, atol=1e-9)


class Custom(torch.autograd.Function):
    """A function that `torch.autograd` differentiates, and `torch.func` doesn't."""

    @staticmethod
    def forward(ctx, u):
        return 2.0 * u

    @staticmethod
    def backward(ctx, grad):
        return 2.0 * grad


def test_code_that_only_autograd_differentiates_is_named() -> None:
    problem = boat(lambda x, u: field(x, Custom.apply(u)))
    with pytest.raises(InputError, match=r"dynamics.step: expected a function that torch.func can differentiate"):
        torchgco.solve(problem)


@pytest.mark.parametrize("origin", [0.0, 2e5, 4e6])
def test_large_coordinates_in_single_precision_are_no_mistake(origin: float) -> None:
    near = lambda x: (x[..., :2] - (origin + 3.0)).square().sum(-1)
    cost = torchgco.FunctionCost(lambda x, u: near(x) + u.square().sum(-1), near)
    x0 = torch.tensor([[origin, origin, 0.0, 0.0]])
    for stages in (5, 20, 44):
        Problem(FunctionDynamics(field, 4, 2, 0.1, position=slice(0, 2)), cost, [], x0, stages)


def test_started_at_binds_moving_obstacles_to_the_new_time_step() -> None:
    sphere = torchgco.Spheres([[2.0, 1.5]], [0.5], 0.1, velocities=[[0.0, -1.0]])
    base = Problem(Boat(), WEIGHTS, [sphere], X0, N)
    moved = base.started_at(X0, [sphere], dynamics=Boat(dt=0.3))
    assert moved.constraints[0].dt == 0.3
    with pytest.raises(InputError, match=r"constraints\[0\]: expected obstacles for steps of 0.3 s"):
        base.started_at(X0, base.constraints, dynamics=Boat(dt=0.3))


def test_started_at_with_another_cost_has_its_goal() -> None:
    there = replace(WEIGHTS, x_ref=[-4, 0, 0, 0])
    moved, fresh = BASE.started_at(X0, BASE.constraints, cost=there), Problem(Boat(), there, [], X0, N)
    assert moved.goal is not None and fresh.goal is not None
    assert torch.equal(moved.goal.position, fresh.goal.position)
    assert torch.equal(BASE.started_at(X0.tolist(), BASE.constraints).x0, X0)


@pytest.mark.parametrize("device", ["meta", "cpu"])
def test_another_default_device_changes_nothing(device: str) -> None:
    expected = torchgco.solve(BASE)
    verdict = judge(BASE, expected.U, [4.0, 1.0], 0.5)
    torch.set_default_device(device)
    try:
        problem = Problem(Boat(), WEIGHTS, [ControlBounds(-3, 3), *SPEED[:0]], X0, N)
        found, again = torchgco.solve(problem), judge(problem, expected.U, [4.0, 1.0], 0.5)
        residual = certify(problem, found.X, found.U).dynamics_residual
    finally:
        torch.set_default_device(None)
    assert torch.equal(found.X, expected.X) and torch.equal(again.clearance, verdict.clearance)
    assert float(residual.max()) < 1e-12


@pytest.mark.parametrize("native", [True, False])
def test_a_module_with_trainable_parameters_is_a_model(native: bool) -> None:
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(6, 8), torch.nn.Tanh(), torch.nn.Linear(8, 4)).double()
    problem = boat(lambda x, u: field(x, u) + 0.1 * network(torch.cat((x, u), dim=-1)))
    torchgco.kernels.use_native(native)
    try:
        with torch.no_grad():
            solution = torchgco.solve(problem, solver=torchgco.presets.al_ilqr(problem))
    finally:
        torchgco.kernels.use_native(True)
    assert not solution.X.requires_grad and not solution.cost.requires_grad
    assert float(certify(problem, solution.X, solution.U).dynamics_residual.max()) < 1e-9
    assert bool(torch.isfinite(judge(problem, solution.U, [4.0, 1.0], 0.5).cost).all())


def test_what_is_made_of_torchgcos_own_parts_stays_while_their_numbers_do(monkeypatch) -> None:
    sought: list[Problem] = []
    seek = choice._engine
    monkeypatch.setattr(choice, "_engine", lambda problem: sought.append(problem) or seek(problem))
    x0 = torch.zeros(2, 6, dtype=D)
    parts = [ControlBounds([-3.0, -3.0], [3.0, 3.0]), torchgco.Spheres([[0.6, 0.5]], [0.1], 0.1)]
    problem = Problem(Planar(dt=0.1), QuadraticCost([1] * 6, [1, 1], [9] * 6, x_ref=[1, 1, 0, 0, 0, 0]), parts, x0, N)
    first, again = torchgco.solve(problem), torchgco.solve(problem)
    assert len(sought) == 1 and torch.equal(first.U, again.U)
    bounds: Any = problem.constraints[0]
    bounds.upper.fill_(0.2)  # numbers of its own, and unlike any that it was given
    tight = torchgco.solve(problem)
    assert len(sought) == 2 and float(tight.U.max()) <= 0.2 + 1e-6 < float(first.U.max())
    users = boat()
    torchgco.solve(users)
    torchgco.solve(users)
    assert len(sought) == 3
