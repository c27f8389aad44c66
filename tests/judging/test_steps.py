"""Steps that are too long for their model, against exact solutions of drawn models, stiff ones and others."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.linalg as sl
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

import torchgco
from tests.problems import planar_batch
from torchgco import (
    ControlBounds,
    FreeTime,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    QuadrotorPlant,
    RateBounds,
    StepWarning,
    certify,
    judge,
)
from torchgco.dynamics.rollout import open_loop
from torchgco.judging.steps import step_errors
from torchgco.kernels import costates, current, regulated

D, DT, N = torch.float64, 0.1, 40
NAMES = ("place", "speed", "force")


def drag(speed: Any, linear: bool) -> Any:
    return 0.3 * speed * (1.0 if linear else (speed * speed + 0.1) ** 0.5)


def drawn(integrator: Any, linear: bool = True, B: int = 64, seed: int = 1, fastest: float = 1.5) -> Problem:
    """Carts pushed by an actuator that follows within 1 / rate: rate DT is drawn between 1 / 300 and 10^fastest."""
    draws = torch.Generator().manual_seed(seed)
    stiff = 10 ** (-2.5 + (2.5 + fastest) * torch.rand(B, generator=draws, dtype=D))

    def field(x: Tensor, u: Tensor, rate: Tensor) -> Tensor:
        pushed = x[..., 2] - drag(x[..., 1], linear)
        return torch.stack((x[..., 1], pushed, rate * (u[..., 0] - x[..., 2])), dim=-1)

    model = FunctionDynamics(field, 3, 1, DT, integrator, values={"rate": stiff / DT}, state_names=NAMES)
    ends = 0.5 + 2.0 * torch.rand(B, 1, 1, generator=draws, dtype=D)
    x_ref = ends * torch.tensor([1.0, 0.0, 0.0], dtype=D)
    cost = QuadraticCost([0.1, 0.0, 0.0], [0.05], [50.0, 20.0, 0.0], x_ref=x_ref)
    x0 = torch.randn(B, 3, generator=draws, dtype=D) * torch.tensor([0.2, 0.2, 1.0]).double()
    return Problem(model, cost, [ControlBounds(-2.0, 2.0)], x0, N)


def exact(problem: Problem, X: Tensor, U: Tensor, linear: bool) -> tuple[Tensor, Tensor]:
    """The cost (B,) of controls that are held exactly, and one exact step from every state of X, (B, N, 3)."""
    path, ahead, dt = X.clone(), torch.full_like(X[:, :-1], torch.inf), problem.dynamics.dt
    for b, rate in enumerate(problem.dynamics.values.rows[0].tolist()):
        A = np.array([[0, 1, 0, 0], [0, -0.3, 1, 0], [0, 0, -rate, rate], [0, 0, 0, 0]])
        E = sl.expm(dt * A)

        def step(x: Tensor, u: float, rate: float = rate, E: np.ndarray = E) -> Tensor:
            if linear:
                return torch.from_numpy((E @ np.append(x.numpy(), u))[:3])
            rates = lambda t, y: [y[1], y[2] - drag(y[1], linear), rate * (u - y[2])]
            return torch.from_numpy(solve_ivp(rates, (0, dt), x.numpy(), "Radau", rtol=1e-7, atol=1e-9).y[:, -1])

        for k in range(problem.N):
            path[b, k + 1] = step(path[b, k], float(U[b, k, 0]))
            if float(X[b, k].abs().max()) < 1e2:  # else the model's own steps have exploded
                ahead[b, k] = step(X[b, k], float(U[b, k, 0]))
    return problem.cost.total(path, U), ahead


def solved(problem: Problem) -> torchgco.Solution:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StepWarning)
        return torchgco.solve(problem, solver="interior_point")


@pytest.mark.parametrize(
    ("integrator", "linear", "B"),
    [("rk4", True, 64), ("midpoint", True, 64), pytest.param("rk4", False, 16, marks=pytest.mark.slow)],
)
def test_no_wrong_cost_is_missed_and_no_right_one_flagged(integrator: str, linear: bool, B: int) -> None:
    problem = drawn(integrator, linear, B, seed=1 if linear else 2, fastest=1.5 if linear else 2.0)
    found = solved(problem)
    claims = torch.tensor([status.name in ("CONVERGED", "FEASIBLE") for status in found.statuses])
    problem, found = problem.take(claims.nonzero().flatten()), found.take(claims)
    assert int(claims.sum()) >= 0.9 * B
    errors = step_errors(problem, found.X, found.U, None, found.multipliers.lam)
    cost, ahead = exact(problem, found.X, found.U, linear)
    wrong = (cost - found.cost).abs() / found.cost.abs()
    ranges = (found.X.amax(1, keepdim=True) - found.X.amin(1, keepdim=True)).clamp(min=1e-9)
    of_states = ((ahead - found.X[:, 1:]).abs() / ranges).flatten(1).amax(-1)
    assert int((wrong > 0.01).sum()) >= B // 16 and int((wrong < 1e-3).sum()) >= B // 3
    assert bool(errors.large[wrong > 0.01].all())
    assert not bool(errors.large[(wrong < 1e-3) & (of_states < 0.08)].any())
    small = of_states < 0.1  # to leading order the difference is the error, but for 1 - 2^-p of it
    assert bool((errors.step_error[small] < of_states[small] + 1e-9).all())
    assert bool((errors.step_error[small] > 0.6 * of_states[small] - 1e-9).all())
    slow = (errors.step_cost > 1e-6) & (errors.step_error < 0.02)
    assert bool((errors.step_cost[slow] / wrong[slow] - 0.85).abs().lt(0.25).float().mean() > 0.8)


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_tells_of_steps_that_no_state_tells_of(seed: int) -> None:
    """Swings that a midpoint step follows loosely: every difference is a small share of its range, all together not."""
    B, draws = 256, torch.Generator().manual_seed(seed)
    rate, loss = 0.5 + 12.0 * torch.rand(B, generator=draws, dtype=D), torch.rand(B, generator=draws, dtype=D)
    A, b = torch.zeros(B, 3, 3, dtype=D), torch.zeros(B, 3, 1, dtype=D)
    A[:, 0, 1], A[:, 2, 0], A[:, 2, 2], b[:, 1, 0] = 1.0, 1.0, -0.5, rate
    A[:, 1, 0], A[:, 1, 1] = -(rate**2), -(0.1 + 1.9 * loss) * rate
    field = lambda x, u, A, b: (A @ x.unsqueeze(-1) + b @ u.unsqueeze(-1))[..., 0]
    model = FunctionDynamics(field, 3, 1, DT, "midpoint", values={"A": A, "b": b})
    cost = QuadraticCost([1.0, 0.01, 0.01], [0.01], [10.0, 0.0, 0.0], x_ref=[1.0, 0.0, 0.0])
    problem = Problem(model, cost, [ControlBounds(-3.0, 3.0)], torch.zeros(B, 3, dtype=D), 20)
    found = solved(problem)
    errors = step_errors(problem, found.X, found.U, None, found.multipliers.lam)
    E = torch.linalg.matrix_exp(DT * torch.cat((torch.cat((A, b), -1), torch.zeros(B, 1, 4, dtype=D)), 1))
    path = found.X.clone()
    for k in range(problem.N):
        path[:, k + 1] = (E[:, :3, :3] @ path[:, k].unsqueeze(-1) + E[:, :3, 3:] @ found.U[:, k].unsqueeze(-1))[..., 0]
    wrong = (problem.cost.total(path, found.U) - found.cost).abs() / found.cost.abs()
    missed = ~errors.large & (wrong > 0.01)
    assert int((wrong > 0.01).sum()) >= 64 and int(missed.sum()) <= 0.1 * int((wrong > 0.01).sum())
    assert not bool(missed[wrong > 0.02].any())  # to first order errors are what they are said to be
    assert not bool(errors.large[(wrong < 0.007) & (errors.step_error < 0.1)].any())


def exactly(problem: Problem, A: Tensor, b: Tensor) -> Problem:
    """The problem with the exact steps of x' = A x + b u, A (B, n, n), b (B, n, 1)."""
    n, dt = problem.n, problem.dynamics.dt
    E = torch.linalg.matrix_exp(
        dt * torch.cat((torch.cat((A, b), -1), torch.zeros_like(A[:, :1, :1]).expand(-1, 1, n + 1)), 1)
    )
    values = {"A": E[:, :n, :n].clone(), "b": E[:, :n, n:].clone()}
    return replace(problem, dynamics=FunctionDynamics(linear, n, 1, dt, "none", values=values))


def linear(x: Tensor, u: Tensor, A: Tensor, b: Tensor) -> Tensor:
    return (A @ x.unsqueeze(-1) + b @ u.unsqueeze(-1))[..., 0]


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("integrator", "fastest"), [("midpoint", 0.2), ("rk4", 0.7)])
@pytest.mark.parametrize("turns", [True, False])
def test_least_costs_that_are_off_are_told_where_costates_nearly_vanish(
    integrator: Any, fastest: float, turns: bool
) -> None:
    """Oscillators without damping, and saddles, which end near their reference."""
    B, dt, draws = 64, 0.475, torch.Generator().manual_seed(7)
    rate, angle = torch.rand(2, B, generator=draws, dtype=D).unbind(0)
    rate, angle = 10 ** (-1.0 + (1.0 + fastest) * rate), 2.0 * np.pi * angle
    A, b = torch.zeros(B, 2, 2, dtype=D), torch.tensor([[0.0], [1.0]], dtype=D).repeat(B, 1, 1)
    A[:, 0, 1], A[:, 1, 0] = rate, -rate if turns else rate
    model = FunctionDynamics(linear, 2, 1, dt, integrator, values={"A": A, "b": b})
    cost = QuadraticCost([0.0, 0.0], [1e-2], [10.0, 10.0], x_ref=[0.0, 0.0])
    x0 = torch.stack((angle.cos(), angle.sin()), -1)
    problem = Problem(model, cost, [ControlBounds(-3.0, 3.0)], x0, 8)
    found, least = solved(problem), solved(exactly(problem, A, b)).cost
    errors = step_errors(problem, found.X, found.U, None, found.multipliers.lam, doubted=True)
    off = (found.cost - least).abs() / least
    assert int((off > 0.012).sum()) >= 8 and int((off < 0.003).sum()) >= 8
    assert bool(errors.large[off > 0.012].all())
    assert int((errors.large & (off < 0.003)).sum()) <= 1


class Flown:
    """A linear model with a quadratic cost along drawn controls, and flights of half steps by a feedback."""

    stages, dt = 9, 0.2

    def __init__(self, order: int, draws: np.random.Generator) -> None:
        self.A, self.b, self.order = draws.normal(size=(3, 3)), draws.normal(size=(3, 2)), order
        self.q, self.r = draws.uniform(0.0, 1.0, 3), draws.uniform(0.1, 1.0, 2)
        self.qf, self.ends = draws.uniform(0.0, 9.0, 3), draws.normal(size=3)
        self.U, self.X = draws.normal(size=(self.stages, 2)), [draws.normal(size=3)]
        whole, half = self.step(self.dt), self.step(0.5 * self.dt)
        for u in self.U:
            self.X.append(whole[0] @ self.X[-1] + whole[1] @ u)
        self.F, self.G = half[0] @ half[0], half[0] @ half[1] + half[1]

    def step(self, h: float) -> tuple[np.ndarray, np.ndarray]:
        """By the series of the exponential, as far as the method's order."""
        term, by_x, by_u = np.eye(3), np.eye(3), np.zeros((3, 3))
        for i in range(1, self.order + 1):
            by_u = by_u + h / i * term
            term = h / i * self.A @ term
            by_x = by_x + term
        return by_x, by_u @ self.b

    def gains(self) -> list[np.ndarray]:
        P, gains = np.diag(self.qf), []
        for _ in range(self.stages):
            K = -np.linalg.solve(np.diag(self.r) + self.G.T @ P @ self.G, self.G.T @ P @ self.F)
            P = np.diag(self.q) + self.F.T @ P @ (self.F + self.G @ K)
            gains.insert(0, K)
        return gains

    def cost(self, share: float, gains: list[np.ndarray]) -> float:
        """With that share of the differences of whole and half steps."""
        x, total = self.X[0], 0.0
        for k, K in enumerate(gains):
            u = self.U[k] + K @ (x - self.X[k])
            total += 0.5 * (self.q @ (x - self.ends) ** 2 + self.r @ u**2)
            e = self.X[k + 1] - self.F @ self.X[k] - self.G @ self.U[k]
            x = self.F @ x + self.G @ u + (1.0 - share) * e
        return total + 0.5 * self.qf @ (x - self.ends) ** 2

    def step_cost(self, gains: list[np.ndarray]) -> float:
        more, less, plain = (self.cost(share, gains) for share in (1.0, -1.0, 0.0))
        first, second = 0.5 * (more - less), 0.5 * (more + less) - plain
        return (abs(first) + second / (1.0 - 0.5**self.order)) / plain


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
@pytest.mark.parametrize("seed", range(4))
def test_step_costs_are_those_of_flights_by_half_steps_with_feedback(integrator: Any, order: int, seed: int) -> None:
    """Both orders are exact here. Without multipliers the controls stay."""
    plain = Flown(order, np.random.default_rng(seed))
    A, b = torch.tensor(plain.A), torch.tensor(plain.b)
    model = FunctionDynamics(lambda x, u: x @ A.mT + u @ b.mT, 3, 2, plain.dt, integrator)
    cost = QuadraticCost(plain.q.tolist(), plain.r.tolist(), plain.qf.tolist(), x_ref=plain.ends.tolist())
    X, U = torch.tensor(np.array(plain.X)).unsqueeze(0), torch.tensor(plain.U).unsqueeze(0)
    problem, gains = Problem(model, cost, [], X[:, 0], plain.stages), plain.gains()
    steered, held = certify(problem, X, U, multipliers=[]).step_cost, judge(problem, U).step_cost
    assert float(steered) == pytest.approx(plain.step_cost(gains), rel=1e-8)
    assert float(held) == pytest.approx(plain.step_cost([0.0 * K for K in gains]), rel=1e-8)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("integrator", ["euler", "implicit_euler"])
def test_costs_that_euler_steps_change_by_over_one_per_cent_are_told(integrator: str) -> None:
    """Twice the step cost is the error of the least cost; beyond rate dt = 2 Euler's steps explode."""
    missed, off, false, right = 0, 0, 0, 0
    for dt in (DT, 0.1 * DT):
        problem = drawn(integrator)
        problem = replace(problem, dynamics=replace(problem.dynamics, dt=dt))
        found = solved(problem)
        errors = step_errors(problem, found.X, found.U, None, found.multipliers.lam, doubted=True)
        rate, zero = problem.dynamics.values.rows[0], torch.zeros(64, dtype=D)
        A = torch.stack([zero, zero + 1.0, zero, zero, zero - 0.3, zero + 1.0, zero, zero, -rate], -1).view(64, 3, 3)
        least = solved(exactly(problem, A, torch.stack((zero, zero, rate), -1).unsqueeze(-1))).cost
        wrong = (least - found.cost).abs() / found.cost.abs()
        stiff = problem.dynamics.values.rows[0] * dt
        wide, small = (wrong > 0.012) & (stiff < 0.5), (wrong < 0.008) & (stiff < 0.5)
        missed, off = missed + int((wide & ~errors.large).sum()), off + int((wide & (wrong < 0.1)).sum())
        false, right = false + int((small & errors.large).sum()), right + int(small.sum())
        seen = (wrong > 1e-3) & (stiff < 0.5)
        ratio = 2.0 * errors.step_cost[seen] / wrong[seen]
        assert bool((ratio > 0.9).all()) and bool(((ratio - 1.0).abs() < 0.25).float().mean() > 0.7)
        assert integrator != "euler" or bool(errors.large[stiff > 2.0].all())
    assert missed == 0 and off >= 16 and false <= 2 and right >= 32


@pytest.mark.slow
def test_the_error_of_eulers_steps_is_said_but_not_of_published_ones() -> None:
    few = torch.tensor([0, 1, 2, 3])
    with pytest.warns(StepWarning, match="^Euler's steps change the costs of . of 4 .*=.rk4., or a smaller dt"):
        found = torchgco.solve(drawn("euler", fastest=-1.0).take(few))
    assert "the cost by" in found.explain(1)
    planar, U0 = planar_batch(B=4, N=30, obstacles=4, seed=1)  # whose costs are off by up to 3 %
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchgco.solve(planar, U0)


def test_a_solve_warns_of_dt_and_the_state_and_explain_and_judge_say_it() -> None:
    problem = drawn("rk4", B=4, seed=3).take(torch.tensor([0, 1, 2, 3]))
    rates = torch.tensor([1.0, 100.0, 2.0, 0.5], dtype=D)
    values = replace(problem.dynamics.values, rows=(rates,))
    problem = replace(problem, dynamics=replace(problem.dynamics, values=values))
    with pytest.warns(StepWarning, match=r"1 of 4 .* problem 1, where half of dt = 0.1 s changes state 2 \(force\)"):
        found = torchgco.solve(problem)
    assert "steps are too long for the model: half of dt = 0.1 s changes state 2 (force)" in found.explain(1)
    assert "A smaller dt" in found.explain(1) and "too long" not in found.explain(0)
    lams = found.multipliers.lam
    of_all = step_errors(problem, found.X, found.U, None, lams)
    verdict, certificate = judge(problem, found.U), certify(problem, found.X, found.U, multipliers=lams)
    assert torch.equal(certificate.step_error, of_all.step_error)
    assert torch.equal(certificate.step_cost, of_all.step_cost)
    torch.testing.assert_close(verdict.step_error, of_all.step_error, rtol=1e-6, atol=1e-12)
    assert bool((verdict.step_cost >= 0.999 * of_all.step_cost).all())  # of these controls without feedback
    assert of_all.large.tolist() == [False, True, False, False]
    for b in range(4):  # no number depends on the others
        rows = torch.tensor([b])
        alone = step_errors(problem.take(rows), found.X[rows], found.U[rows], None, [lam[rows] for lam in lams])
        assert torch.equal(alone.step_error, of_all.step_error[rows])
        assert torch.equal(alone.step_cost, of_all.step_cost[rows])
    asked = torch.tensor([True, True, False, True])
    broken = torch.where(torch.tensor([0.0, 0.0, 0.0, torch.nan]).view(-1, 1, 1).isnan(), torch.nan, found.X)
    some = certify(problem, broken, found.U, asked)
    assert some.step_error.isnan().tolist() == some.step_cost.isnan().tolist() == [False, False, True, True]
    single = judge(problem.cast(torch.float32), found.U.float())
    torch.testing.assert_close(single.step_error[[0, 2, 3]], verdict.step_error[[0, 2, 3]], rtol=1e-3, atol=1e-9)


def test_a_model_without_a_known_field_has_no_errors() -> None:
    plain = drawn("rk4", B=3)
    step = lambda x, u: x + DT * torch.stack((x[..., 1], u[..., 0], 100.0 * (u[..., 0] - x[..., 2])), -1)
    problem = replace(plain, dynamics=FunctionDynamics(step, 3, 1, DT, "none"))
    found = torchgco.solve(problem)  # every warning is an error here
    verdict = judge(problem, found.U)
    assert bool(verdict.step_error.isnan().all()) and bool(verdict.step_cost.isnan().all())
    assert "too long" not in found.explain(0)


def test_half_steps_that_are_nan_where_whole_ones_are_not_are_large() -> None:
    field = lambda x, u: torch.where((x > 0.4) & (x < 0.6), torch.nan, 1.0 + 0.0 * u)
    problem = Problem(FunctionDynamics(field, 1, 1, 1.0, "euler"), QuadraticCost([1.0], [1.0], [1.0]), [], [[0.0]], 2)
    X, U = torch.tensor([[[0.0], [1.0], [2.0]]], dtype=D), torch.zeros(1, 2, 1, dtype=D)
    errors = step_errors(problem, X, U)
    assert float(errors.step_error) == torch.inf and bool(errors.large) and bool(errors.step_cost.isnan())
    assert errors.told(0, problem) == "half of dt = 1 s makes state 0 NaN at stage 0"


def by_hand(field: Any, x: Tensor, u: Tensor, h: Tensor) -> Tensor:
    """A step of Runge and Kutta over h (..., 1)."""
    k1 = field(x, u)
    k2 = field(x + 0.5 * h * k1, u)
    k3 = field(x + 0.5 * h * k2, u)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + field(x + h * k3, u))


def swing(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], u[..., 0] - 3.0 * x[..., 0].sin() * x[..., 1].cos()), dim=-1)


class ByHand:
    """Twelve stages of `swing` for two problems that last `last` stages: states, differences of steps, costs.

    Stages of `lengths` (2, 12), s, at which the field counts `factor` (12,) times.
    """

    x0 = torch.tensor([[1.0, 0.0], [0.4, -1.0]], dtype=D)
    U = torch.randn(2, 12, 1, dtype=D, generator=torch.Generator().manual_seed(2))

    def __init__(self, last: list[int], times: Tensor | None, factor: Tensor) -> None:
        self.last, self.timed, self.factor = last, times is not None, factor
        self.lengths = torch.full((2, 12), 0.3, dtype=D) if times is None else times.diff(dim=1)

    def steps(self, x: Tensor, k: int) -> tuple[Tensor, Tensor]:
        """States after stage k from x (2, 2): by one step and by two of half the length."""
        h, u = (self.lengths[:, k] * self.factor[k]).unsqueeze(-1), self.U[:, k]
        runs = torch.tensor([k < last for last in self.last]).unsqueeze(-1)
        once, twice = by_hand(swing, x, u, h), by_hand(swing, by_hand(swing, x, u, 0.5 * h), u, 0.5 * h)
        return torch.where(runs, once, x), torch.where(runs, twice, x)

    def rolled(self) -> tuple[Tensor, Tensor]:
        """States of whole steps, and their differences from two halves."""
        x, X, E = self.x0, [self.x0], []
        for k in range(12):
            once, twice = self.steps(x, k)
            E.append(once - twice)
            x = once
            X.append(x)
        return torch.stack(X, 1), torch.stack(E, 1)

    def without(self, share: float, E: Tensor) -> Tensor:
        """States of two halves a stage and all of the differences E but a share."""
        X = [self.x0]
        for k in range(12):
            X.append(self.steps(X[-1], k)[1] + (1.0 - share) * E[:, k])
        return torch.stack(X, 1)

    def cost(self, X: Tensor) -> Tensor:
        found = []
        for b, last in enumerate(self.last):
            own = self.lengths[b, :last]
            tau, clock = (own / 0.3, own.sum()) if self.timed else (torch.ones_like(own), 0.0)
            found.append((tau * (self.U[b, :last, 0].square() + 1.0)).sum() + clock + X[b, -1].square().sum())
        return torch.stack(found)


@pytest.mark.parametrize("kind", ["free time", "horizons", "stages"])
def test_free_times_horizons_rates_and_stages_count(kind: str) -> None:
    """The differences by hand; and the step cost against costs of rollouts with these differences put in."""
    model, limits = FunctionDynamics(swing, 2, 1, 0.3, "rk4"), [RateBounds(-9.0, 9.0)]
    effort = FunctionCost(lambda x, u: u[..., 0].square() + 1.0, lambda x: x.square().sum(-1))
    times, last, factor = None, [12, 12], torch.ones(12, dtype=D)
    if kind == "free time":
        times = 0.3 * torch.tensor([0.5] * 4 + [1.0] * 4 + [2.5] * 4, dtype=D).cumsum(0).expand(2, -1)
        times = torch.cat((torch.zeros(2, 1, dtype=D), times), dim=1)
        problem = Problem(model, effort, limits, ByHand.x0, 12, time=FreeTime(0.1, 4.0, segments=3))
    elif kind == "horizons":
        last = [12, 7]
        problem = Problem(model, effort, limits, ByHand.x0, 12, horizon=torch.tensor(last))
    else:
        factor = torch.linspace(0.5, 3.0, 12, dtype=D)
        rates = lambda x, u, pull: swing(x, u) * pull
        more = {"knot_values": {"pull": factor.view(1, 12, 1)}}
        problem = Problem(FunctionDynamics(rates, 2, 1, 0.3, "rk4", **more), effort, [], ByHand.x0, 12)
    plain = ByHand(last, times, factor)
    X, E = plain.rolled()
    found = step_errors(problem, X, plain.U, times)
    ranges = X.amax(1, keepdim=True) - X.amin(1, keepdim=True)
    torch.testing.assert_close(found.step_error, (E.abs() / ranges).flatten(1).amax(-1), rtol=1e-8, atol=0)
    less, more = plain.without(1e-4, E), plain.without(-1e-4, E)
    slope, moved = (plain.cost(less) - plain.cost(more)) / 2e-4, (less - more) / 2e-4
    bent = 0.5 * (plain.cost(X + moved) + plain.cost(X - moved)) - plain.cost(X)
    torch.testing.assert_close(found.step_cost, (slope.abs() + bent * 16 / 15) / plain.cost(X), rtol=1e-3, atol=1e-12)
    assert bool((found.step_cost > 1e-7).all())


@pytest.mark.slow
def test_given_multipliers_count_what_a_row_costs() -> None:
    """A required end: the cost of the controls alone hardly changes, that of arriving does."""
    field = lambda x, u: torch.stack((x[..., 1], u[..., 0] - 2.0 * x[..., 0].sin()), dim=-1)
    ends = FunctionConstraint(lambda x: x - torch.tensor([1.0, 0.0], dtype=x.dtype), "equality", [-1])
    costs = {}
    for dt, stages in ((0.4, 10), (0.1, 40)):
        effort = FunctionCost(lambda x, u, dt=dt: dt * u[..., 0].square())
        problem = Problem(FunctionDynamics(field, 2, 1, dt, "midpoint"), effort, [ends], [[0.0, 0.0]], stages)
        found = solved(problem)
        own = judge(problem, found.U)
        given = certify(problem, found.X, found.U, multipliers=found.multipliers.lam)
        assert float(own.step_cost) == 0.0
        costs[dt] = float(given.step_cost)
    assert costs[0.4] > 5 * costs[0.1] > 0


def test_limits_and_unit_quaternions_are_kept_within_half_steps() -> None:
    """A plant that settles after every step: in its hover the errors are those of rounding."""
    plant = QuadrotorPlant()
    x = torch.zeros(1, 17, dtype=D)
    x[:, 6], x[:, 13:] = 1.0, plant.airframe.mass * plant.airframe.gravity / 4
    hover = Problem(plant, QuadraticCost([1.0] * 17, [0.0] * 4, [1.0] * 17), [], x, 5)
    speed = plant.airframe.speed(x[:, 13:]) if hasattr(plant.airframe, "speed") else None
    U = torch.full((1, 5, 4), 15000.0, dtype=D) if speed is None else speed.unsqueeze(1).expand(1, 5, 4)
    found = judge(hover, U.contiguous())
    assert float(found.step_error) < 0.05 and bool(torch.isfinite(found.step_cost).all())


def test_a_problem_without_a_regulator_leaves_others_as_they_are() -> None:
    """Where the cost is concave in the controls, these stay; the problems beside it keep their bits."""
    problem = planar_batch(B=5, N=20)[0]
    weights = torch.tensor([1.0, -1e3, 0.5, 2.0, -1e3], dtype=D)
    cost = FunctionCost(
        lambda x, u, w: x.square().sum(-1) + w * u.square().sum(-1), lambda x: x.square().sum(-1), values={"w": weights}
    )
    problem = Problem(problem.dynamics, cost, [], problem.x0, 20)
    U = 0.1 * torch.ones(5, 20, problem.m, dtype=D)
    X = open_loop(problem.dynamics, problem.x0, U)
    whole = step_errors(problem, X, U, None, ()).step_cost
    for b in range(5):
        rows = torch.tensor([b])
        assert torch.equal(step_errors(problem.take(rows), X[rows], U[rows], None, ()).step_cost, whole[rows])
    assert bool((torch.isfinite(whole) & (whole > 0)).all())


def test_costates_in_c_say_what_steps_cost() -> None:
    problem, U0 = planar_batch(B=4, N=30, obstacles=4, seed=1)
    problem = current(problem)
    found = torchgco.solve(problem, U0)
    assert any(bool(lam.any()) for lam in found.multipliers.lam)
    lams = found.multipliers.lam
    assert costates(problem, found.X, found.U, lams) is not None
    plain = step_errors(problem, found.X, found.U, None, lams).step_cost
    assert bool((plain > 0).all())
    for kernels in ((costates, None), (costates, regulated)):
        by = step_errors(problem, found.X, found.U, None, lams, kernels=kernels).step_cost
        torch.testing.assert_close(by, plain, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("of", ["bounds", "functions", "concave"])
def test_the_regulator_in_c_answers_as_that_in_numpy(of: str) -> None:
    """Where control rows bind; where a constraint of states and controls is traced; where controls stay."""
    plain = planar_batch(B=5, N=20)[0]
    weights = torch.tensor([1.0, -1e3 if of == "concave" else 3.0, 0.5, 2.0, 0.1], dtype=D)
    cost = FunctionCost(
        lambda x, u, w: x.square().sum(-1) + w * u.square().sum(-1), lambda x: x.square().sum(-1), values={"w": weights}
    )
    rows = {
        "bounds": [ControlBounds([-0.3] * plain.m, [0.3] * plain.m)], "concave": [],
        "functions": [FunctionConstraint(lambda x, u: u[..., :1] + 0.1 * x[..., :1].square() - 0.2, of="xu")],
    }  # fmt: skip
    problem = current(Problem(plain.dynamics, cost, rows[of], plain.x0, 20))
    U = torch.full((5, 20, plain.m), 0.3 - 1e-9, dtype=D)
    X = torchgco.kernels.open_loop(problem, U)
    lams = [torch.rand(5, *shape, dtype=D, generator=torch.Generator().manual_seed(1)) for shape in problem.row_shapes]
    by_c, plainly = (
        step_errors(problem, X, U, None, lams, kernels=(costates, by)).step_cost for by in (regulated, None)
    )
    torch.testing.assert_close(by_c, plainly, rtol=1e-8, atol=0.0)
    assert bool((by_c > 0).all())
    for b in range(5):  # no number depends on the others
        one = problem.take([b])
        alone = step_errors(
            one, X[b : b + 1], U[b : b + 1], None, [lam[b : b + 1] for lam in lams], kernels=(costates, regulated)
        )
        assert torch.equal(alone.step_cost, by_c[b : b + 1])
