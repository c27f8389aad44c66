"""The interior point from guess to solution: optima that are known, infeasible problems, guesses, and batches."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.problems import assert_same_bits, at_knots
from tests.reference.interior import Program, curvature_of_cost, kkt_residual, linear
from torchgco import (
    Boxes,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Problem,
    QuadraticCost,
    RateBounds,
    Solution,
    Spheres,
    StateBounds,
    Status,
    certify,
    kernels,
)
from torchgco.base.tree import take
from torchgco.baselines import CasADiSolver
from torchgco.dynamics.rollout import open_loop
from torchgco.kernels import interior_of
from torchgco.lagrangian.barrier import BarrierOptions
from torchgco.native.codegen.source import LANES
from torchgco.native.compiler import find_compiler
from torchgco.native.interior import InteriorEngine
from torchgco.solvers import interior
from torchgco.solvers.contracts import Call
from torchgco.solvers.interior import InteriorPoint
from torchgco.solvers.session import Session

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::torchgco.ContactWarning"),
]

D, INF, DT = torch.float64, torch.inf, 0.1
SOLVED = (Status.CONVERGED, Status.FEASIBLE)
FAST, FORCE = 0.55, 6.0  # m/s and m/s^2: limits of the flights
IPOPT = CasADiSolver("ipopt", violation_tolerance=1e-6)
PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac")
NEAR = replace(IPOPT, options={"mu_init": 1e-8, "warm_start_init_point": "yes", **dict.fromkeys(PUSHES, 1e-8)})


# Flights against drag to rest at a target -----------------------------------------------------------------------------


def field(x: Tensor, u: Tensor, drag: Tensor) -> Tensor:
    """Drag falls with height, and drives a falling body to infinity in finite time."""
    p, v = x.unbind(-1)
    return torch.stack((v, u[..., 0] - drag * (-0.3 * p).exp() * v * v), dim=-1)


def at_rest(x: Tensor, target: Tensor) -> Tensor:
    return torch.stack((x[..., 0] - target, x[..., 1]), dim=-1)


def drags_and_targets(B: int) -> tuple[Tensor, Tensor]:
    k = torch.arange(B, dtype=D)
    return 0.2 + 0.05 * (k % 7), 1 + 0.1 * (k % 5)


def flights(
    B: int = 20, target: Tensor | None = None, ceiling: float | Tensor = INF, drag: Tensor | None = None
) -> Problem:
    """Twenty different problems; the speed limit binds in some of them."""
    k, N = torch.arange(B, dtype=D), 30
    usual = drags_and_targets(B)
    drag, target = usual[0] if drag is None else drag, usual[1] if target is None else target
    high = torch.stack((torch.as_tensor(ceiling, dtype=D).expand(B), torch.full((B,), FAST, dtype=D)), dim=-1)
    return Problem(
        FunctionDynamics(field, 2, 1, DT, values={"drag": drag}),
        QuadraticCost([0.5, 0.1], [0.2], [0.0, 0.0]),
        [
            FunctionConstraint(at_rest, "equality", knots=[N], values={"target": target}),
            ControlBounds(-FORCE, FORCE),
            StateBounds([-INF, -0.3], high),
        ],
        torch.stack((-0.1 * (k % 3), 0.1 * (k % 4)), dim=-1),
        N,
    )


def zeros(problem: Problem) -> Tensor:
    return torch.zeros(problem.B, problem.N, problem.m, dtype=D)


def solved(problem: Problem, U0: Tensor | None = None, X0: Tensor | None = None, **options: Any) -> Solution:
    """The solution from a guess of controls (none: zeros) and of states (none: their rollout)."""
    solver, U0 = InteriorPoint(**options), zeros(problem) if U0 is None else U0
    if X0 is None:
        return solver.solve(problem, U0)
    session = Session(Call.checked(problem, U0), own_units=True)
    return session.finished(solver.solved(session.call, X0), solver.violation_tolerance)


def assert_solved(problem: Problem, solution: Solution, tolerance: float = 1e-6) -> None:
    """Converged, and a rollout whose violation is small and correctly reported."""
    assert at_knots(problem, solution) == [Status.CONVERGED] * problem.B
    X = open_loop(problem.dynamics, problem.x0, solution.U)
    torch.testing.assert_close(solution.X, X, rtol=1e-12, atol=1e-12)
    worst = torch.stack([part.worst(X, solution.U) for part in problem.constraints]).amax(0)
    torch.testing.assert_close(solution.violation, worst, rtol=0, atol=1e-11)
    torch.testing.assert_close(solution.cost, problem.cost.total(X, solution.U), rtol=1e-12, atol=0)
    assert float(worst.max()) <= tolerance


def test_what_is_returned_agrees_with_numpy() -> None:
    """Rollouts of the returned controls, their cost and their violation, all computed anew."""
    problem = flights()
    solution = solved(problem)
    assert_solved(problem, solution)
    drag, target = (part.numpy() for part in drags_and_targets(problem.B))
    for b in range(problem.B):
        X, cost = [problem.x0[b].numpy()], 0.0
        U = solution.U[b, :, 0].numpy()
        for u in U:
            p, v = X[-1]
            cost += 0.5 * (0.5 * p * p + 0.1 * v * v + 0.2 * u * u)
            X.append(np.array([p + DT * v, v + DT * (u - drag[b] * np.exp(-0.3 * p) * v * v)]))
        path = np.array(X)
        np.testing.assert_allclose(solution.X[b].numpy(), path, rtol=1e-12, atol=1e-12)
        assert float(solution.cost[b]) == pytest.approx(cost, rel=1e-12)
        ends = abs(path[-1] - [target[b], 0.0])
        worst = max(*ends, (path[1:, 1] - FAST).max(), (-0.3 - path[1:, 1]).max(), (abs(U) - FORCE).max(), 0.0)
        assert float(solution.violation[b]) == pytest.approx(worst, abs=1e-11) and worst <= 1e-6
    assert bool((solution.X[:, 1:, 1].amax(1) > FAST - 1e-5).any())  # the limit binds


@pytest.mark.parametrize(("tolerance", "limit"), [(1e-6, 1e-5), (1e-8, 1e-7)])
def test_the_conditions_of_optimality_hold(tolerance: float, limit: float) -> None:
    """With the returned multipliers."""
    problem = flights(4)
    solution = solved(problem, tolerance=tolerance, violation_tolerance=tolerance)
    assert_solved(problem, solution, tolerance)
    ends, *bounds = solution.multipliers.lam
    for b in range(problem.B):
        e, z = ends[b].flatten().numpy(), torch.cat([lam[b].flatten() for lam in bounds]).numpy()
        program = Program(problem.take(slice(b, b + 1)))
        assert kkt_residual(program, solution.X[b : b + 1], solution.U[b : b + 1], e, z) <= limit
        assert abs(e).max() > 1e-2


def test_the_last_iterations_converge_superlinearly() -> None:
    """The barrier parameter sets the pace: two iterations together are of an order above 1."""
    problem = flights(8)
    best = solved(problem, tolerance=1e-11, violation_tolerance=1e-9)
    found = [solved(problem, tolerance=1e-11, max_iterations=K) for K in range(1, int(best.iterations.max()))]
    errors = torch.stack([(one.U - best.U).abs().amax((1, 2)) for one in found])
    for b in range(problem.B):
        made = errors[: int(best.iterations[b]) - 1, b].tolist()
        pairs = [(old, new) for old, new in zip(made, made[2:], strict=False) if old < 1e-2]
        assert len(pairs) >= 2 and all(new < old**1.3 for old, new in pairs) and made[-1] < 1e-5


# Optima that are known ------------------------------------------------------------------------------------------------


def circle(angles: Tensor) -> tuple[Problem, Tensor]:
    """Maratos' problem from points on the circle: controls of one stage, and no dynamics."""
    problem = Problem(
        FunctionDynamics(lambda x, u: x + 0 * u[..., :1], 1, 2, 1.0, "none"),
        FunctionCost(lambda x, u: 2 * (u.square().sum(-1) - 1) - u[..., 0]),
        [FunctionConstraint(lambda u: u.square().sum(-1, keepdim=True) - 1, "equality", of="u")],
        torch.zeros(len(angles), 1, dtype=D),
        1,
    )
    return problem, torch.stack((angles.cos(), angles.sin()), dim=-1).unsqueeze(1)


def test_full_steps_near_the_circle_of_maratos(monkeypatch) -> None:
    """Every full step raises both cost and violation there; with corrections of second order few iterations do."""
    problem, U0 = circle(torch.linspace(-2.9, 2.9, 16, dtype=D))
    solution = solved(problem, U0, tolerance=1e-9)
    assert_solved(problem, solution)
    torch.testing.assert_close(solution.cost, torch.full((16,), -1.0, dtype=D), rtol=1e-9, atol=0)
    ends = solution.multipliers.lam[0].flatten()
    torch.testing.assert_close(ends, torch.full((16,), -1.5, dtype=D), rtol=1e-7, atol=0)
    monkeypatch.setattr(interior, "BarrierOptions", partial(BarrierOptions, max_soc=0))
    plain = solved(problem, U0, tolerance=1e-9)
    assert int(solution.iterations.max()) <= 15 and int(solution.iterations.sum()) < 0.95 * int(plain.iterations.sum())


def test_convergence_with_equalities_alone_is_quadratic(monkeypatch) -> None:
    problem, U0 = circle(torch.tensor([0.8], dtype=D))
    errors = []
    monkeypatch.setattr(InteriorPoint, "no_worse", lambda self, call, guess, end: end)
    for K in range(1, 12):
        u = solved(problem, U0, tolerance=1e-14, max_iterations=K).U[0, 0]
        errors.append(float(torch.linalg.vector_norm(u - torch.tensor([1.0, 0.0], dtype=D))))
    pairs = [(a, b) for a, b in pairwise(errors) if 1e-7 < a < 0.3]
    assert len(pairs) >= 2 and all(b <= 5 * a * a for a, b in pairs) and errors[-1] < 1e-12


@pytest.mark.sampled(1)
@pytest.mark.parametrize("native", [True, False])
def test_options_of_ipopt_reach_the_kernels(native: bool) -> None:
    problem, U0 = circle(torch.tensor([0.8], dtype=D))
    kernels.use_native(native)
    try:
        call, limit = Session(Call.checked(problem, U0), own_units=True).call, int(solved(problem, U0).iterations) - 1
        ends = [InteriorPoint(max_iterations=limit, acceptable_tolerance=error).solved(call) for error in (1e-10, 1.0)]
        assert [int(end.status) for end in ends] == [Status.MAX_ITERATIONS, interior.SOLVED]
        once = [solved(linear_quadratic(), max_iterations=1, bound_push=push).X for push in (1e-2, 0.3)]
    finally:
        kernels.use_native(True)
    assert not torch.allclose(*once, rtol=1e-3)


def test_a_step_that_gains_too_little_is_halved() -> None:
    """A full Newton step of length 1 lowers the costs -u + u^2 / 2 + a u^3 by half and by twice what Armijo asks."""
    share = BarrierOptions.eta_phi
    a = 0.5 - share * torch.tensor([0.5, 2.0], dtype=D)
    cost = FunctionCost(lambda x, u, a: (u * (u * (0.5 + a.unsqueeze(-1) * u) - 1)).sum(-1), values={"a": a})
    dynamics = FunctionDynamics(lambda x, u: x + 0 * u, 1, 1, 1.0, "none")
    free = [FunctionConstraint(lambda u: 0 * u - 1, of="u")]
    problem = Problem(dynamics, cost, free, torch.zeros(2, 1, dtype=D), 1)
    once = solved(problem, max_iterations=1)
    torch.testing.assert_close(once.U.flatten(), torch.tensor([0.5, 1.0], dtype=D), rtol=1e-9, atol=0)


def linear_quadratic() -> Problem:
    """Random linear systems with bounds on controls and states, many of which bind."""
    random = np.random.default_rng(5)
    A = torch.from_numpy(np.eye(4) + 0.25 * random.normal(size=(8, 4, 4)))
    by_u = torch.from_numpy(random.normal(size=(8, 4, 2)))

    def step(x: Tensor, u: Tensor, A: Tensor, by_u: Tensor) -> Tensor:
        return (A * x.unsqueeze(-2)).sum(-1) + (by_u * u.unsqueeze(-2)).sum(-1)

    return Problem(
        FunctionDynamics(step, 4, 2, 1.0, "none", values={"A": A, "by_u": by_u}),
        QuadraticCost([1.0, 2, 0.5, 1], [0.1, 0.2], [5.0, 5, 5, 5]),
        [ControlBounds([-0.6, -INF], [0.5, 0.7]), StateBounds([-INF, -1.2, -INF, -1.5], [1.5, INF, INF, 1.5])],
        torch.from_numpy(random.normal(size=(8, 4))),
        15,
    )


def test_linear_problems_have_the_costs_of_a_dense_program() -> None:
    import casadi as ca

    problem = linear_quadratic()
    solution = solved(problem, tolerance=1e-11, violation_tolerance=1e-8)
    feasible = 0
    for b in range(problem.B):
        program = Program(problem.take(slice(b, b + 1)))
        w = np.zeros(problem.N * (problem.n + problem.m))
        at, H = linear(program, w, 1.0), curvature_of_cost(program, w)
        rows, wanted = np.concatenate((at.G, at.C)), -np.concatenate((at.gap, at.c))
        lowest = np.where(np.arange(len(wanted)) < len(at.gap), wanted, -np.inf)
        shapes = {"h": ca.DM(H).sparsity(), "a": ca.DM(rows).sparsity()}
        dense = ca.conic("dense", "qpoases", shapes, {"printLevel": "none", "error_on_fail": False})
        found = dense(h=H, g=at.slope, a=rows, lba=lowest, uba=wanted)
        if not dense.stats()["success"]:
            assert solution.statuses[b] not in SOLVED
            continue
        feasible += 1
        cost = float(found["cost"]) + float(program.cost(torch.from_numpy(w)))
        assert solution.statuses[b] == Status.CONVERGED and float(solution.violation[b]) <= 1e-8
        assert float(solution.cost[b]) == pytest.approx(cost, rel=1e-9)
    assert feasible >= 5


def everything(B: int = 4, N: int = 20) -> Problem:
    """Dynamics by knot, bounds by knot, limits on rates, values by problem, spheres that move, and boxes."""
    k = torch.arange(B, dtype=D)
    stages = torch.arange(N, dtype=D)

    def push(x: Tensor, u: Tensor, drag: Tensor, wind: Tensor, k: Tensor) -> Tensor:
        v = x[..., 2:]
        force = u + torch.stack((wind[..., 0], 0.1 * (0.3 * (k + 0 * v[..., 0])).sin()), dim=-1)
        return torch.cat((v, force - drag.unsqueeze(-1) * v), dim=-1)

    def within(x: Tensor, room: Tensor) -> Tensor:
        return (x[..., :2].square().sum(-1) - room).unsqueeze(-1)

    centers = torch.tensor([[-0.3, 0.12], [0.5, -0.5]], dtype=D).repeat(B, 1, 1)
    centers[1::2, 1] = torch.nan
    limits = (2.6 - 0.05 * stages).view(1, N, 1) * torch.ones(B, 1, 2, dtype=D)
    limits[2] *= 0.9
    return Problem(
        FunctionDynamics(
            push, 4, 2, 0.15, "midpoint", slice(0, 2), values={"drag": 0.2 + 0.1 * k},
            knot_values={"wind": 0.2 * (0.5 * stages).cos().view(1, N, 1)},
        ),
        QuadraticCost([1.0, 1, 0.1, 0.1], [0.1, 0.1], [100.0, 100, 10, 10], [1.2, 0.1, 0, 0]),
        [
            Spheres(centers, 0 * centers[..., 0] + 0.2, 0.1, [[0.03, 0.02], [0.0, 0.03]]),
            ControlBounds(-limits, limits),
            RateBounds(-0.8, [0.7, 0.9], previous=[0.1, 0.0]),
            StateBounds([-INF, -INF, -0.9, -INF], [INF, INF, 0.9, 0.4], knots=slice(1, N)),
            Boxes([[0.4, -0.1]], [[0.15, 0.1]], 0.1, [0.4]),
            FunctionConstraint(within, values={"room": 3 - 0.5 * k}),
        ],
        torch.stack((-1.2 + 0.02 * k, 0 * k, 0 * k, 0 * k), dim=-1),
        N,
    )  # fmt: skip


@pytest.mark.slow
def test_all_that_a_problem_may_have_at_the_cost_of_ipopt() -> None:
    """Among obstacles each finds a minimum of its own from a guess, but IPOPT stays at the one found here."""
    problem = everything()
    solution = solved(problem, tolerance=1e-10)
    assert_solved(problem, solution)
    continued = NEAR.solve(problem, solution.U, X0=solution.X)
    assert at_knots(problem, continued) == [Status.CONVERGED] * problem.B
    torch.testing.assert_close(solution.cost, continued.cost, rtol=1e-6, atol=0)
    binding = [float(part.value(solution.X, solution.U).max()) > -1e-6 for part in problem.constraints]
    assert all(binding[:5])  # every kind of rows binds somewhere


@pytest.mark.sampled(1)
@pytest.mark.parametrize("make", [everything, flights])
def test_eight_digits_on_request(make) -> None:
    """By the certificate, which tests the returned multipliers; it refuses others, and another trajectory."""
    problem = make()
    solution = solved(problem, tolerance=1e-12, violation_tolerance=1e-9)
    assert_solved(problem, solution, 1e-9)
    X, U, lams = solution.X, solution.U, solution.multipliers.lam
    usual = solved(problem)
    more = solution.iterations - usual.iterations
    assert int((more > 12).sum()) <= 1 and int(more.max()) <= 13  # of one problem the filter refuses steps at 1e-9

    def residual(U: Tensor, lams: tuple[Tensor, ...]) -> Tensor:
        return certify(problem, open_loop(problem.dynamics, problem.x0, U), U, multipliers=lams).kkt_residual

    assert float(certify(problem, X, U, multipliers=lams).kkt_residual.max()) <= 1e-9
    assert float(residual(U * (1 + 1e-5), lams).min()) > 1e-7
    assert float(residual(U, tuple(1.001 * lam for lam in lams)).min()) > 1e-7
    assert float(residual(U, tuple(0.0 * lam for lam in lams)).min()) > 1e-4


def test_rounding_ends_a_solve_whose_tolerance_is_out_of_reach() -> None:
    problem = flights()
    best, usual = solved(problem, tolerance=1e-17, violation_tolerance=1e-9), solved(problem)
    assert_solved(problem, best, 1e-9)
    assert bool((best.iterations - usual.iterations <= 20).all())


def test_flights_at_the_cost_of_ipopt() -> None:
    problem = flights(6)
    solution, peer = solved(problem, tolerance=1e-8), IPOPT.solve(problem, zeros(problem))
    torch.testing.assert_close(solution.cost, peer.cost, rtol=1e-6, atol=0)


# Infeasible problems --------------------------------------------------------------------------------------------------


def test_infeasible_problems_end_so_and_disturb_no_other() -> None:
    """Targets farther than the speed limit lets one fly, and targets above the ceiling: limits and targets share it."""
    target, ceiling = torch.full((9,), 1.1, dtype=D), torch.full((9,), INF, dtype=D)
    target[2], target[6], ceiling[3], ceiling[8] = 4.0, 2.5, 0.5, 0.9
    problem = flights(9, target, ceiling)
    together, failed = solved(problem), [2, 3, 6, 8]
    assert not {together.statuses[b] for b in failed} & set(SOLVED)
    good = torch.tensor([b for b in range(9) if b not in failed])
    assert together.take(good).statuses == [Status.CONVERGED] * 5
    assert_same_bits(together.take(good), solved(problem.take(good)))
    for b in failed:
        reach = float(problem.x0[b, 0] + DT * (problem.x0[b, 1] + (problem.N - 1) * FAST))
        lacks = float(target[b]) - (reach if b in (2, 6) else float(ceiling[b]))
        least = lacks / (1 + DT * (problem.N - 1)) if b in (2, 6) else 0.5 * lacks
        assert 0.99 * least <= float(together.violation[b]) <= 1.01 * lacks + 0.02


@pytest.mark.parametrize(("speed", "status"), [(FAST, Status.CONVERGED), (FAST + 0.02, Status.INFEASIBLE)])
def test_a_given_start_stays_where_it_is(speed: float, status: Status) -> None:
    """With bounds at knot 0, too: on its bound it is no worse than without them, outside of it no solution exists."""
    free = flights(4)
    bounded = StateBounds([-INF, -0.3], [INF, FAST], knots=range(free.N + 1))
    x0 = torch.stack((free.x0[:, 0], torch.full((4,), speed, dtype=D)), dim=-1)
    problem = Problem(free.dynamics, free.cost, [*free.constraints[:2], bounded], x0, free.N)
    solution = solved(problem)
    assert solution.statuses == [status] * 4 and torch.equal(solution.X[:, 0], x0)
    if status is Status.CONVERGED:
        expected = solved(Problem(free.dynamics, free.cost, free.constraints, x0, free.N))
        torch.testing.assert_close(solution.cost, expected.cost, rtol=1e-6, atol=0)


def test_an_equality_given_twice_does_no_harm_and_two_that_contradict_each_other_end() -> None:
    plain = flights(8)
    off = torch.zeros(8, dtype=D)
    off[1], off[6] = 0.3, -0.1
    target = drags_and_targets(8)[1] + off
    again = FunctionConstraint(at_rest, "equality", knots=[plain.N], values={"target": target})
    problem = Problem(plain.dynamics, plain.cost, [*plain.constraints, again], plain.x0, plain.N)
    solution, once = solved(problem), solved(plain)
    good, failed = torch.tensor([0, 2, 3, 4, 5, 7]), torch.tensor([1, 6])
    assert solution.take(good).statuses == [Status.CONVERGED] * 6
    torch.testing.assert_close(solution.cost[good], once.cost[good], rtol=1e-6, atol=0)
    assert not set(solution.take(failed).statuses) & set(SOLVED)
    share = solution.violation[failed] / off[failed].abs()
    assert bool((share >= 0.495).all() and (share <= 1.01).all())
    assert_same_bits(solved(problem.take(good)), solution.take(good))


def test_a_failed_solve_returns_nothing_worse_than_its_guess() -> None:
    """Points on the circle are feasible; after one iteration none is."""
    problem, U0 = circle(torch.tensor([0.8, 2.0], dtype=D))
    cut = InteriorPoint(max_iterations=1).solve(problem, U0)
    assert torch.equal(cut.U, U0) and cut.statuses == [Status.FEASIBLE] * 2
    assert float(solved(problem, U0).cost.max()) < float(cut.cost.min())


# Batches --------------------------------------------------------------------------------------------------------------


def test_a_result_has_the_same_bits_in_every_batch() -> None:
    """Alone, in full and in part of the lanes, in places that others have left, in any order and on two threads."""
    problem = flights()
    together = solved(problem)
    assert len(set(together.iterations.tolist())) > 2
    for rows in ([3], [19], [3, 19], [3, 19, 4], range(7), range(8), range(9), range(19, -1, -1), [5, 5, 5, 2, 5]):
        index = torch.tensor(list(rows))
        assert_same_bits(solved(problem.take(index)), together.take(index))
    try:
        torch.set_num_threads(2)
        assert_same_bits(solved(problem), together)
    finally:
        torch.set_num_threads(1)  # as conftest has it


def test_few_problems_take_few_lanes_but_not_a_few_of_many() -> None:
    """A second library would be compiled in the middle of a large solve."""
    problem = flights()
    assert [lanes_of(problem.take(slice(0, count)).renewed()) for count in (1, 3, 20)] == [2, 4, LANES]
    assert lanes_of(problem) == lanes_of(problem.take([0])) == LANES
    few = problem.take([0, 1]).renewed()
    assert lanes_of(few) == lanes_of(few.take([0, 1, 0, 1, 0])) == 2


def lanes_of(problem: Problem) -> int:
    kernels = interior_of(problem)
    assert isinstance(kernels, InteriorEngine)
    return kernels.lanes


def test_an_empty_batch_has_an_empty_solution() -> None:
    problem = circle(torch.zeros(2, dtype=D))[0].take(torch.arange(0))
    assert solved(problem).X.shape == (0, 2, 1) and solved(problem).statuses == []


def test_a_problem_that_overflows_ends_alone() -> None:
    """Where the derivatives overflow, and where the start isn't finite, while problems in other lanes go on."""
    problem = flights(10)
    drag, _ = drags_and_targets(10)
    drag[3], x0 = 1e300, problem.x0.clone()
    x0[6, 1] = torch.nan
    broken = flights(10, drag=drag)
    broken = Problem(broken.dynamics, broken.cost, broken.constraints, x0, broken.N)
    solution, good = solved(broken), torch.tensor([0, 1, 2, 4, 5, 7, 8, 9])
    assert solution.statuses[3] not in SOLVED and solution.statuses[6] == Status.NON_FINITE
    assert_same_bits(solution.take(good), solved(problem).take(good))


# Guesses --------------------------------------------------------------------------------------------------------------


def line(problem: Problem) -> Tensor:
    """States on a straight line from the start to rest at the target, (B, N+1, 2)."""
    share = torch.linspace(0, 1, problem.N + 1, dtype=D).view(1, -1, 1)
    end = torch.stack((drags_and_targets(problem.B)[1], torch.zeros(problem.B, dtype=D)), dim=-1)
    return (1 - share) * problem.x0.unsqueeze(1) + share * end.unsqueeze(1)


@pytest.mark.parametrize("kind", ["line", "far line", "random states", "outside of the bounds", "overflow"])
def test_one_optimum_from_guesses_of_all_kinds(kind: str) -> None:
    problem = flights(9)
    random = torch.Generator().manual_seed(2)
    X0, U0 = None, zeros(problem)
    if "line" in kind:
        X0 = (1 if kind == "line" else 20) * line(problem)  # the first state is no guess
    elif kind == "random states":
        X0 = torch.randn(problem.B, problem.N + 1, 2, generator=random, dtype=D)
    elif kind == "outside of the bounds":
        U0 = torch.full_like(U0, 3 * FORCE)
    else:
        U0 = torch.full_like(U0, -100.0)
        assert not bool(torch.isfinite(open_loop(problem.dynamics, problem.x0, U0)).all(-1).all(-1).any())
    best = solved(problem, tolerance=1e-8)
    found = solved(problem, U0, X0, tolerance=1e-8)
    assert_solved(problem, found)
    torch.testing.assert_close(found.cost, best.cost, rtol=1e-6, atol=0)


def test_a_warm_start_takes_fewer_iterations() -> None:
    problem = flights(9)
    before = solved(problem)
    moved = Problem(problem.dynamics, problem.cost, problem.constraints, problem.x0 + 0.001, problem.N)
    cold = InteriorPoint().solve(moved, before.U)
    warm = InteriorPoint().solve(moved, before.U, warm=before.multipliers)
    assert_solved(moved, warm)
    torch.testing.assert_close(warm.cost, cold.cost, rtol=1e-5, atol=0)
    assert int(warm.iterations.sum()) <= 0.5 * int(cold.iterations.sum())
    rows = torch.tensor([6, 1])
    alone = InteriorPoint().solve(moved.take(rows), before.U[rows], warm=take(before.multipliers, rows))
    assert_same_bits(alone, warm.take(rows))


def test_without_kernels_problems_are_solved_all_the_same() -> None:
    problem = flights(2)
    best = solved(problem)
    kernels.use_native(False)
    try:
        found = solved(problem)
    finally:
        kernels.use_native(True)
    assert found.statuses == best.statuses and float(found.violation.max()) <= 1e-6
    torch.testing.assert_close(found.cost, best.cost, rtol=1e-6, atol=0)


def test_a_start_inside_an_obstacle_has_a_status_of_its_own() -> None:
    problem = everything()
    x0 = problem.x0.clone()
    x0[1, :2] = torch.tensor([-0.3, 0.12])
    inside = Problem(problem.dynamics, problem.cost, problem.constraints, x0, problem.N)
    solution, rest = solved(inside), torch.tensor([0, 2, 3])
    assert solution.statuses[1] == Status.INVALID_START
    assert_same_bits(solution.take(rest), solved(problem).take(rest))


@pytest.mark.slow
def test_controls_are_rolled_out_only_where_they_are_needed_beside_states(monkeypatch) -> None:
    """A problem that never begins has the rollout of its controls, whatever the states."""
    problem = everything()
    x0 = problem.x0.clone()
    x0[1, :2] = torch.tensor([-0.3, 0.12])
    inside = Problem(problem.dynamics, problem.cost, problem.constraints, x0, problem.N)
    X0 = problem.x0.unsqueeze(1).repeat(1, problem.N + 1, 1)
    refused = InteriorPoint().solved(Call.checked(inside, zeros(inside)), X0)
    rollout = open_loop(inside.dynamics, x0, zeros(inside))
    assert int(refused.status[1]) == Status.INVALID_START
    torch.testing.assert_close(refused.best.X[1], rollout[1], rtol=1e-12, atol=1e-12)
    assert float(refused.best.violation[1]) > 0
    monkeypatch.setattr(interior, "guessed", lambda call: pytest.fail("rolled out"))
    assert bool((InteriorPoint().solved(Call.checked(problem, zeros(problem)), X0).iterations > 0).all())


def test_where_no_time_is_left_the_guess_is_returned_and_not_called_feasible() -> None:
    problem = flights(3)
    late = InteriorPoint().solve(problem, zeros(problem), max_seconds=1e-9)
    assert late.statuses == [Status.TIME_LIMIT] * 3 and torch.equal(late.U, zeros(problem))
    torch.testing.assert_close(late.violation, problem.constraints[0].worst(late.X, late.U), rtol=1e-12, atol=0)


def test_where_no_shift_makes_a_step_residuals_are_closed_first() -> None:
    """Long steps of a Van der Pol oscillator far out, from where its rollouts have no end: none of these was solved.

    Where slopes are huge, rounding leaves the Riccati recursion no curvature of the cost; steps that close residuals
    alone lead back to where it has one (IPOPT restores feasibility there, too).
    """
    field = lambda x, u: torch.stack(((1.0 - x[..., 1] ** 2) * x[..., 0] - x[..., 1] + u[..., 0], x[..., 0]), dim=-1)
    model = FunctionDynamics(field, 2, 1, 0.4, "rk4")
    starts = [[-4.776742458, -3.311410546], [1.965049505, 4.142746925], [-4.948676228, -3.243484497], [1.97, 4.14]]
    problem = Problem(model, QuadraticCost([1.0] * 2, [1.0], [1.0] * 2), [], torch.tensor(starts, dtype=D), 25)
    assert not bool(
        torch.isfinite(open_loop(model, problem.x0, torch.zeros(4, 25, 1, dtype=D))).flatten(1).all(1).any()
    )
    solution = InteriorPoint().solve(problem, torch.zeros(4, 25, 1, dtype=D))
    assert sum(status is Status.CONVERGED for status in solution.statuses) >= 3  # which ones, rounding may decide
