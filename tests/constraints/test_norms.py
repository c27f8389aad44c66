"""Bounds on norms and cones: rows, derivatives, solves, numbers by name and errors."""

from __future__ import annotations

import math
import pickle
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from torchgco import (
    Cone,
    ControlBounds,
    FunctionDynamics,
    InputError,
    InteriorPoint,
    NormBounds,
    Problem,
    QuadraticCost,
    RateBounds,
    Status,
    certify,
)
from torchgco.api import _guess
from torchgco.baselines import CasADiSolver
from torchgco.constraints.norms import TIP
from torchgco.kernels import EagerWarning, measured

D = torch.float64
B, N = 3, 20
FIVE = [3, 9, 14, 17, 19]
EACH = torch.tensor([0.8, 1.0, 1.2], dtype=D)
PARTS: dict[str, Any] = {
    "speed": NormBounds(("x", [3, 4, 5]), upper=EACH),
    "annulus": NormBounds("u", lower=0.4, upper=EACH + 1.0),
    "keep out by knot": NormBounds(
        ("x", slice(0, 2)), EACH.unsqueeze(1) * torch.linspace(0.2, 0.9, 5, dtype=D), knots=FIVE, center=[0.3, -0.2]
    ),
    "some of them": NormBounds(
        ("u", [0, 2]),
        [0.0, 0.3, 0.0],
        torch.tensor([0.6, torch.inf, 0.9], dtype=D),
        center=torch.full((B, 20, 2), 0.1, dtype=D),
    ),
    "pointing": Cone([0.2, 0.0, 1.0], 0.5 * EACH, "u"),
    "wide": Cone([[0.0, 0, 1], [0, 1, 0], [1, 0, 0]], 2.2, ("x", [3, 4, 5]), knots=FIVE),
    "glide slope": Cone([0.0, 0.0, 2.0], 1.2, ("x", range(3)), apex=[[0.1, 0.2, -0.1]] * B),
    "tilt": Cone([0.0, 0.0, 1.0], torch.linspace(0.3, 0.9, N, dtype=D).view(1, N), ("quaternion", range(6, 10))),
    "plane": Cone([1.0, 1.0], 0.7, ("x", [0, 1])),
}


def field(x: Tensor, u: Tensor) -> Tensor:
    """Rates of x = [p, v, q], a point mass with a quaternion that its controls turn; u = acceleration."""
    w, a, b, c = x[..., 6:].unbind(-1)
    r, s, t = (0.2 * u).unbind(-1)
    turn = (-a * r - b * s - c * t, w * r + b * t - c * s, w * s + c * r - a * t, w * t + a * s - b * r)
    weight = torch.tensor([0.0, 0.0, 0.5], dtype=x.dtype)
    return torch.cat((x[..., 3:6], u - weight, 0.5 * torch.stack(turn, -1)), dim=-1)


def lander(*constraints: Any, rows: slice = slice(None), x0: Tensor | None = None, dtype: torch.dtype = D) -> Problem:
    """Descents within 4 s."""
    start = torch.tensor([[2.0, 1, 3, -0.5, 0.2, -0.3, 1, 0, 0, 0]] * B, dtype=D) if x0 is None else x0
    start[:, :2] += 0.1 * torch.arange(len(start), dtype=D).unsqueeze(1)
    cost = QuadraticCost([0.0] * 10, [0.1] * 3, [30.0] * 3 + [10.0] * 3 + [0.0] * 4, u_ref=[0, 0, 0.5])
    model = FunctionDynamics(field, 10, 3, 0.2, "rk4", slice(0, 3))
    return Problem(model, cost, constraints, start[rows].to(dtype), N)


def points(seed: int) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(B, N + k, size, generator=random, dtype=D) for k, size in ((1, 10), (0, 3)))  # type: ignore


def in_numpy(name: str, part: Any, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    """Violations (B, K, p), row by row."""
    bound, given = lander(part).constraints[0], PARTS[name]
    knots = np.arange(N + 1)[bound.knots].tolist()
    found = []
    for b in range(B):
        for j, k in enumerate(knots):
            z = (X if bound.of == "x" else U)[b, k][bound.components.numpy()]
            pick = lambda value, b=b, j=j: np.broadcast_to(value, (B, len(knots), *value.shape[2:]))[b, j]
            if isinstance(given, NormBounds):
                size = np.linalg.norm(z if bound.center is None else z - pick(bound.center.numpy()))
                rows = [] if bound.upper is None else [max(0.0, size - pick(bound.upper.numpy()))]
                rows += [] if bound.lower is None else [max(0.0, pick(bound.lower.numpy()) - size)]
                found.append(rows)
                continue
            axis, angle = pick(bound.axis.numpy()), pick(bound.angle.numpy())
            axis = axis / np.linalg.norm(axis)
            if len(z) == 4:
                w, x, y, c = z / np.linalg.norm(z)
                turned = np.array([2 * (x * c + w * y), 2 * (y * c - w * x), 1 - 2 * (x * x + y * y)])
                found.append([max(0.0, np.arccos(turned @ axis) - angle)])
                continue
            v = z if bound.apex is None else z - pick(bound.apex.numpy())
            beyond = np.arccos(v @ axis / np.linalg.norm(v)) - angle
            found.append([np.linalg.norm(v) * np.sin(np.clip(beyond, 0.0, np.pi / 2))])
    return np.array(found).reshape(B, len(knots), -1)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", PARTS)
def test_violations_are_those_of_numpy_and_rows_have_their_sign(name: str) -> None:
    problem = lander(PARTS[name])
    (part,) = problem.constraints
    X, U = points(0)
    value, violation = part.value(X, U), part.violation(X, U)
    assert 0 < int((violation > 0).sum()) < violation.numel()
    np.testing.assert_allclose(violation, in_numpy(name, PARTS[name], X.numpy(), U.numpy()), rtol=1e-9, atol=1e-9)
    assert bool(((value > 1e-9) == (violation > 1e-9)).all())
    torch.testing.assert_close(measured(problem, X, U), violation.flatten(1).amax(-1))


@pytest.mark.parametrize("name", ["annulus", "pointing", "tilt", "wide"])
def test_near_the_bound_rows_are_as_large_as_violations(name: str) -> None:
    """Found by bisection between a point that keeps the constraint and one that doesn't."""
    (part,) = lander(PARTS[name]).constraints
    for seed in range(40):
        (X, U), (Y, V) = points(seed), points(seed + 100)
        at = (part.violation(X, U)[:, 0, 0] == 0) & (part.violation(Y, V)[:, 0, 0] > 0)
        if not bool(at.any()):
            continue
        low, high = torch.zeros(B, 1, 1, dtype=D), torch.ones(B, 1, 1, dtype=D)
        for _ in range(40):
            middle = 0.5 * (low + high)
            outside = part.violation(X + middle * (Y - X), U + middle * (V - U))[:, :1, :1] > 1e-6
            low, high = torch.where(outside, low, middle), torch.where(outside, middle, high)
        Z, W = X + high * (Y - X), U + high * (V - U)
        scale = Z[:, 1, 6:].square().sum(-1) if name == "tilt" else torch.ones(B, dtype=D)  # of a quaternion
        value, violation = part.value(Z, W)[:, 0, 0] / scale, part.violation(Z, W)[:, 0, 0]
        torch.testing.assert_close(value[at], violation[at], rtol=1e-3, atol=1e-7)
        return
    raise AssertionError("no point beside the bound")


@pytest.mark.parametrize("name", PARTS)
def test_derivatives_are_those_of_autodiff(name: str) -> None:
    (part,) = lander(PARTS[name]).constraints
    X, U = points(1)
    shape = part.value(X, U).shape
    g, h = (torch.randn(shape, generator=torch.Generator().manual_seed(i), dtype=D) for i in (2, 3))
    H = X.new_zeros(B, N + 1, 14, 14)
    part.accumulate(X, U, g, h, H)
    expected = torch.zeros_like(H)
    own = slice(0, 10) if part.of == "x" else slice(11, 14)
    for b in range(B):
        one = part.take(slice(b, b + 1))
        rows = torch.func.jacrev(lambda x, u, one=one: one.value(x[None], u[None])[0], (0, 1))(X[b], U[b])
        for row, k in enumerate(np.arange(N + 1)[part.knots].tolist()):
            J = rows[part.of == "u"][row, :, k]
            expected[b, k, own, 10] = expected[b, k, 10, own] = g[b, row] @ J
            expected[b, k, own, own] = J.mT @ (h[b, row].unsqueeze(-1) * J)
    torch.testing.assert_close(H, expected)


SOLVED = (
    NormBounds(("x", [3, 4, 5]), upper=0.6 * EACH, knots=slice(8, N + 1)),
    NormBounds("u", 0.2, 0.9),
    Cone([0.0, 0, 1], 0.6, "u"),
)


@pytest.mark.sampled(1)
def test_solves_natively_and_in_pytorch_as_ipopt_does(native: bool) -> None:
    problem = lander(*SOLVED, ControlBounds(-2.0, 2.0))
    solver = InteriorPoint(tolerance=1e-8, violation_tolerance=1e-7)
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        found = torchgco.solve(problem, solver=solver)
    assert found.statuses == [Status.CONVERGED] * B and float(found.violation.max()) < 1e-6
    for part in problem.constraints[:3]:
        assert float(part.value(found.X, found.U).flatten(1).amax(-1).min()) > -1e-2  # each binds in every problem
    if native:
        there = CasADiSolver("ipopt").solve(problem, found.U, X0=found.X)
        torch.testing.assert_close(found.cost, there.cost, rtol=1e-6, atol=0)
        assert float(certify(problem, found.X, found.U).kkt_residual.max()) < 1e-4


@pytest.mark.slow
def test_the_rest_of_the_batch_changes_nothing() -> None:
    whole = torchgco.solve(lander(*SOLVED))
    for b in range(B):
        one = lander(*SOLVED).take(torch.tensor([b]))
        assert torch.equal(torchgco.solve(one).U[0], whole.U[b])
    loaded = pickle.loads(pickle.dumps(lander(*SOLVED)))
    assert torch.equal(torchgco.solve(loaded).U, whole.U)


@pytest.mark.slow
def test_a_thrust_annulus_is_left_on_the_side_that_the_cost_asks_for() -> None:
    """Less thrust than the least would be cheaper: it is the least, in norm, until the speed has to change."""
    found = torchgco.solve(lander(NormBounds("u", lower=0.6)))
    sizes = found.U.norm(dim=-1)
    assert found.statuses == [Status.CONVERGED] * B and float(sizes.min()) > 0.6 - 1e-6
    assert int((sizes < 0.6 + 1e-4).sum()) > N


@pytest.mark.slow
def test_beside_rates_horizons_and_in_single_precision() -> None:
    slow = torchgco.solve(lander(*SOLVED, RateBounds(-0.1, 0.1)))
    assert slow.statuses == [Status.CONVERGED] * B and float(slow.violation.max()) < 1e-3
    problem = lander(NormBounds(("x", [3, 4, 5]), upper=0.3, knots=[N]), *SOLVED)
    ends = torch.tensor([20, 15, 18])
    short = Problem(problem.dynamics, problem.cost, problem.constraints, problem.x0, N, horizon=ends)
    found = torchgco.solve(short)
    last = found.X[torch.arange(B), ends, 3:6].norm(dim=-1)
    assert found.statuses == [Status.CONVERGED] * B and float((last - 0.3).abs().max()) < 1e-2
    single = torchgco.solve(lander(NormBounds("u", 0.2, 0.9), Cone([0.0, 0, 1], 0.6, "u"), dtype=torch.float32))
    double = torchgco.solve(lander(NormBounds("u", 0.2, 0.9), Cone([0.0, 0, 1], 0.6, "u")))
    torch.testing.assert_close(single.cost.double(), double.cost, rtol=1e-3, atol=0)


@pytest.mark.slow
def test_a_way_may_end_at_the_tip_of_its_cone() -> None:
    """A landing site is the apex of its glide slope."""
    land = torchgco.FunctionConstraint(lambda x: x[..., :6], "equality", [N])
    problem = lander(Cone([0.0, 0, 1], 0.7, ("x", range(3))), land, NormBounds("u", 0.1, 2.0))
    found = torchgco.solve(problem, solver=InteriorPoint())
    assert found.statuses == [Status.CONVERGED] * B and float(found.violation.max()) < 1e-6
    assert int(found.iterations.max()) < 250


def test_where_the_best_is_the_tip_itself_solves_end_converged() -> None:
    """Pulled out behind its tip, the best of a cone is the tip: 32 drawn axes, angles and pulls, by a closed form."""
    draw = np.random.default_rng(7)
    axis, angle = draw.normal(size=(32, 1, 3)), draw.uniform(0.15, 1.4, 32)
    axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    wanted = -axis * draw.uniform(0.3, 2.0, (32, 4, 1)) + 0.05 * draw.normal(size=(32, 4, 3))
    model = FunctionDynamics(lambda x, u: u, n=3, m=3, dt=0.1, integrator="euler")
    cost = QuadraticCost(Q=[0.0] * 3, R=[1.0] * 3, Qf=[0.0] * 3, u_ref=torch.from_numpy(wanted))
    cone = Cone(torch.from_numpy(axis[:, 0]), torch.from_numpy(angle), "u")
    problem = Problem(model, cost, [cone], torch.zeros(32, 3, dtype=D), N=4)
    found = torchgco.solve(problem, solver=InteriorPoint(max_iterations=5000))
    assert found.statuses == [Status.CONVERGED] * 32 and float(found.violation.max()) <= 1e-6
    u, angle = found.U.numpy(), angle[:, None]
    along = (u * axis).sum(-1)
    across = np.linalg.norm(u - along[..., None] * axis, axis=-1)
    assert (across * np.cos(angle) - along * np.sin(angle)).max() < TIP
    np.testing.assert_allclose(found.cost, 0.5 * np.square(wanted).sum((1, 2)), rtol=1e-4)


def test_compiled_numbers_have_names() -> None:
    plain = lander(NormBounds("u", 0.2, 0.9), Cone([0.0, 0, 1], 0.6, "u"))
    mpc = torchgco.compile(plain)
    answer = mpc(x0=plain.x0, upper=[[0.8]] * B, angle=[[0.4]] * B, axis=[[[0.0, 0.1, 2.0]]] * B, warm=False)
    fresh = torchgco.solve(lander(NormBounds("u", 0.2, 0.8), Cone([0.0, 0.1, 2.0], 0.4, "u")))
    np.testing.assert_allclose(answer.U, fresh.U, atol=1e-5)
    for name, value in (("upper", 0.1), ("angle", 4.0), ("axis", 0.0), ("lower", -1.0), ("upper", math.nan)):
        with pytest.raises(InputError, match=rf"{name}: expected"):
            mpc(numbers={name: np.full(mpc.numbers.find(name).shape, value)})


def test_gradients_by_bounds_and_angles_are_those_of_differences() -> None:
    solver = InteriorPoint(tolerance=1e-9)

    def cost(upper: Tensor, angle: Tensor) -> Tensor:
        found = torchgco.solve(lander(NormBounds("u", 0.2, upper), Cone([0.0, 0, 1], angle, "u")), solver=solver)
        assert found.statuses == [Status.CONVERGED] * B
        return found.cost

    given = [torch.full((B,), value, dtype=D, requires_grad=True) for value in (0.8, 0.6)]
    slopes = torch.autograd.grad(cost(*given).sum(), given)
    for i in range(2):
        more, less = ([part.detach() + sign * 1e-5 * (i == j) for j, part in enumerate(given)] for sign in (1, -1))
        torch.testing.assert_close(slopes[i], (cost(*more) - cost(*less)) / 2e-5, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_explained_by_side_and_components() -> None:
    problem = lander(NormBounds(("x", [3, 4, 5]), upper=0.05), ControlBounds(-0.1, 0.1))
    found = torchgco.solve(problem)
    assert "constraints[0] (NormBounds), upper bound of the norm of states 3, 4, 5" in found.explain(0, problem)
    assert found.worst_rows(problem).name[0] == "NormBounds" and "NormBounds(of='x'" in repr(problem)


WRONG: dict[str, list[Any]] = {
    "norm_bounds.of": [NormBounds(of, 0.1) for of in ("v", None, ("x", [10]), ("u", [0, 0]), ("u", []), ("x", 1.5),
        ("q", [0]), ("x", [True]), ("x", [-1]), ["x", [10]], ["x"], ("u", slice(3, 9)))],
    "norm_bounds.lower": [NormBounds("u", lower, 1.0) for lower in (-0.1, 1.0, 2.0, torch.inf, "a", [0.1, 0.2],
        torch.nan, [[0.1] * 7])],
    "norm_bounds.upper": [NormBounds("u", 0.0, upper) for upper in (0.0, -1.0, torch.nan, EACH.float())],
    "norm_bounds.knots": [NormBounds("u", 0.1, knots=knots) for knots in ([20], [], [1, 1])],
    "norm_bounds.center": [NormBounds("u", 0.1, center=c) for c in ([0.0, 0.0], torch.nan, [0.0, 0, torch.inf])],
    "norm_bounds": [NormBounds("u"), NormBounds("u", 0.0), NormBounds("u", None, torch.inf)],
    "cone.of": [Cone([0, 0, 1.0], 0.3, of) for of in ("q", ("quaternion", [6, 7, 8]), ("quaternion", [7, 8, 9, 10]))],
    "cone.axis": [Cone(axis, 0.3, "u") for axis in ([0, 0, 0.0], [1.0, 0], "z", [0, torch.nan, 1.0])],
    "cone.angle": [Cone([0, 0, 1.0], angle, "u") for angle in (0.0, 30.0, -0.2, math.pi, torch.nan, None)],
    "cone.apex": [Cone([0, 0, 1.0], 0.3, ("quaternion", range(6, 10)), apex=[0, 0, 0.0]), Cone([0, 0, 1.0], 0.3, "u",
        apex=[1.0])],
}  # fmt: skip


@pytest.mark.parametrize("field", WRONG)
def test_wrong_input_is_named(field: str) -> None:
    for part in WRONG[field]:
        with pytest.raises(InputError, match=rf"^{field}: expected"):
            lander(part)
    if field == "cone.angle":
        with pytest.raises(InputError, match="rad"):
            lander(WRONG[field][1])


class Lenient(NormBounds):
    """A user's class whose violation isn't that of its rows."""

    def violation(self, X: Tensor, U: Tensor) -> Tensor:
        return 0.5 * super().violation(X, U)


def test_an_own_violation_is_the_one_that_is_measured() -> None:
    model = FunctionDynamics(lambda x, u: u, 2, 2, 0.1, "euler")
    cost = QuadraticCost([1.0] * 2, [0.1] * 2, [1.0] * 2)
    x0 = torch.ones(1, 2, dtype=torch.float64)
    X, U = x0.unsqueeze(1).repeat(1, 6, 1), torch.ones(1, 5, 2, dtype=torch.float64)
    worst = [
        float(measured(Problem(model, cost, [kind("u", upper=0.5)], x0, 5), X, U)) for kind in (NormBounds, Lenient)
    ]
    assert abs(worst[0] - (2**0.5 - 0.5)) < 1e-12 and abs(worst[1] - 0.5 * worst[0]) < 1e-12


def guessed(*parts: Any) -> Tensor:
    return _guess(problem := lander(*parts), problem)


@pytest.mark.slow
def test_the_default_guess_of_controls_is_within_norms_and_cones() -> None:
    """At rest, (0, 0, 0.5): what holds keeps its bits; elsewhere sizes move, then directions."""
    assert torch.equal(guessed(), guessed(NormBounds("u", 0.4, 1.0), Cone([0.0, 0.0, 1.0], 0.3, "u")))
    assert torch.allclose(
        guessed(NormBounds("u", [0.6, 0.4, 0.6], [1.0, 1.0, torch.inf]))[:, 0, 2], each(0.8, 0.5, 1.2)
    )
    assert torch.allclose(guessed(NormBounds("u", upper=0.4))[..., 2], each(0.2))
    both = NormBounds("u", 0.6, 1.0, knots=FIVE), Cone([3.0, 0.0, 4.0], 0.3, "u", apex=[0.0, 0.0, 0.1])
    found = guessed(*both)
    assert torch.allclose(found[0, 4], each(0.24, 0.0, 0.42)) and torch.allclose(found[0, 3], each(0.42, 0.0, 0.66))
    around = guessed(
        NormBounds(("u", [0, 1]), 0.2, 0.6), Cone([0.0, -1.0], 0.3, ("u", [0, 1]))
    )  # at rest in the centre
    assert torch.allclose(around, each(0.0, -0.4, 0.5))
    alone = guessed(NormBounds(("u", [0, 1]), 0.2, 0.6))
    assert torch.allclose(alone[..., :2].norm(dim=-1), each(0.4)) and torch.equal(alone[..., 2], each(0.5).expand(B, N))


def each(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=D)
