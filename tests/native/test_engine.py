"""Inner solves in C against those in PyTorch, with every kind of part that a problem may have."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.engines import engine_of, in_c
from tests.problems import boxed_batch, planar_batch, quadrotor_batch
from tests.slow import mostly
from torchgco import (
    ILQR,
    AugmentedLagrangian,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    LineSearch,
    Planar,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    kernels,
)
from torchgco.dynamics.rollout import open_loop
from torchgco.ilqr import step as iteration
from torchgco.ilqr.riccati import backward
from torchgco.ilqr.step import iterate
from torchgco.kernels import EagerWarning, kernels_of
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers, PassEnd, State, linearise
from torchgco.lagrangian.penalties import GuidePath, GuideRegion
from torchgco.solvers import ilqr
from torchgco.solvers.ending import optimality

DAMPED = ILQR()
BRIEF = replace(DAMPED, line_search=LineSearch(back=2))
PRINTED = ILQR(as_printed=True, tolerance=0.1, max_iterations=15)


@pytest.fixture(autouse=True)
def native_again() -> Iterator[None]:
    yield
    kernels.use_native(True)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def user_problem(B: int = 5, N: int = 12) -> Problem:
    """A car as a function, with weight matrices, function constraints and bounded states."""

    def field(x: Tensor, u: Tensor) -> Tensor:
        speed = torch.tanh(x[..., 3])
        return torch.stack((speed * x[..., 2].cos(), speed * x[..., 2].sin(), u[..., 1], u[..., 0]), dim=-1)

    W = normal(6, 6, seed=2)
    W = W @ W.T / 6 + 0.1 * torch.eye(6, dtype=torch.float64)
    return Problem(
        FunctionDynamics(field, 4, 2, dt=0.1, integrator="rk4", position=slice(0, 2)),
        QuadraticCost(
            Q=W[:4, :4], R=W[4:, 4:], Qf=10 * W[:4, :4], H=W[4:, :4], x_ref=normal(N + 1, 4, seed=3),
            q=[0.1, 0, 0, 0.2], r=[0.3, -0.1], qf=[1.0, 0, 0, 0], u_ref=normal(N, 2, seed=4),
        ),
        [
            FunctionConstraint(lambda x: 0.3 - (x[..., :2] - 0.5).square().sum(-1, keepdim=True), geometric=True),
            FunctionConstraint(lambda x, u: (u * x[..., :2]).sum(-1, keepdim=True) - 1.0, of="xu", knots=[0, 3, 7]),
            FunctionConstraint(lambda x: x[..., 3:] - 0.1, sense="equality", knots=[-1]),
            StateBounds([-torch.inf, -0.5, -1.0, -torch.inf], [torch.inf, 0.5, torch.inf, 0.8]),
            ControlBounds([-1.0, -torch.inf], [torch.inf, 2.0]),
        ],
        0.3 * normal(B, 4),
        N,
    )  # fmt: skip


def moving_problem(B: int = 5, N: int = 15) -> Problem:
    """Planar vehicles of different drag among moving discs, one of them absent, with goals per problem."""
    centers, radii = 0.5 * normal(B, 3, 2, seed=5), torch.full((B, 3), 0.2, dtype=torch.float64)
    centers[1, 2], radii[1, 2] = torch.nan, torch.nan
    goal = torch.zeros(B, 1, 6, dtype=torch.float64)
    goal[:, 0, :2] = 1.0 + 0.2 * normal(B, 2, seed=6)
    start = torch.zeros(B, 6, dtype=torch.float64)
    start[:, 0] = -1.0
    return Problem(
        Planar(dt=0.05, drag=8.0 + normal(B).abs()),
        QuadraticCost(Q=[5, 5, 0, 1, 1, 0], R=[0.1, 0.1], Qf=[50, 50, 0, 1, 1, 0], x_ref=goal),
        [Spheres(centers, radii, 0.05, velocities=0.3 * normal(B, 3, 2, seed=7)), ControlBounds([-10, -10], [10, 10])],
        start, N,
    )  # fmt: skip


def linear_problem(n: int, m: int, N: int, B: int = 3) -> Problem:
    A, C = torch.eye(n, dtype=torch.float64) + 0.1 * normal(n, n, seed=8), normal(n, m, seed=9)
    dynamics = FunctionDynamics(
        lambda x, u: (A * x.unsqueeze(-2)).sum(-1) + (C * u.unsqueeze(-2)).sum(-1), n, m, dt=1.0, integrator="none"
    )
    cost = QuadraticCost(Q=[1.0] * n, R=[0.5] * m, Qf=[2.0] * n)
    return Problem(dynamics, cost, [ControlBounds([-0.1] * m, [0.1] * m)], normal(B, n), N)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "planar": lambda: planar_batch(B=5, N=20, obstacles=5)[0],
    "quadrotor": lambda: quadrotor_batch(B=5, N=15, obstacles=5)[0],
    "a user's model": user_problem,
    "moving": moving_problem,
    "boxes": lambda: boxed_batch(2, B=5, N=20)[0],
    "boxes in space": lambda: boxed_batch(3, B=5, N=15)[0],
    "one stage": lambda: planar_batch(B=3, N=1, obstacles=2)[0],
}


def running_state(
    problem: Problem, guided: str | None = None, phr: bool = True, seed: int = 0
) -> tuple[State, Lagrangian]:
    """The state of a running loop at random controls, and its Lagrangian with nonzero multipliers and penalties."""
    B = problem.B
    U = problem.cost.rest_controls(problem.x0.new_zeros(B, problem.N, problem.m)) + 0.5 * normal(
        B, problem.N, problem.m, seed=seed
    )
    X = open_loop(problem.dynamics, problem.x0, U)
    multipliers = Multipliers.zero(problem, 3.0)
    lam = []
    for constraint, zero in zip(problem.constraints, multipliers.lam, strict=True):
        drawn = normal(*zero.shape, seed=11)
        lam.append(drawn if constraint.sense == "equality" else drawn.clamp(min=0.0))
    at = problem.dynamics.position
    penalty = None
    if guided is not None:
        center, weight = X[..., at] + 0.1 * normal(*X[..., at].shape, seed=12), torch.full((B,), 4.0, dtype=X.dtype)
        radius = torch.where(normal(B, problem.N + 1, seed=13) > 0, 0.05, torch.inf)
        penalty = GuidePath(center, weight, at) if guided == "path" else GuideRegion(center, radius, weight, at)
    lagrangian = Lagrangian(problem, Multipliers(tuple(lam), multipliers.mu), penalty, phr)
    cost, merit = lagrangian.value(X, U)
    zero = torch.zeros(B, dtype=torch.int64)
    blank = dict.fromkeys(State.__dataclass_fields__)
    state = State(
        **{
            **blank, "rows": torch.arange(B), "X": X, "U": U, "cost": cost, "merit": merit,
            "inner": zero, "iterations": zero.clone(), "rung": zero.clone(),
            "regularisation": torch.zeros_like(cost), "outer": zero.clone(),
        }
    )  # fmt: skip
    return state, lagrangian


def eager(inner: ILQR, state: State, lagrangian: Lagrangian, count: int) -> dict[int, tuple[bool, bool, int]]:
    """PyTorch iterations until each problem ends or made `count`: per problem (converged, stuck, iterations)."""
    ends: dict[int, tuple[bool, bool, int]] = {}
    for _ in range(20 * count):  # a factorisation that fails is tried again, from a mu_r of 1e-6 up to 1e8 by tens
        frozen = replace(state)
        end = iterate(inner.descent, state, lagrangian)
        for b in range(lagrangian.problem.B):
            if b in ends:  # an ended problem keeps its state
                for name in ("X", "U", "cost", "merit", "inner", "iterations", "rung", "regularisation"):
                    getattr(state, name)[b] = getattr(frozen, name)[b]
            elif bool(end.ended[b]) or int(state.iterations[b]) == count:
                ends[b] = bool(end.converged[b]), bool(end.stuck[b]), int(state.iterations[b])
        if len(ends) == lagrangian.problem.B:
            break
    return ends


def natively(inner: ILQR, state: State, lagrangian: Lagrangian, count: int) -> PassEnd:
    """Up to `count` iterations of every problem by native kernels."""
    assert engine_of(lagrangian.problem) is not None
    return kernels_of(lagrangian.problem).descend(lagrangian, state, inner.descent, count)


@pytest.mark.sampled(7)
@pytest.mark.parametrize("phr", mostly([True, False], False), ids=["phr", "printed"])
@pytest.mark.parametrize("guided", [None, "region", "path"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_value_expansion_and_rollouts_are_pytorchs(name: str, guided: str | None, phr: bool) -> None:
    problem = PROBLEMS[name]()
    state, lagrangian = running_state(problem, guided, phr)
    kernels = in_c(problem)
    assert kernels is not None
    for mine, theirs in zip(kernels.value(lagrangian, state.X, state.U), lagrangian.value(
        state.X, state.U
    ), strict=True):  # fmt: skip
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(kernels.open_loop(problem, state.U), state.X, rtol=1e-10, atol=1e-12)
    for inner, count in ((DAMPED, 1), (DAMPED, 4), (BRIEF, 4), (PRINTED, 4)):
        (a, first), (b, second) = running_state(problem, guided, phr), running_state(problem, guided, phr)
        ends = eager(inner, a, first, count)
        out = natively(inner, b, second, count)
        torch.testing.assert_close(b.merit, a.merit, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(b.U, a.U, rtol=1e-8, atol=1e-8)
        assert torch.equal(b.iterations, a.iterations) and torch.equal(b.inner, a.inner)
        assert torch.equal(b.rung, a.rung) and (inner is BRIEF or not b.rung.any())
        torch.testing.assert_close(b.regularisation, a.regularisation, rtol=1e-10, atol=0)
        assert [bool(x) for x in out.converged] == [ends[i][0] for i in range(problem.B)]


@pytest.mark.parametrize("name", PROBLEMS)
def test_gains_and_optimality_are_pytorchs(name: str) -> None:
    problem = PROBLEMS[name]()
    state, lagrangian = running_state(problem)
    native = optimality(lagrangian, state.X, state.U)
    kernels.use_native(False)
    plain = optimality(lagrangian, state.X, state.U)
    torch.testing.assert_close(native.gains, plain.gains, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(native.worst, plain.worst, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(native.left, plain.left, rtol=1e-8, atol=0)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("mu_r", [0.0, 0.7])
def test_a_regularised_backward_pass_expects_pytorchs_change(mu_r: float) -> None:
    problem = quadrotor_batch(B=5, N=15, obstacles=5)[0]
    state, lagrangian = running_state(problem)
    mu = torch.full((5,), mu_r, dtype=torch.float64)
    want = backward(linearise(problem, state.X, state.U), lagrangian.expand_optimality(state.X, state.U), mu)
    mine = in_c(problem).judged(lagrangian, state.X, state.U).run(mu)
    assert torch.equal(mine.failed, want.failed) and not bool(mine.failed.any())
    torch.testing.assert_close(mine.gains, want.gains, rtol=1e-8, atol=1e-8)
    for alpha in (0.25, 1.0):
        steps = torch.full_like(mu, alpha)
        torch.testing.assert_close(mine.expected_change(steps), want.expected_change(steps), rtol=1e-9, atol=0)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("n", "m", "N"), [(1, 1, 1), (2, 3, 4), (5, 1, 9), (20, 20, 3), (13, 4, 1), (40, 3, 2)])
def test_models_of_any_size(n: int, m: int, N: int) -> None:
    problem = linear_problem(n, m, N)
    (a, first), (b, second) = running_state(problem), running_state(problem)
    eager(DAMPED, a, first, 5)
    natively(DAMPED, b, second, 5)
    torch.testing.assert_close(b.merit, a.merit, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(b.U, a.U, rtol=1e-8, atol=1e-8)


def test_multipliers_without_memory_are_zeros() -> None:
    problem, U = boxed_batch(3, B=5, N=8)
    zero = Multipliers.zero(problem, 4.0)
    none = Multipliers.none(problem, zero.mu)
    assert all(torch.equal(a, b) for a, b in zip(none.lam, zero.lam, strict=True))
    some = replace(none, lam=tuple(torch.full_like(lam[:1, :1, :1], 0.3).expand_as(lam) for lam in none.lam))
    assert not any(lam.untyped_storage().nbytes() > 8 for multipliers in (none, some) for lam in multipliers.lam)
    kernels, U = in_c(problem), 0.3 * U
    assert kernels is not None
    X = kernels.open_loop(problem, U)
    worth = []
    for multipliers in (zero, none, some):
        lagrangian = Lagrangian(problem, multipliers, None, True)
        values = kernels.value(lagrangian, X, U)
        torch.testing.assert_close(values, lagrangian.value(X, U), rtol=1e-10, atol=1e-10)
        end, status = ilqr.descend(ILQR(max_iterations=6), lagrangian, U)
        worth.append((*values, end.X, end.U, end.merit, status))
    assert all(torch.equal(a, b) for a, b in zip(worth[0], worth[1], strict=True))
    assert not torch.equal(worth[1][1], worth[2][1])


@pytest.mark.parametrize("B", [1, 2, 3, 7, 8, 9, 40])
def test_a_problem_has_the_same_bits_in_every_batch(B: int) -> None:
    whole = planar_batch(B=40, N=15, obstacles=5)[0]
    all_of_them, lagrangian = running_state(whole)
    natively(DAMPED, all_of_them, lagrangian, 6)
    state, lagrangian = running_state(whole)
    rows = torch.arange(B).flip(0)
    part = replace(state, **{
        name: getattr(state, name)[rows]
        for name in ("X", "U", "cost", "merit", "inner", "iterations", "regularisation", "rows", "outer")
    })  # fmt: skip
    natively(DAMPED, part, lagrangian.take(rows), 6)
    for name in ("X", "U", "cost", "merit", "regularisation", "iterations"):
        assert torch.equal(getattr(part, name), getattr(all_of_them, name)[rows]), name


@pytest.mark.parametrize("threads", [1, 2])
def test_a_neighbour_that_is_not_finite_changes_no_bits(threads: int) -> None:
    problem = quadrotor_batch(B=19, N=10, obstacles=4)[0]
    expected, lagrangian = running_state(problem)
    natively(DAMPED, expected, lagrangian, 5)
    state, lagrangian = running_state(problem)
    state.X[3], state.U[11, 4] = torch.nan, torch.inf
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        end = natively(DAMPED, state, lagrangian, 5)
    finally:
        torch.set_num_threads(before)
    rest = torch.tensor([b for b in range(19) if b not in (3, 11)])
    assert end.status[3] > 1 and bool((end.status[rest] == 0).all())
    for name in ("X", "U", "merit", "iterations"):
        assert torch.equal(getattr(state, name)[rest], getattr(expected, name)[rest]), name


def test_statuses_are_those_of_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    """A concave cost has no minimum; where no regularisation suffices, the solve ends with a status."""
    free = planar_batch(B=2, N=6)[0]
    concave = replace(free.cost, R=-free.cost.R)
    problem = free._with({"cost": concave, "constraints": ()})
    for inner, limit in ((DAMPED, 1e-4), (replace(DAMPED, max_iterations=3), iteration.REGULARISATION_MAX)):
        monkeypatch.setattr(iteration, "REGULARISATION_MAX", limit)
        (a, first), (b, second) = running_state(problem), running_state(problem)
        native = natively(inner, b, second, 3)
        statuses = torch.zeros(2, dtype=torch.int64)
        for _ in range(20):
            end = iterate(inner.descent, a, first)
            statuses = torch.where(statuses == 0, end.status, statuses)
            if bool((end.ended | (statuses > 0)).all()):
                break
        assert torch.equal(native.status, statuses)


def test_whole_solves_agree() -> None:
    problem, U0 = quadrotor_batch(B=3, N=20, obstacles=5, seed=2)
    for inner in (DAMPED, PRINTED):
        solver = AugmentedLagrangian(inner=inner, max_outer_iterations=5)
        native = solver.solve(problem, U0)
        kernels.use_native(False)
        plain = solver.solve(problem, U0)
        kernels.use_native(True)
        assert torch.equal(native.iterations, plain.iterations) and native.statuses == plain.statuses
        torch.testing.assert_close(native.cost, plain.cost, rtol=1e-6, atol=0)


def test_a_problem_travels_without_its_library() -> None:
    problem, U0 = planar_batch(B=2, N=8)
    first = DAMPED.solve(problem, U0)
    again = pickle.loads(pickle.dumps(problem))
    assert torch.equal(DAMPED.solve(again, U0).U, first.U)
    assert torch.equal(DAMPED.solve(copy.deepcopy(problem), U0).U, first.U)


def test_a_problem_that_cannot_be_native_gives_one_warning() -> None:
    def looks(x: Tensor, u: Tensor) -> Tensor:
        return x if float(x.sum()) > 1e9 else x + 0.1 * u

    dynamics = FunctionDynamics(looks, 2, 2, dt=1.0, integrator="none")
    problem = Problem(dynamics, QuadraticCost([1.0] * 2, [1.0] * 2, [1.0] * 2), [], normal(2, 2), 4)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = ILQR().solve(problem, torch.zeros(2, 4, 2, dtype=torch.float64))
        ILQR().solve(problem, solution.U)
    messages = [str(w.message) for w in caught if issubclass(w.category, EagerWarning)]
    assert len(messages) == 1 and "dynamics.step" in messages[0]
    assert bool(torch.isfinite(solution.cost).all())


def test_without_a_compiler_pytorch_solves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHGCO_CC", "none")
    problem, U0 = planar_batch(B=2, N=10)
    with pytest.warns(EagerWarning, match="no C compiler"):
        solution = AugmentedLagrangian(max_outer_iterations=2).solve(problem, U0)
    assert bool(torch.isfinite(solution.cost).all())


def test_a_pivot_of_zero_is_a_failed_factorisation() -> None:
    """A control that costs nothing and moves nothing: both kernels regularise. No NaN follows that would show it."""
    idle = FunctionDynamics(lambda x, u: x + 0.0 * u, 2, 1, dt=1.0, integrator="none")
    problem = Problem(idle, QuadraticCost([1.0] * 2, [0.0], [1.0] * 2), [], normal(3, 2), 1)
    (a, first), (b, second) = running_state(problem), running_state(problem)
    assert bool(a.merit.isfinite().all())
    end = iterate(DAMPED.descent, a, first)
    native = natively(DAMPED, b, second, 1)
    assert bool(end.failed.all()) and a.regularisation.tolist() == [iteration.REGULARISATION_FIRST] * 3
    assert native.used.tolist() == [iteration.REGULARISATION_FIRST] * 3 and not bool(native.stuck.any())
    assert in_c(problem).judged(second, b.X, b.U).step.failed.all()


@pytest.mark.parametrize(("times", "converges"), [(0.0, True), (1.0, True), (1.01, False)])
def test_a_small_change_under_damping_is_no_convergence(times: float, converges: bool) -> None:
    """Up to the first value of the damping, a step is short because the iterate is good."""
    problem, loose = planar_batch(B=3, N=8)[0], ILQR(tolerance=1e3)
    for native in (True, False):
        state, lagrangian = running_state(problem)
        state.regularisation = torch.full_like(state.merit, times * iteration.DAMPING)
        end = natively(loose, state, lagrangian, 1) if native else iterate(loose.descent, state, lagrangian)
        assert end.converged.tolist() == [converges] * 3
