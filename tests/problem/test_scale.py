"""A constant in a cost hides nothing, and lengths that the tolerance can't see are named."""

from __future__ import annotations

import warnings
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import (
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    ScaleWarning,
    Spheres,
    StateBounds,
    Status,
    kernels,
    presets,
)
from torchgco.costs.base import ShiftedCost
from torchgco.judging.worst import NO_PLACE, dwarfed
from torchgco.lagrangian.lagrangian import Lagrangian
from torchgco.solvers.ending import optimality

D = torch.float64


def swing_up(constant: float, B: int = 2) -> Problem:
    """A pendulum whose cost has a constant per stage."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 1:], 9.81 * x[..., :1].sin() + u), dim=-1)

    def stage(x: Tensor, u: Tensor) -> Tensor:
        return constant + (1.0 - x[..., 0].cos()) + 0.1 * x[..., 1].square() + 0.01 * u.square().sum(-1)

    x0 = torch.tensor([[3.1, 0.0], [2.0, 0.5], [1.0, 1.0]], dtype=D)[:B]
    cost = FunctionCost(stage, lambda x: 20.0 * (1.0 - x[..., 0].cos()) + x[..., 1].square())
    return Problem(FunctionDynamics(field, 2, 1, 0.05, "rk4"), cost, [], x0, 50)


@pytest.mark.parametrize(
    ("constant", "native"), mostly([(1e5, True), (-1e9, True), (-1e9, False)], (-1e9, False), several=True)
)
def test_a_constant_in_the_cost_hides_nothing(constant: float, native: bool) -> None:
    kernels.use_native(native)
    try:
        plain, shifted = (torchgco.solve(swing_up(c), solver=presets.gco(2)) for c in (0.0, constant))
    finally:
        kernels.use_native(True)
    assert plain.statuses == shifted.statuses
    own = swing_up(0.0).cost.total(shifted.X, shifted.U)
    torch.testing.assert_close(own, plain.cost, rtol=1e-3, atol=0)
    torch.testing.assert_close(shifted.cost, own + 50 * constant, rtol=1e-9, atol=0)


def test_the_unit_of_cost_does_not_see_constants() -> None:
    plain, shifted = swing_up(0.0), swing_up(1e6)
    assert bool((shifted.cost_unit < 3.0 * plain.cost_unit).all() & (shifted.cost_unit > plain.cost_unit / 3.0).all())
    assert not bool(plain.cost_scale.constant.any())
    assert isinstance(shifted.in_cost_units().cost, ShiftedCost)
    assert not isinstance(shifted.in_cost_units().in_cost_units().cost.cost, ShiftedCost)
    quadratic = QuadraticCost([1.0, 0.0], [1e-6], [1.0, 0.0], x_ref=[1e3, 0.0])
    far = Problem(plain.dynamics, quadratic, [], plain.x0, plain.N)
    assert not bool(far.cost_scale.constant.any())  # a quadratic cost has no constant


def test_a_trace_shows_costs_with_their_constant() -> None:
    problem = swing_up(1e5, B=1)
    solution = torchgco.AugmentedLagrangian(record=True).solve(problem, torch.zeros(1, 50, 1, dtype=D))
    assert solution.trace is not None
    assert abs(float(solution.trace["cost"].iloc[-1]) - float(solution.cost)) < 1e-6 * float(solution.cost)


def test_problems_with_and_without_a_constant_keep_their_bits_in_one_batch() -> None:
    constants = torch.tensor([0.0, 1e6, 3.0], dtype=D)

    def made(rows: slice) -> Problem:
        base = swing_up(0.0, B=3).take(rows)
        stage = lambda x, u, c: c + (1.0 - x[..., 0].cos()) + 0.01 * u.square().sum(-1)
        cost = FunctionCost(stage, lambda x: x.square().sum(-1), {"c": constants[rows]})
        return Problem(base.dynamics, cost, [], base.x0, base.N)

    whole = torchgco.solve(made(slice(0, 3)))
    for b in range(3):
        assert torch.equal(torchgco.solve(made(slice(b, b + 1))).U[0], whole.U[b])


@pytest.mark.parametrize(("radius", "warned"), [(0.004, True), (0.3, False)])
def test_obstacles_that_the_tolerance_cannot_see_are_named(radius: float, warned: bool, recwarn) -> None:
    base = swing_up(0.0)
    model = FunctionDynamics(base.dynamics.function, 2, 1, 0.05, "rk4", position=slice(0, 2))
    Problem(model, base.cost, [Spheres([[50.0, 50.0]], [radius], 0.001)], base.x0, base.N)
    found = [str(w.message) for w in recwarn if issubclass(w.category, torchgco.ScaleWarning)]
    assert len(found) == warned and all("0.005" in line and "0.001 m" in line for line in found)


@pytest.mark.parametrize("goal", [10.0, 1e3, 1e6])
def test_a_far_goal_is_no_constant(goal: float) -> None:
    base = swing_up(0.0)
    terminal = lambda x: 5e3 * ((x[..., 0] - goal).square() + x[..., 1].square())
    effort = lambda x, u: 0.1 * u.square().sum(-1)
    problem = Problem(base.dynamics, FunctionCost(effort, terminal), [], 0.0 * base.x0, 40)
    assert not bool(problem.cost_scale.constant.any())
    constant = FunctionCost(lambda x, u: 1e12 + 0.1 * u.square().sum(-1), terminal)
    assert bool(Problem(base.dynamics, constant, [], 0.0 * base.x0, 40).cost_scale.constant.all()) == (goal < 1e4)


def in_units(s: float, kind: str) -> Problem:
    """Sixteen drawn points with drag, where a metre is 1 / s units of length: the same costs whatever s is."""
    drag = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u - 0.3 * x[..., 2:]), -1), 4, 2, 0.2, "euler")
    x0 = torch.randn(16, 4, dtype=D, generator=torch.Generator().manual_seed(5)) * torch.tensor([0.5, 0.5, 0.2, 0.2])
    weights = {"Q": [1.0, 1.0, 0.1, 0.1], "R": [0.1, 0.1], "Qf": [20.0, 20.0, 1.0, 1.0]}
    cost = QuadraticCost(**{name: [w / s**2 for w in W] for name, W in weights.items()}, x_ref=[s, 0.0, 0.0, 0.0])
    slow = StateBounds([-9.0 * s, -9.0 * s, -0.5 * s, -0.5 * s], [9.0 * s, 9.0 * s, 0.5 * s, 0.5 * s], slice(5, 9))
    unit = {"s": torch.full((16, 1), s, dtype=D)}  # a value of each problem: one library serves all of them
    rows = {
        "controls": [ControlBounds(-s, s)],
        "states": [slow, ControlBounds(-2.0 * s, 2.0 * s)],
        "rows of order 1": [FunctionConstraint(lambda u, s: torch.cat((u / s, -u / s), -1) - 1.0, of="u", values=unit)],
        "norm": [FunctionConstraint(lambda u, s: (u.square() - 0.5 * s**2).sum(-1, keepdim=True), of="u", values=unit)],
    }[kind]
    return Problem(drag, cost, rows, s * x0, 8)


@pytest.mark.sampled(2)
@pytest.mark.filterwarnings("ignore::torchgco.ScaleWarning")
@pytest.mark.parametrize("kind", ["controls", "states", "rows of order 1", "norm"])
@pytest.mark.parametrize("native", mostly([True, False], False))
def test_small_units_change_no_answer(kind: str, native: bool) -> None:
    kernels.use_native(native)
    try:
        due = torchgco.solve(in_units(1.0, kind), solver="interior_point").cost
        for s in (1e-4, 1e-6) if kind == "norm" else (1e-4, 1e-6, 1e-7):  # 1e-14 of a square is within any tolerance
            found = torchgco.solve(in_units(s, kind), solver="interior_point")
            solved = found.status == Status.CONVERGED
            assert bool(solved.all()) or (s < 1e-5 and kind not in ("controls", "states"))
            torch.testing.assert_close(found.cost[solved], due[solved], rtol=1e-3, atol=0)
    finally:
        kernels.use_native(True)


@pytest.mark.parametrize("kind", ["controls", "states", "norm"])
def test_tolerances_that_are_large_beside_the_rows_are_named(kind: str) -> None:
    with pytest.warns(ScaleWarning, match="over 5% of the constraint's own values"):
        torchgco.solve(in_units(1e-6, kind), solver="al_ilqr")


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("s", "constant"), [(1e-3, 1.0), (1e-3, 1e3), (1e-4, 1.0), (1e-4, 10.0)])
def test_constants_hide_nothing_in_small_units_either(s: float, constant: float) -> None:
    base = in_units(s, "controls")
    away = torch.tensor([s, 0.0, 0.0, 0.0], dtype=D)
    weights = torch.tensor([1.0, 1.0, 0.1, 0.1], dtype=D)

    def made(more: float) -> Problem:
        stage = lambda x, u: 0.5 * (weights * (x - away).square()).sum(-1) + 0.05 * u.square().sum(-1) + more
        cost = FunctionCost(stage, lambda x: 10.0 * (weights * (x - away).square()).sum(-1))
        return Problem(base.dynamics, cost, base.constraints, base.x0, base.N)

    due, found = (torchgco.solve(made(more), solver="interior_point") for more in (0.0, constant))
    assert found.statuses == [Status.CONVERGED] * 16
    own = made(0.0).cost.total(found.X, found.U)
    torch.testing.assert_close(own, due.cost, rtol=5e-3, atol=0)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("size", [1e6, 1e8, 1e9])
@pytest.mark.parametrize("solver", ["gco", "interior_point", "gco_exact"])
def test_equality_rows_in_small_units_hide_no_curvature_of_the_cost(solver: str, size: float) -> None:
    """A fund in dollars: purchases sum to 0, costs are relative to the same fund in shares of its wealth."""

    def fund(wealth: float) -> Problem:
        weights = [[w / wealth**2] * 3 for w in (1.0, 5.0, 10.0)]
        cost = QuadraticCost(*weights, x_ref=[0.3 * wealth, 0.5 * wealth, 0.2 * wealth])
        parts = [
            FunctionConstraint(lambda u: u.sum(-1, keepdim=True), "equality", of="u"),
            ControlBounds(-0.2 * wealth, 0.2 * wealth),
        ]
        model = FunctionDynamics(lambda x, u: x + u, 3, 3, 1.0, "none")
        return Problem(model, cost, parts, torch.tensor([[wealth, 0.0, 0.0]], dtype=torch.float64), 10)

    expected = torchgco.solve(fund(1.0), solver="interior_point").cost
    found = torchgco.solve(fund(size), solver=solver)
    torch.testing.assert_close(found.cost, expected, rtol=1e-6, atol=0.0)
    assert found.statuses == [Status.CONVERGED] or (solver == "gco_exact" and size > 1e7)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("native", mostly([True, False], False))
@pytest.mark.parametrize("units", [(1.0, 1e6), (1e-3, 1.0), (1e-3, 1e3)])
def test_equality_rows_in_mixed_units_change_no_answer(units: tuple[float, float], native: bool) -> None:
    """Two balances, one in kilowatts and one in milliwatts, say, of three controls each."""

    def balanced(units: tuple[float, float], sums: Tensor) -> Problem:
        random = torch.Generator().manual_seed(1)
        number = lambda *shape: torch.rand(*shape, generator=random, dtype=D)
        s = torch.tensor([units[0]] * 3 + [units[1]] * 3, dtype=D)
        decay, w, r, aim = 0.9 + 0.1 * number(6), 0.5 + 4.0 * number(6), 0.3 + number(6), 2.0 * number(6) - 1.0
        away = lambda x, s: (w * (x / s - aim).square()).sum(-1)
        stage, last = lambda x, u, s: away(x, s) + (r * (u / s).square()).sum(-1), lambda x, s: 5.0 * away(x, s)
        rows = lambda u, s: (u / s).unflatten(-1, (2, 3)).sum(-1) * s[..., ::3] - sums * s[..., ::3]
        unit = {"s": s.unsqueeze(0)}
        parts = [FunctionConstraint(rows, "equality", of="u", values=unit), ControlBounds(-0.6 * s, 0.6 * s)]
        cost = FunctionCost(stage, last, unit)
        model = FunctionDynamics(lambda x, u: decay * x + 0.5 * u, 6, 6, 1.0, "none")
        return Problem(model, cost, parts, s * (2.0 * number(1, 6) - 1.0), 12)

    kernels.use_native(native)
    try:
        sums = torch.tensor([0.2, -0.1], dtype=D, requires_grad=True)
        due, found = (torchgco.solve(balanced(u, sums), solver="interior_point") for u in ((1.0, 1.0), units))
    finally:
        kernels.use_native(True)
    torch.testing.assert_close(found.cost, due.cost, rtol=1e-5, atol=0.0)
    assert found.statuses == [Status.CONVERGED] and bool(due.differentiable.all())
    assert bool(found.differentiable.all())
    aims = [one.X[0, 5] / one.X[0, 5].detach().abs() for one in (found, due)]
    slopes = [torch.autograd.grad((a * torch.arange(1.0, 7.0, dtype=D)).sum(), sums)[0] for a in aims]
    torch.testing.assert_close(*slopes, rtol=1e-4, atol=0.0)


def mixed(kind: str, states: Tensor, controls: Tensor) -> Problem:
    """A nonlinear plant whose states and controls, as drawn, are these units times the numbers of the problem."""
    random = torch.Generator().manual_seed(1)
    number = lambda *shape: torch.rand(*shape, generator=random, dtype=D)
    A, B, q, r, goal, x0 = (
        -0.3 * number(2, 2),
        0.5 + number(2, 2),
        0.2 + number(2),
        0.1 + number(2),
        number(2),
        number(2),
    )
    units = {"y": states.unsqueeze(0), "v": controls.unsqueeze(0)}
    rates = lambda x, u: x @ A.T + torch.tanh(u @ B.T) + 0.2 * x.sin()
    away = lambda x, y: (q * (x * y - goal).square()).sum(-1)
    cost = FunctionCost(
        lambda x, u, y, v: away(x, y) + (r * (u * v).square()).sum(-1), lambda x, y, v: 5.0 * away(x, y), units
    )
    ends = torch.stack((x0, goal))
    low, high = (ends.amin(0) - 0.02) / states, (ends.amax(0) + 0.02) / states
    rows = {
        "states": StateBounds(low, high, slice(1, None)),
        "product": FunctionConstraint(lambda x, u, y, v: (x * y * u * v)[..., :1] - 0.05, of="xu", values=units),
    }[kind]
    model = FunctionDynamics(lambda x, u, y, v: rates(x * y, u * v) / y, 2, 2, 0.1, "rk4", values=units)
    return Problem(model, cost, [rows], (x0 / states).unsqueeze(0), 15)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("native", mostly([True, False], False))
@pytest.mark.parametrize("kind", ["states", "product"])
@pytest.mark.parametrize("units", mostly([(1e4, 1.0), (1.0, 1e4), (1e3, 1e-3)], (1.0, 1e4), (1e3, 1e-3)))
def test_a_cost_is_scaled_by_the_sizes_of_its_variables(units: tuple[float, float], kind: str, native: bool) -> None:
    """Numbers of 1e-4 beside ordinary ones: curvatures of 1e8, by which the cost must not be divided."""
    plain = torch.ones(2, dtype=D)
    kernels.use_native(native)
    try:
        due = torchgco.solve(mixed(kind, plain, plain), solver="interior_point")
        large = torch.tensor(units, dtype=D)
        for states, controls in ((large, plain), (plain, large), (large, large)):
            found = torchgco.solve(mixed(kind, states, controls), solver="interior_point")
            assert found.statuses == due.statuses == [Status.CONVERGED]
            torch.testing.assert_close(found.cost, due.cost, rtol=1e-5, atol=0.0)
    finally:
        kernels.use_native(True)


@pytest.mark.slow
def test_constants_hide_no_cost_where_one_control_is_in_small_units() -> None:
    def problem(size: list[float], constant: float) -> Problem:
        units = torch.tensor(size, dtype=torch.float64)
        states = torch.cat((units, units))
        goal, weights = (torch.tensor(z, dtype=torch.float64) for z in ([1, 0.5, 0, 0], [1, 1, 0.1, 0.1]))
        stage = lambda x, u: constant + 0.1 * (u / units).square().sum(-1)
        last = lambda x: 20 * ((x / states - goal).square() * weights).sum(-1)
        model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.2)
        return Problem(model, FunctionCost(stage, last), [ControlBounds(-0.6 * units, 0.6 * units)], [[0.0] * 4], 10)

    expected = torchgco.solve(problem([1.0, 1.0], 0.0), solver="gco_exact").cost
    found = torchgco.solve(problem([1e-3, 1.0], 1e4))
    assert found.statuses == [Status.CONVERGED]
    assert bool((found.cost - 1e5 - expected).abs() < 1e-3 * expected)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("pressure", [1.0, 1e5, 1e7])
@pytest.mark.parametrize("solver", ["gco", "al_ilqr"])
def test_a_row_is_small_whatever_the_size_of_other_states(solver: str, pressure: float) -> None:
    """A vessel drains through a pipe, whose flow of some 1e-4 m^3/s passes its limit whatever the pump does."""
    flow = 1e-4

    def rates(x: Tensor, u: Tensor) -> Tensor:
        p, q = x[..., :1], x[..., 1:]
        return torch.cat((-0.1 * pressure * q / flow + 0.01 * pressure * u, 2.0 * (flow * p / pressure - q)), -1)

    cost = FunctionCost(lambda x, u: 0.1 * u.square().sum(-1), lambda x: 0.0 * x[..., 0])
    limit = FunctionConstraint(lambda x: x[..., 1:] - 0.3 * flow, knots=[8])
    model = FunctionDynamics(rates, 2, 1, 0.2, "rk4")
    problem = Problem(model, cost, [ControlBounds(-1.0, 1.0), limit], [[pressure, 0.0]], 15)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = torchgco.solve(problem, solver=solver, verbose=False)
    claims = found.statuses[0] in (Status.CONVERGED, Status.FEASIBLE)
    assert not claims or any(issubclass(one.category, ScaleWarning) for one in said)


@pytest.mark.filterwarnings("ignore:1 of 1 trajectories count as feasible")  # in single precision
@pytest.mark.parametrize("dtype", mostly([torch.float32, torch.float64], torch.float32))
def test_slopes_are_numbers_in_any_precision(dtype: torch.dtype) -> None:
    """What is left to save is measured by a regularisation as large as numbers can be: it must not overflow."""
    weights = [[w] * 3 for w in (1e-6, 5e-6, 1e-5)]
    parts = [FunctionConstraint(lambda u: u.sum(-1, keepdim=True), "equality", of="u"), ControlBounds(-200.0, 200.0)]
    model = FunctionDynamics(lambda x, u: x + u, 3, 3, 1.0, "none")
    cost = QuadraticCost(*weights, x_ref=[300.0, 500.0, 200.0])
    problem = Problem(model, cost, parts, torch.tensor([[1000.0, 0.0, 0.0]], dtype=dtype), 5)
    found = torchgco.solve(problem, solver="interior_point")
    multipliers = replace(found.multipliers, mu=torch.full_like(found.cost, 1e12))  # stiffness that rounds
    left = optimality(Lagrangian(problem, multipliers, None, True), found.X, found.U).left
    assert bool(torch.isfinite(left).all()) and float(left) < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_a_periodic_row_that_is_met_to_rounding_has_no_size(seed: int) -> None:
    """Curves that close: at rest the rows have what the start, which is free, leaves of the one at knot 0."""
    draws, N = torch.Generator().manual_seed(seed), 40
    decay, turns = 0.2 + torch.rand(8, generator=draws, dtype=D), 1.0 + torch.arange(8, dtype=D) % 3
    turns[1::2] *= 0.5 + torch.rand(4, generator=draws, dtype=D)  # waves that don't close: curves away from 0
    wave = (turns.unsqueeze(-1) * torch.arange(N + 1, dtype=D) * 2 * torch.pi / N).sin()

    def field(x: Tensor, u: Tensor, decay: Tensor) -> Tensor:
        return torch.stack((u[..., 0] - decay * x[..., 0], 0 * x[..., 1]), dim=-1)

    model = FunctionDynamics(field, 2, 1, 0.1, "rk4", values={"decay": decay})
    cost = FunctionCost(lambda x, u, w: (x[..., 0] - w) ** 2 + 0.1 * u[..., 0] ** 2, knot_values={"w": wave})
    same = lambda x: x[..., :1] - x[..., 1:]
    rows = [FunctionConstraint(same, "equality", knots=[k]) for k in (0, N)]
    problem = Problem(model, cost, rows, torch.zeros(8, 2, dtype=D), N, free_start=[True, True])
    found = torchgco.solve(problem)  # a ScaleWarning is an error here
    assert found.statuses == [Status.CONVERGED] * 8 and float(found.violation.max()) < 1e-7
    for off, warned in ((1e-9, False), (1e-8, False), (1e-2, True)):  # of what tolerances leave nothing is said
        X = found.X.clone()
        X[:, :, 1] += off * (1.0 + torch.rand(8, 1, generator=draws, dtype=D))
        X[:, -1, 1] += off
        assert bool((dwarfed(problem, X, found.U) != NO_PLACE).any()) == warned


@pytest.mark.parametrize("seed", range(3))
def test_equal_bounds_along_a_trajectory_say_nothing_of_their_size(seed: int) -> None:
    """At 0 they have that of their constraint's other rows, or none: what a solve leaves there isn't large."""
    draws = torch.Generator().manual_seed(seed)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4")
    reference, speed = torch.randn(4, generator=draws, dtype=D), 0.1 + float(torch.rand(1, generator=draws))
    cost = QuadraticCost([1.0, 1.0, 0.1, 0.1], [0.1] * 2, [20.0, 20.0, 1.0, 1.0], reference)
    zero = torch.zeros(1, 4, dtype=D)
    stands = StateBounds([None, None, 0.0, None], [None, None, 0.0, None])
    sized = [(ControlBounds([0, -2], [0, 2]), 4.0), (ControlBounds([speed, -9], [speed, 9]), speed), (stands, 0.0)]
    for part, size in sized:
        problem = Problem(model, cost, [part], zero, 20)
        for solver in ("gco", "interior_point"):
            found = torchgco.solve(problem, solver=solver)  # a ScaleWarning is an error here
            assert found.statuses == [Status.CONVERGED] and float(found.violation) <= 1e-6
        for off in (1e-26, 1e-20, 1e-9, 1e-4, 0.1, 0.5):
            X, U = found.X.clone(), found.U.clone()
            (X[:, 1:, 2] if part is stands else U[..., 0]).add_(off)
            assert bool((dwarfed(problem, X, U) != NO_PLACE).any()) == (off > max(1e-6, 0.05 * size))
