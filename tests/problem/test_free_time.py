"""Problems with a free time in the form of solvers, against slow NumPy and autodiff; and what is refused."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from tests.engines import compiled, in_c
from torchgco import (
    Body,
    Boxes,
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    OscillatingBoxes,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Unicycle,
)
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.problem.in_time import at_times, factors_in, in_time, states_in_time, times_of

D = torch.float64
N, DT = 8, 0.1


def field(x: Any, u: Any, stack: Any) -> Any:
    """A car on a slope: x = [p, v, angle], u = [thrust, rate]."""
    p, v, angle = x[..., 0], x[..., 1], x[..., 2]
    cos, sin = (np.cos, np.sin) if stack is np.stack else (torch.cos, torch.sin)
    return stack((v * cos(angle), u[..., 0] - 0.3 * v * v * sin(p), u[..., 1] + 0.1 * v), -1)


def problem(integrator: Any = "rk4", rates: bool = True, **time: Any) -> Problem:
    x0 = torch.tensor([[0.0, 0.5, 0.1], [0.2, -0.4, 0.3]], dtype=D)
    model = FunctionDynamics(lambda x, u: field(x, u, torch.stack), 3, 2, DT, integrator)
    cost = FunctionCost(
        lambda x, u: x[..., 0].square() + 0.1 * (u * u).sum(-1), lambda x: 2.0 * (x[..., 1] - 1.0).square()
    )
    rows = [
        ControlBounds(-2.0, 2.0),
        FunctionConstraint(lambda x, u: x[..., :1] * u[..., 1:] - 0.4, of="xu", name="product"),
        *([RateBounds([-0.3, -torch.inf], [0.2, 0.4], previous=[0.1, 0.0])] if rates else []),
        StateBounds([-5.0, -torch.inf, -5.0], [5.0, 3.0, 5.0]),
    ]
    return Problem(model, cost, rows, x0, N, time=FreeTime(**{"weight": [2.0, 3.0], **time}))


def stepped(x: np.ndarray, u: np.ndarray, h: float, integrator: str) -> np.ndarray:
    f = lambda z: field(z, u, np.stack)
    if integrator == "euler":
        return x + h * f(x)
    if integrator == "midpoint":
        return x + h * f(x + 0.5 * h * f(x))
    k1 = f(x)
    k2 = f(x + 0.5 * h * k1)
    k3 = f(x + 0.5 * h * k2)
    return x + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3))


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4"])
@pytest.mark.parametrize("segments", [None, 3, [2, 5]])
def test_stages_last_their_factor_times_dt(integrator: str, segments: Any) -> None:
    draws, user = np.random.default_rng(0), problem(integrator, segments=segments)
    assert user.time is not None
    factors = torch.from_numpy(draws.uniform(0.5, 3.0, (2, user.time.count)))
    U, times = torch.from_numpy(draws.standard_normal((2, N, 2))), times_of(user, factors)
    X = [user.x0]
    whole, lifted, V = at_times(user, user.x0.unsqueeze(1).expand(-1, N + 1, -1), U, times)
    states, expected = [lifted[:, 0]], np.zeros(2)
    lengths = times.diff(dim=1).numpy()
    for k in range(N):
        h = lengths[:, k]
        x, u = X[-1].numpy(), U[:, k].numpy()
        X.append(torch.from_numpy(np.stack([stepped(x[b], u[b], h[b], integrator) for b in (0, 1)])))
        expected += h / DT * (x[:, 0] ** 2 + 0.1 * (u * u).sum(-1)) + np.array([2.0, 3.0]) * h
        states.append(whole.dynamics.at(k).step(states[-1], V[:, k]))
    expected += 2.0 * (X[-1].numpy()[:, 1] - 1.0) ** 2
    found = torch.stack(states, dim=1)
    torch.testing.assert_close(found[..., :3], torch.stack(X, dim=1), rtol=0, atol=1e-12)
    torch.testing.assert_close(found, states_in_time(user, found[..., :3], U, factors)[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(whole.cost.total(found, V), torch.from_numpy(expected), rtol=1e-12, atol=0)
    torch.testing.assert_close(factors_in(user, found), factors)


@pytest.mark.parametrize("segments", [None, 2])
def test_derivatives_are_those_of_autodiff(segments: Any) -> None:
    user = problem(segments=segments)
    whole, draws = in_time(user), torch.Generator().manual_seed(1)
    X = torch.rand(2, N + 1, whole.n, generator=draws, dtype=D) + 0.5
    U = torch.rand(2, N, whole.m, generator=draws, dtype=D) + 0.5
    s = whole.n + 1 + whole.m
    H = X.new_zeros(2, N + 1, s, s)
    whole.cost.expand(X, U, H)
    dX, dU = torch.func.grad(lambda x, u: whole.cost.total(x, u).sum(), (0, 1))(X, U)
    torch.testing.assert_close(H[:, :, : whole.n, whole.n], dX)
    torch.testing.assert_close(H[:, :-1, whole.n + 1 :, whole.n], dU)
    for part in whole.constraints:
        g = torch.rand(part.value(X, U).shape, generator=draws, dtype=D)
        dX, dU = torch.func.grad(lambda x, u, part=part, g=g: (g * part.value(x, u)).sum(), (0, 1))(X, U)
        add = torch.zeros_like(H)
        part.accumulate(X, U, g, torch.zeros_like(g), add)
        torch.testing.assert_close(add[:, :, : whole.n, whole.n], dX)
        torch.testing.assert_close(add[:, :-1, whole.n + 1 :, whole.n], dU)
        add.zero_()  # Gauss and Newton: the sum of dc' dc
        part.accumulate(X, U, torch.zeros_like(g), g, add)
        z = torch.cat((X[:, :-1], torch.ones_like(X[:, :-1, :1]), U), dim=-1)
        for k in range(N):
            if not part.holds_at(k):
                continue
            at = [j for j in range(N + 1) if part.holds_at(j)].index(k)
            rows = lambda z, k=k, part=part: part.value(
                torch.cat((X[:, :k], z[:, None, : whole.n], X[:, k + 1 :]), dim=1),
                torch.cat((U[:, :k], z[:, None, whole.n + 1 :], U[:, k + 1 :]), dim=1),
            )
            J = torch.func.jacrev(lambda z, at=at, rows=rows: rows(z)[:, at].sum(0))(z[:, k]).movedim(0, 1)
            torch.testing.assert_close(add[:, k], torch.einsum("bp,bpi,bpj->bij", g[:, at], J, J))


def test_limits_on_rates_grow_with_the_stages() -> None:
    user = problem(segments=[4])
    factors = torch.tensor([[2.0, 0.5], [1.0, 3.0]], dtype=D)
    U = torch.rand(2, N, 2, generator=torch.Generator().manual_seed(2), dtype=D)
    X = torch.zeros(2, N + 1, 3, dtype=D)
    whole, lifted, V = at_times(user, X, U, times_of(user, factors))
    change = U - torch.cat((torch.tensor([0.1, 0.0], dtype=D).expand(2, 1, 2), U[:, :-1]), dim=1)
    tau = factors[:, [0, 0, 0, 0, 1, 1, 1, 1]].unsqueeze(-1)
    above, below = change - tau * torch.tensor([0.2, 0.4], dtype=D), -0.3 * tau - change[..., :1]
    torch.testing.assert_close(whole.constraints[2].value(lifted, V), torch.cat((above, below), dim=-1))


REFUSED = [
    ({"least": 2.0, "most": 1.0}, "time.least: expected at most time.most = 1, got 2"),
    ({"least": 0.0}, "time.least: expected a factor of N dt above 0"),
    ({"most": float("inf")}, "time.most: expected finite numbers"),
    ({"guess": 9.0}, "time.guess: expected 0.5 to 3"),
    ({"weight": -1.0}, "time.weight: expected a cost per second of at least 0"),
    ({"segments": 0}, "time.segments: expected 1 to N = 8"),
    ({"segments": [0, 3]}, "time.segments: expected knots within 1..7"),
    ({"segments": [5, 3]}, "time.segments: expected knots within 1..7, in their order"),
    ({"segments": "two"}, "time.segments: expected a slice, or a list of whole numbers"),
    ({"least": [0.5, 0.5, 0.5]}, "time.least: expected a number, or shape (1, 1)"),
]


def plain(**changes: Any) -> Problem:
    parts: dict[str, Any] = {
        "dynamics": Unicycle(dt=0.1), "cost": QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4),
        "constraints": [ControlBounds(-1.0, 1.0)], "x0": torch.zeros(1, 4, dtype=D), "N": N, "time": FreeTime(),
    }  # fmt: skip
    return Problem(**{**parts, **changes})


@pytest.mark.parametrize(("time", "told"), REFUSED)
def test_bad_times_are_refused(time: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=re.escape(told)):
        plain(time=FreeTime(**time))


UNSERVED = [
    ({"time": 2.0}, "time: expected a FreeTime, or None"),
    ({"horizon": [4]}, "time: expected problems without a horizon of their own"),
    ({"dynamics": FunctionDynamics(lambda x, u: x, 4, 2, 0.1, "none")}, "dynamics: expected a model of x' = field"),
    ({"dynamics": FunctionDynamics(lambda x, u, k: x, 4, 2, 0.1)}, "dynamics: expected the same model at all stages"),
    ({"cost": FunctionCost(lambda x, u, k: k * u.sum(-1))}, "cost: expected the same cost at all stages"),
    (
        {"cost": QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4, u_ref=torch.arange(16, dtype=D).view(8, 2))},
        "cost: expected the same cost at all stages",
    ),
    (
        {
            "cost": QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4, torch.eye(9, 4, dtype=D)),
            "time": FreeTime(segments=2),
        },
        "time.segments: expected None where x_ref follows the time, got 2 segments",
    ),
]


@pytest.mark.parametrize(("parts", "told"), UNSERVED)
def test_what_follows_a_fixed_time_is_refused(parts: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=re.escape(told)):
        plain(**parts)


def test_times_that_do_not_fit_are_refused() -> None:
    user, X, U = plain(), torch.zeros(1, N + 1, 4, dtype=D), torch.zeros(1, N, 2, dtype=D)
    even = torch.linspace(0.0, 1.0, N + 1, dtype=D).unsqueeze(0)
    at_times(user, X, U, even)
    for times, told in ((None, "the times of the knots"), (even[0], "shape"), (even.square(), "equal distances")):
        with pytest.raises(InputError, match=f"times: expected.*{told}"):
            at_times(user, X, U, times)
    with pytest.raises(InputError, match="times: expected None"):
        at_times(plain(time=None), X, U, even)


def test_parts_of_a_batch_keep_their_own_times() -> None:
    user = problem(least=torch.tensor([0.5, 0.7], dtype=D))
    part = user.take(torch.tensor([1]))
    assert part.time is not None
    assert (float(part.time.least), float(part.time.weight)) == (0.7, 3.0)
    assert user.cast(torch.float32).time.least.dtype == torch.float32  # type: ignore[union-attr]
    assert in_time(part).constraints[-1].lower[0, 3] == 0.7  # type: ignore[attr-defined]


def among_moving(**parts: Any) -> Problem:
    x0 = torch.tensor([[0.0, 0.0, 0.5, 0.0], [0.1, 0.2, 0.0, 0.3]], dtype=D)
    velocities = [[[0.1, -0.4], [0.3, 0.2], [0.0, 0.0]], [[-0.2, 0.1], [0.5, 0.0], [0.0, 0.0]]]
    centers = [[[2.0, 1.0], [1.0, -1.0], [3.0, 3.0]], [[1.5, 0.5], [2.0, 2.0], [np.nan, np.nan]]]
    radii = [[0.2, 0.3, 0.4], [0.3, 0.2, np.nan]]
    given: dict[str, Any] = {"time": FreeTime(), "constraints": [Spheres(centers, radii, 0.1, velocities)], **parts}
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, DT, "rk4", slice(0, 2))
    return Problem(
        model, QuadraticCost([0.0] * 4, [1.0] * 2, [0.0] * 4), given["constraints"], x0, N, time=given["time"]
    )


def test_rows_of_moving_spheres_follow_the_time() -> None:
    """Depths and derivatives by each factor, and those of spheres that move that much faster."""
    user, draws = among_moving(), torch.Generator().manual_seed(3)
    whole, factor = in_time(user), torch.tensor([0.6, 2.3], dtype=D)
    part: Any = whole.constraints[0]
    spheres: Any = user.constraints[0]
    X = 2.0 * torch.rand(2, N + 1, whole.n, generator=draws, dtype=D)
    X[..., 4] = factor.unsqueeze(-1)
    U = torch.zeros(2, N, 2, dtype=D)
    expected = np.zeros((2, N, 3))
    for b in range(2):
        for k in range(1, N + 1):
            for j in range(3 - b):
                there = spheres.centers[b, j] + k * DT * float(factor[b]) * spheres.velocities[b, j]
                expected[b, k - 1, j] = float(spheres.inflated_radii[b, j] - (X[b, k, :2] - there).norm())
    expected[1, :, 2] = -1.0
    np.testing.assert_allclose(part.violation(X, U), expected.clip(min=0.0), atol=1e-12)
    assert bool(((part.value(X, U) > 0) == torch.from_numpy(expected > 0)).all())
    torch.testing.assert_close(part.at(X[:, 3:4], 3), part.value(X, U)[:, 2:3])
    for name in ("distances", "chord_clearance"):
        torch.testing.assert_close(getattr(part, name)(X), getattr(part.at_factor(factor), name)(X))
    X[..., 4] += torch.rand(2, N + 1, generator=draws, dtype=D)  # on the way of a solver factors differ
    g, h = (torch.rand(2, N, 3, generator=draws, dtype=D) for _ in range(2))
    H = torch.zeros(2, N + 1, whole.n + 3, whole.n + 3, dtype=D)
    part.accumulate(X, U, g, h, H)
    (slopes,) = torch.func.jacrev(lambda x: (part.value(x, U),))(X)
    for b in range(2):
        for k in range(N):
            J = slopes[b, k, :, b, k + 1]
            torch.testing.assert_close(H[b, k + 1, : whole.n, whole.n], g[b, k] @ J)
            torch.testing.assert_close(H[b, k + 1, : whole.n, : whole.n], J.mT @ (h[b, k].unsqueeze(-1) * J))


def test_what_moves_otherwise_is_refused_in_a_free_time() -> None:
    body = Body([[0.1, 0.0], [-0.1, 0.0]], 0.1, attitude=lambda x: torch.eye(2, dtype=D).expand(*x.shape[:-1], 2, 2))
    swings = OscillatingBoxes(Boxes([[3.0, 0.0]], [[0.5, 0.5]], 0.1), [[[0.3, 0.0]]], [[[1.0, 1.0]]], [[[0.0, 0.0]]])
    moving = [[0.1, 0.0]]
    for part in (swings, Spheres([[3.0, 0.0]], [0.2], body, moving)):
        with pytest.raises(InputError, match=r"constraints\[0\]: expected where the time is free, obstacles at rest"):
            among_moving(constraints=[part])
    with pytest.raises(InputError, match=r"time.segments: expected None among obstacles that move, got 2 segments"):
        among_moving(time=FreeTime(segments=2))


def following() -> Problem:
    """Two references of four states, of which the second rests until its last row."""
    rows = torch.rand(2, N + 1, 4, generator=torch.Generator().manual_seed(4), dtype=D)
    rows[1, :-1] = rows[1, 0]
    cost = QuadraticCost([1.0, 2.0, 0.5, 0.1], [0.3, 0.2], [[2.0, 1, 0, 0], [1, 2, 0, 0], [0] * 4, [0] * 4], rows)
    return plain(cost=cost, x0=torch.zeros(2, 4, dtype=D), time=FreeTime(weight=0.7))


@pytest.mark.parametrize("factors", [(0.6, 0.6), (1.0, 1.0), (2.3, 1.7)])
def test_references_follow_the_time(factors: tuple[float, float]) -> None:
    """They are SciPy's natural spline through the rows, straight beyond; one that rests keeps its last row."""
    user, draws = following(), torch.Generator().manual_seed(5)
    X, U = (torch.rand(2, N + more, size, generator=draws, dtype=D) for more, size in ((1, 4), (0, 2)))
    whole, lifted, V = at_times(user, X, U, times_of(user, torch.tensor(factors, dtype=D).unsqueeze(-1)))
    rows, expected = torch.cat((user.cost.cost.x_ref, user.cost.cost.xf_ref.unsqueeze(1)), dim=1).numpy(), []
    for b, tau in enumerate(factors):
        spline, s = CubicSpline(np.arange(N + 1), rows[b], bc_type="natural"), tau * np.arange(N + 1)
        r = spline(np.minimum(s, N)) + np.maximum(s - N, 0.0)[:, None] * spline(N, 1)
        r = np.vstack([rows[1, [0] * N], rows[1, -1:]]) if b == 1 else r
        e, u = X[b].numpy() - r, U[b].numpy()
        stages = 0.5 * (e[:-1] ** 2 @ [1.0, 2.0, 0.5, 0.1] + u**2 @ [0.3, 0.2]) + 0.7 * DT
        expected.append(tau * stages.sum() + e[-1, 0] ** 2 + e[-1, 1] ** 2 + e[-1, 0] * e[-1, 1])
    torch.testing.assert_close(whole.cost.total(lifted, V), torch.tensor(expected, dtype=D), rtol=1e-12, atol=0)
    one = user.take([1])
    assert float(in_time(one).cost.total(lifted[1:], V[1:])) == pytest.approx(expected[1], rel=1e-12)


@pytest.mark.slow
@compiled
def test_native_derivatives_of_references_are_autodiffs() -> None:
    user, draws = following(), torch.Generator().manual_seed(6)
    whole = in_time(user)
    X, U = (torch.rand(2, N + more, size, generator=draws, dtype=D) for more, size in ((1, 5), (0, 2)))
    X[..., 4] = 0.4 + 1.4 * X[..., 4]
    X[0, 3, 4], X[0, 4, 4], X[1, 2, 4] = 1.0, 2.5, -0.5  # at a row, beyond the last, before the first
    kernels = in_c(whole)
    assert kernels is not None
    lagrangian = Lagrangian(whole, Multipliers.zero(whole, 0.0), None, True)
    slopes, H = kernels.expand(whole, X, U, lagrangian)
    total = lambda x, u: whole.cost.total(x, u).sum()
    dX, dU = torch.func.grad(total, (0, 1))(X, U)
    torch.testing.assert_close(slopes[..., :5], dX, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(slopes[:, :-1, 5:], dU, rtol=1e-12, atol=1e-12)
    second = torch.func.hessian(total)(X, U)
    for b in range(2):
        for k in range(N + 1):
            torch.testing.assert_close(H[b, k, :5, :5].triu(), second[b, k, :, b, k].triu(), rtol=1e-10, atol=1e-10)
