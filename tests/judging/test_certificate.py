"""The certificate against hand-made cases and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear

from tests.problems import planar_batch, quadrotor_batch
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    QuadrotorPlant,
    Spheres,
    StateBounds,
    certify,
)
from torchgco.dynamics.rollout import open_loop
from torchgco.experiments.results.folder import COLUMNS
from torchgco.judging.certificate import frame_columns
from torchgco.judging.judge import judge

# Thin obstacles are the subject here.
pytestmark = pytest.mark.filterwarnings("ignore::torchgco.ScaleWarning")


def passing(radius: float, integrator: str = "euler", velocity: float | None = None) -> tuple[Problem, torch.Tensor]:
    """A point that flies along the x axis at 2 m/s with knots 0.2 m apart, and a disc whose centre lies at x = 0.5."""
    velocities = None if velocity is None else [[0.0, velocity]]
    problem = Problem(
        Planar(dt=0.1, drag=0.0, integrator=integrator),
        QuadraticCost([1] * 6, [1, 1], [1] * 6),
        [Spheres([[0.5, 0.0]], [radius], 0.0, velocities), ControlBounds([-1, -1], [1, 1])],
        torch.tensor([[0.0, 0, 0, 2.0, 0, 0]], dtype=torch.float64), 10,
    )  # fmt: skip
    return problem, torch.zeros(1, 10, 2, dtype=torch.float64)


def certified(problem: Problem, U: torch.Tensor):
    return certify(problem, open_loop(problem.dynamics, problem.x0, U), U)


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4"])
def test_a_thin_sphere_between_two_knots_is_caught(integrator: str) -> None:
    problem, U = passing(0.01, integrator)  # knots at 0.4 and 0.6 are ten radii away
    assert float(judge(problem, U, torch.zeros(2, dtype=torch.float64), 9.0).violation) == 0.0
    assert float(certified(problem, U).clearance) == pytest.approx(-0.01, abs=1e-12)


def test_a_sphere_that_crosses_between_two_knots_is_caught() -> None:
    """At 0.25 s, between the knots, the disc's centre is where the point is."""
    problem, U = passing(0.01, velocity=0.4)
    moved = Problem(
        problem.dynamics, problem.cost, [Spheres([[0.5, -0.1]], [0.01], 0.0, [[0.0, 0.4]])], problem.x0, problem.N
    )
    assert float(certified(moved, U).clearance) == pytest.approx(-0.01, abs=1e-12)
    assert float(certified(problem, U).clearance) > 0.05


def circling(radius: float, integrator: str = "rk4") -> tuple[Problem, torch.Tensor, torch.Tensor]:
    """A point on the unit circle at 1 rad/s, knots half a radian apart; a small disc just outside one arc's middle."""
    step = 0.5

    def turn(x, u):
        return torch.stack((x[..., 2], x[..., 3], -x[..., 3], x[..., 2]), -1) + 0.0 * u

    middle = torch.tensor([np.cos(1.25), np.sin(1.25)]) * 1.01
    problem = Problem(
        FunctionDynamics(turn, 4, 1, step, integrator, slice(0, 2)),
        QuadraticCost([1] * 4, [1], [1] * 4),
        [Spheres(middle[None].numpy(), [radius])],
        torch.tensor([[1.0, 0, 0, 1.0]], dtype=torch.float64), 8,
    )  # fmt: skip
    U = torch.zeros(1, 8, 1, dtype=torch.float64)
    return problem, open_loop(problem.dynamics, problem.x0, U), U


def test_an_arc_that_bulges_into_a_sphere_is_caught() -> None:
    """The chord stays 0.041 m away from the disc of 0.02 that the arc itself touches."""
    problem, X, U = circling(0.02)
    relative = X[0, 2:4, :2] - problem.constraints[0].centers[0]
    chord = abs(float(relative[0, 0] * relative[1, 1] - relative[0, 1] * relative[1, 0])) / float(
        relative.diff(dim=0).norm()
    )
    assert chord > 0.02 + 0.015
    clearance = float(certify(problem, X, U).clearance)
    # The acceleration is 1 m/s^2 throughout: the bulge is at most dt^2 / 8, plus a little for sampled accelerations.
    assert chord - 0.02 - 2 * 0.5**2 / 8 < clearance < chord - 0.02 - 0.5**2 / 8 + 1e-9
    assert clearance <= 0.01 - 0.02  # the clearance of the true arc
    straight = circling(0.02, "none")[0]  # a step without a field is judged by its chord
    assert float(certify(straight, X, U).clearance) == pytest.approx(chord - 0.02)


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "rk4"])
@pytest.mark.parametrize("free", [False, True])
def test_the_clearance_is_that_of_the_path(integrator: str, free: bool) -> None:
    """Of stages of half a second and accelerations up to 8 m/s^2, whose paths leave their chords by up to 0.25 m."""
    step, N, B, random = 0.5, 6, 16, torch.Generator().manual_seed(5)
    draw = lambda *shape: 2.0 * torch.rand(*shape, generator=random, dtype=torch.float64) - 1.0
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, step, integrator, slice(0, 2))
    centers, velocities, factors = 3.0 * draw(B, 3, 2), draw(B, 3, 2), 1.0 + 0.5 * draw(B, 1)
    spheres = Spheres(centers, torch.full((B, 3), 0.2).double(), 0.1, velocities)
    time = FreeTime(0.1, 3.0, 1.0) if free else None
    problem = Problem(model, QuadraticCost([1] * 4, [1] * 2, [1] * 4), [spheres], 2.0 * draw(B, 4), N, time=time)
    lengths, U, x = step * (factors if free else torch.ones_like(factors)), 8.0 * draw(B, N, 2), problem.x0
    share, X, nearest = torch.linspace(0.0, 1.0, 1001, dtype=torch.float64).view(-1, 1, 1), [x], []
    for k in range(N):
        t = share * lengths
        bent = 0.5 * t**2 * U[:, k] if integrator != "euler" else 0.0
        p, spheres_at = x[:, :2] + t * x[:, 2:] + bent, centers + (k * lengths + t).unsqueeze(-1) * velocities
        nearest.append((p.unsqueeze(2) - spheres_at).norm(dim=-1).amin((0, 2)) - 0.3)
        x = torch.cat((p[-1], x[:, 2:] + lengths * U[:, k]), -1)
        X.append(x)
    times = lengths * torch.arange(N + 1) if free else None
    found = certify(problem, torch.stack(X, dim=1), U, times=times)
    true = torch.stack(nearest).amin(0)
    assert float(found.dynamics_residual.max()) < 1e-12
    # A path leaves the chords of 16 pieces of a stage by at most 1 / 256 of what it leaves its own.
    assert bool(((found.clearance <= true + 1e-4) & (found.clearance >= true - 0.004)).all())


@pytest.mark.slow
def test_the_plants_bound_holds_for_its_true_path() -> None:
    """Plant steps a hundred times finer never leave the bound of one step."""
    start = torch.zeros(1, 17, dtype=torch.float64)
    start[0, 3], start[0, 6], start[0, 13:] = 3.0, 1.0, 3.9
    U = 5000.0 + 800.0 * torch.randn(1, 20, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    plant, fine = QuadrotorPlant(dt=0.05), QuadrotorPlant(dt=0.0005)
    X = open_loop(plant, start, U)
    centre = X[0, 10, :3] + torch.tensor([0.075, 0.02, 0.3], dtype=torch.float64)
    cost = QuadraticCost([1] * 17, [1] * 4, [1] * 17)
    problem = Problem(plant, cost, [Spheres(centre[None].numpy(), [0.2])], start, 20)
    path = torch.cat([open_loop(fine, X[:, k], U[:, k : k + 1].repeat(1, 100, 1)) for k in range(20)], dim=1)
    true = float((path[0, :, :3] - centre).norm(dim=-1).min()) - 0.2
    assert true - 0.02 < float(certify(problem, X, U).clearance) <= true


def test_absent_or_missing_spheres_are_no_obstacle() -> None:
    problem, U = planar_batch(B=2, N=10, obstacles=2, seed=1)
    empty = Problem(problem.dynamics, problem.cost, [], problem.x0, problem.N)
    assert certified(empty, U).clearance.tolist() == [float("inf")] * 2
    assert certified(empty, U).bound_violation.tolist() == [0.0, 0.0]
    first = Problem(
        problem.dynamics, problem.cost, [Spheres(problem.constraints[0].centers[:, :1], [0.1], 0.06)],
        problem.x0, problem.N,
    )  # fmt: skip
    gap = (problem.x0[:, :2] - first.constraints[0].centers[:, 0]).norm(dim=-1) - 0.16
    torch.testing.assert_close(certified(first, U).clearance, gap)  # the vehicles stay at the start


def test_dynamics_and_bounds_are_measured() -> None:
    problem, U = quadrotor_batch(B=2, N=10)
    bounded = Problem(
        problem.dynamics, problem.cost, [*problem.constraints, StateBounds([-9.0] * 14, [9.0] * 13 + [10.0])],
        problem.x0, problem.N,
    )  # fmt: skip
    X = open_loop(problem.dynamics, problem.x0, U)
    assert certify(bounded, X, U).dynamics_residual.tolist() == [0.0, 0.0]
    assert certify(bounded, X, U).bound_violation.tolist() == [0.0, 0.0]
    off, hard = X.clone(), U.clone()
    off[0, 4, 1] += 0.25
    hard[1, 3, 2] = -5.5
    certificate = certify(bounded, off, hard)
    assert certificate.dynamics_residual.tolist()[0] == pytest.approx(0.25)
    assert certificate.bound_violation.tolist() == [0.0, 0.5]
    off = X.clone()
    off[0, 7, 13] = 11.25
    assert certify(bounded, off, U).bound_violation.tolist() == [1.25, 0.0]
    off[0] = X[0] + 0.5 * (torch.arange(14) == 0)  # all states are shifted alike: only the start differs
    assert float(certify(bounded, off, U).dynamics_residual[0]) == pytest.approx(0.5)


def integrator_problem(constraints) -> Problem:
    """x' = u, one step of 1 s: minimise 1/2 (x_1 - 2)^2 + 1/2 u^2 from 0. Free optimum u = 1."""
    dynamics = FunctionDynamics(lambda x, u: u, 1, 1, 1.0)
    x0 = torch.zeros(1, 1, dtype=torch.float64)
    return Problem(dynamics, QuadraticCost([0.0], [1.0], [1.0], x_ref=[2.0]), constraints, x0, 1)


def test_known_optima_have_no_residual() -> None:
    def residual(u: float, *constraints) -> float:
        return float(
            certified(integrator_problem(constraints), torch.full((1, 1, 1), u, dtype=torch.float64)).kkt_residual
        )

    assert residual(1.0) == pytest.approx(0.0, abs=1e-15)
    assert residual(0.5) == pytest.approx(1.0 / 2.0)  # gradient 2 u - 2 = -1, divided by the terms 1 + 1
    assert residual(0.5, ControlBounds([-1.0], [0.5])) == pytest.approx(0.0, abs=1e-15)
    assert residual(1.5, ControlBounds([-1.0], [1.5])) == pytest.approx(1.0 / 2.0)  # the bound would have to pull
    assert residual(0.5, ControlBounds([-1.0], [0.6])) == pytest.approx(1.0 / 2.0)  # too far from the bound
    wall = FunctionConstraint(lambda x: x - 1.5, sense="equality", knots=[1])
    assert residual(1.5, wall) == pytest.approx(0.0, abs=1e-15)  # an equality may pull


def test_a_fit_that_does_not_end_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*args, **more):
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr("scipy.optimize.nnls", never)
    problem, U = integrator_problem([ControlBounds([-1.0], [0.5])]), torch.full((1, 1, 1), 0.5, dtype=torch.float64)
    assert float(certified(problem, U).kkt_residual) == pytest.approx(0.0, abs=1e-15)


def test_a_commanded_velocity_has_no_acceleration() -> None:
    dynamics = FunctionDynamics(lambda x, u: u, 2, 2, 0.5, "rk4", slice(0, 2))
    x0 = torch.zeros(1, 2, dtype=torch.float64)
    problem = Problem(dynamics, QuadraticCost([1, 1], [1, 1], [1, 1]), [Spheres([[0.25, 0.2]], [0.1])], x0, 2)
    U = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]], dtype=torch.float64)
    assert float(certified(problem, U).clearance) == pytest.approx(0.1)


def terms(problem: Problem, X: torch.Tensor, U: torch.Tensor, total=None, h: float = 1e-6) -> np.ndarray:
    """Sum (N, m) of the absolute terms of dJ/du_k: the stage's own, and one through each state of knot k + 1.

    J is the cost, or another function `total` of X and U.
    """
    total = total or problem.cost.total

    def cost_of(k: int, x: torch.Tensor) -> float:
        """J with knot k at x and the same controls after it."""
        path = [*X[0, :k], x]
        for u in U[0, k:]:
            path.append(problem.dynamics.step(path[-1][None], u[None])[0])
        return float(total(torch.stack(path)[None], U))

    def central(f, z: torch.Tensor) -> np.ndarray:
        steps = h * torch.eye(len(z), dtype=z.dtype)
        return np.stack([(np.asarray(f(z + e)) - np.asarray(f(z - e))) / (2 * h) for e in steps], axis=-1)

    sizes = np.empty(U.shape[1:])
    for k in range(problem.N):
        put = lambda u, k=k: torch.cat((U[:, :k], u[None, None], U[:, k + 1 :]), dim=1)
        own = central(lambda u, put=put: total(X, put(u))[0], U[0, k])
        by_u = central(lambda u, k=k: problem.dynamics.step(X[:, k], u[None])[0], U[0, k])  # (n, m)
        by_x = central(lambda x, k=k: cost_of(k + 1, x), X[0, k + 1])
        sizes[k] = np.abs(own) + np.abs(by_x) @ np.abs(by_u)
    return sizes


@pytest.mark.parametrize("batch", [planar_batch, quadrotor_batch])
def test_the_residual_is_that_of_finite_differences(batch) -> None:
    """Central differences of cost and rows through the rollout, and another solver for the multipliers."""
    problem, U = batch(B=2, N=8)
    U = U + 0.5 * torch.randn(U.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    problem = problem.take(torch.tensor([1]))
    U = U[[1]]
    X = open_loop(problem.dynamics, problem.x0, U)
    centre = X[0, 5, problem.dynamics.position].numpy() + 0.1  # a sphere that knot 5 touches
    R = float(np.linalg.norm(X[0, 5, problem.dynamics.position].numpy() - centre))
    lower, upper = U[0].amin(0).numpy(), U[0].amax(0).numpy()  # every control is at a bound somewhere
    spheres, bounds = Spheres(centre[None], [R - 1e-4]), ControlBounds(lower, upper)
    problem = Problem(problem.dynamics, problem.cost, [spheres, bounds], problem.x0, problem.N)

    def values(u):
        V = torch.from_numpy(u).view_as(U)
        Y = open_loop(problem.dynamics, problem.x0, V)
        rows = [part.value(Y, V).flatten() for part in problem.constraints]
        return torch.cat((problem.cost.total(Y, V), *rows)).numpy()

    u = U.flatten().numpy().copy()
    eye, h = np.eye(len(u)), 1e-6
    slopes = np.stack([(values(u + h * e) - values(u - h * e)) / (2 * h) for e in eye], axis=1)
    c = values(u)[1:]
    gap = np.linalg.norm(X[0, 1:, problem.dynamics.position].numpy() - centre, axis=1) - (R - 1e-4)
    spare = np.concatenate((gap, -c[problem.N :]))
    g, A = slopes[0], slopes[1:][spare <= 1e-3]
    assert len(A) > 2 * problem.m
    A = A[np.linalg.norm(A, axis=1) > 1e-6]
    fit = lsq_linear(A.T, -g, bounds=(0, np.inf), tol=1e-14)
    rest = np.abs(g + A.T @ fit.x).reshape(problem.N, problem.m).max(0)
    expected = (rest / terms(problem, X, U).max(0)).max()
    assert float(certify(problem, X, U).kkt_residual) == pytest.approx(expected, rel=1e-4)


def given(problem: Problem, U: torch.Tensor, *multipliers: float) -> float:
    """The residual with given multipliers, one per constraint with one row at one knot."""
    X = open_loop(problem.dynamics, problem.x0, U)
    lams = [
        torch.full((1, *shape), lam, dtype=U.dtype) for lam, shape in zip(multipliers, problem.row_shapes, strict=True)
    ]
    return float(certify(problem, X, U, multipliers=lams).kkt_residual)


def test_multipliers_that_are_given_are_tested() -> None:
    def residual(u: float, lam: float, row: FunctionConstraint) -> float:
        return given(integrator_problem([row]), torch.full((1, 1, 1), u, dtype=torch.float64), lam)

    def below(limit: float) -> FunctionConstraint:
        return FunctionConstraint(lambda x: x - limit, knots=[1])

    # The Lagrangian's gradient is u + (u - 2 + lam): two terms.
    assert residual(0.5, 1.0, below(0.5)) == pytest.approx(0.0, abs=1e-15)
    assert residual(0.5, 0.9, below(0.5)) == pytest.approx(0.1 / (0.5 + 0.6))
    assert residual(0.5, 1.0 + 1e-6, below(0.5)) == pytest.approx(1e-6, rel=1e-5)
    assert residual(1.5, -1.0, below(1.5)) == pytest.approx(1.0 / (1.5 + 0.5))  # an inequality can't pull
    # Cost 1.25 at u = 0.5; a row that is 0.1 away doesn't push, nor does one that is violated by as much.
    cost = pytest.approx(1.0 * 0.1 / 1.25, rel=1e-5)
    assert residual(0.5, 1.0, below(0.6)) == cost == residual(0.5, 1.0, below(0.4))
    assert residual(0.5, 1e-9, below(0.5)) == pytest.approx(1.0 / 2.0, rel=1e-6)
    wall = FunctionConstraint(lambda x: x - 1.5, sense="equality", knots=[1])
    assert residual(1.5, -1.0, wall) == pytest.approx(0.0, abs=1e-15)
    assert residual(1.5, 1.0, wall) > 0.1
    endless = ControlBounds([-np.inf], [0.5])
    problem, U = integrator_problem([endless]), torch.full((1, 1, 1), 0.5, dtype=torch.float64)
    X = open_loop(problem.dynamics, problem.x0, U)
    finite = torch.isfinite(problem.constraints[0].value(X, U))
    lam = torch.where(finite, 1.0, 7.0).double()  # a bound at infinity has no push
    assert float(certify(problem, X, U, multipliers=[lam]).kkt_residual) < 1e-15


def test_the_residual_with_given_multipliers_is_that_of_finite_differences() -> None:
    """Central differences of the Lagrangian through the rollout."""
    problem, U = planar_batch(B=2, N=8)
    draws = torch.Generator().manual_seed(1)
    U = U + 0.5 * torch.randn(U.shape, generator=draws, dtype=torch.float64)
    X = open_loop(problem.dynamics, problem.x0, U)
    lams = [torch.rand(2, *shape, generator=draws, dtype=torch.float64) for shape in problem.row_shapes]
    b = torch.tensor([1])
    one, mine, x = problem.take(b), [lam[b] for lam in lams], U[b]

    def lagrangian(Y: torch.Tensor, V: torch.Tensor) -> torch.Tensor:
        parts = zip(one.constraints, mine, strict=True)
        return one.cost.total(Y, V) + sum((lam * part.value(Y, V)).sum() for part, lam in parts)

    def value(u: np.ndarray) -> float:
        V = torch.from_numpy(u).view_as(x)
        return float(lagrangian(open_loop(one.dynamics, one.x0, V), V))

    u, h = x.flatten().numpy().copy(), 1e-6
    slope = np.array([(value(u + h * e) - value(u - h * e)) / (2 * h) for e in np.eye(len(u))])
    stationarity = (np.abs(slope.reshape(x.shape[1:])).max(0) / terms(one, X[b], x, lagrangian).max(0)).max()
    products = [float((lam * part.value(X[b], x)).abs().max()) for part, lam in zip(one.constraints, mine, strict=True)]
    complementarity = max(products) / float(one.cost.total(X[b], x) + 1e-6 * one.N * one.cost_unit)
    assert stationarity > 1e-2 and complementarity > 1e-2
    found = certify(problem, X, U, torch.tensor([False, True]), lams).kkt_residual
    assert bool(found[0].isnan()) and float(found[1]) == pytest.approx(max(stationarity, complementarity), rel=1e-4)
    none = [torch.zeros_like(lam) for lam in lams]
    bare = (np.abs(slope_of(one, x)).max(0) / terms(one, X[b], x).max(0)).max()
    assert float(certify(problem, X, U, multipliers=none).kkt_residual[1]) == pytest.approx(bare, rel=1e-4)


def slope_of(problem: Problem, U: torch.Tensor, h: float = 1e-6) -> np.ndarray:
    """dJ/dU (N, m) by central differences through the rollout."""

    def cost(V: torch.Tensor) -> float:
        return float(problem.cost.total(open_loop(problem.dynamics, problem.x0, V), V))

    steps = h * torch.eye(U.numel(), dtype=U.dtype)
    found = [(cost(U + e.view_as(U)) - cost(U - e.view_as(U))) / (2 * h) for e in steps]
    return np.array(found).reshape(U.shape[1:])


def test_only_requested_problems_are_certified_each_on_its_own() -> None:
    problem, U = planar_batch(B=3, N=10)
    U = U.clone()
    X = open_loop(problem.dynamics, problem.x0, U)
    whole = certify(problem, X, U)
    some = certify(problem, X, U, torch.tensor([True, False, True]))
    X[2] = torch.nan
    broken = certify(problem, X, U)
    for name, column in vars(whole).items():
        assert torch.isnan(getattr(some, name)).tolist() == [False, True, False]
        assert torch.isnan(getattr(broken, name)).tolist() == [False, False, True]
        assert float(getattr(some, name)[0]) == float(column[0])
        alone = certify(problem.take(torch.tensor([1])), X[[1]], U[[1]])
        assert float(getattr(alone, name)) == float(column[1])
    assert set(frame_columns(whole)) <= set(COLUMNS) and len(frame_columns(whole)) == 6


def test_bad_calls_are_named() -> None:
    problem, U = planar_batch(B=2, N=5)
    X = open_loop(problem.dynamics, problem.x0, U)
    with pytest.raises(InputError, match="U: expected"):
        certify(problem, X, U[:1])
    with pytest.raises(InputError, match="X: expected"):
        certify(problem, X[:, 1:], U)
    with pytest.raises(InputError, match="asked: expected"):
        certify(problem, X, U, torch.tensor([True]))
    lams = [torch.zeros(2, *shape, dtype=torch.float64) for shape in problem.row_shapes]
    with pytest.raises(InputError, match="multipliers: expected 2 tensors, one per constraint"):
        certify(problem, X, U, multipliers=lams[:1])
    with pytest.raises(InputError, match=r"multipliers\[1\]: expected"):
        certify(problem, X, U, multipliers=[lams[0], lams[1][:1]])
    with pytest.raises(InputError, match="X: expected a float64 or float32 tensor"):
        certify(problem, X.half(), U)


def test_single_precision_is_certified_in_double() -> None:
    """The numbers are those of the trajectory as given: its rounding shows in the residual of the dynamics."""
    problem, U = planar_batch(B=2, N=8)
    single = problem.cast(torch.float32)
    X = open_loop(single.dynamics, single.x0, U.float() + 0.1)
    lams = [torch.rand(2, *shape, dtype=torch.float32) for shape in problem.row_shapes]
    for multipliers in (None, lams):
        given = None if multipliers is None else [lam.double() for lam in multipliers]
        double = certify(single.cast(torch.float64), X.double(), (U.float() + 0.1).double(), multipliers=given)
        for own in (single, single.cast(torch.float64)):
            proof = certify(own, X, U.float() + 0.1, multipliers=multipliers)
            assert all(torch.equal(a, b) for a, b in zip(vars(proof).values(), vars(double).values(), strict=True))
        assert proof.kkt_residual.dtype == torch.float64
        assert bool(((proof.dynamics_residual > 0) & (proof.dynamics_residual < 1e-6)).all())
