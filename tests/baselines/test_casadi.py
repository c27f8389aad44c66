"""IPOPT and FATROP with the problem's model: the same optimum, statuses per problem, no state between problems."""

import importlib.util
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from torch import Tensor
from tqdm import tqdm

from tests.problems import at_knots, planar_batch
from torchgco import (
    AugmentedLagrangian,
    ControlBounds,
    FunctionConstraint,
    FunctionDynamics,
    InputError,
    Planar,
    Problem,
    QuadraticCost,
    Solution,
    StateBounds,
    Status,
    solve,
)
from torchgco.baselines import CasADiSolver, Hold
from torchgco.constraints import Constraint
from torchgco.dynamics.rollout import open_loop
from torchgco.experiments.config.build import compose
from torchgco.experiments.flying.flight import SolveBatch, Tasks
from torchgco.solvers.contracts import Call, Solver

PLUGINS = ["ipopt", "fatrop"]
DATA = Path(__file__).resolve().parents[2] / "benchmarks" / "data"


def with_constraints(*constraints, B: int = 2, N: int = 20, **parts) -> tuple[Problem, Tensor]:
    """The planar batch with other constraints."""
    plain, U0 = planar_batch(B, N)
    return Problem(plain.dynamics, plain.cost, constraints, parts.get("x0", plain.x0), N), U0


def three_problems() -> tuple[Problem, Tensor]:
    return planar_batch(B=3, N=30, obstacles=3, seed=2)


@pytest.fixture(scope="module")
def solved() -> dict:
    return {plugin: CasADiSolver(plugin).solve(*three_problems()) for plugin in PLUGINS}


def test_both_agree_with_al_ilqr(solved) -> None:
    """In the last two problems; in the first, solvers pass the obstacles on different sides."""
    problem, U0 = three_problems()
    al_ilqr = AugmentedLagrangian(max_outer_iterations=15).solve(problem, U0)
    for solution in solved.values():
        assert at_knots(problem, solution) == [Status.CONVERGED] * 3 and float(solution.violation.max()) < 1e-6
        torch.testing.assert_close(solution.cost[1:], al_ilqr.cost[1:], rtol=1e-2, atol=0)
        torch.testing.assert_close(solution.cost, problem.cost.total(solution.X, solution.U))
        assert torch.equal(solution.X, open_loop(problem.dynamics, problem.x0, solution.U))
        assert bool((solution.iterations > 5).all())
    torch.testing.assert_close(solved["ipopt"].cost[1:], solved["fatrop"].cost[1:], rtol=1e-6, atol=0)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_the_rest_of_the_batch_changes_nothing(plugin: str, solved) -> None:
    """Bit by bit and in any order: the program is the same, and the solver keeps no state between problems."""
    problem, U0 = three_problems()
    for rows in ([1], [2, 0]):
        index = torch.tensor(rows)
        alone = CasADiSolver(plugin).solve(problem.take(index), U0[index])
        assert torch.equal(alone.U, solved[plugin].U[index]) and torch.equal(alone.status, solved[plugin].status[index])


def test_the_program_is_the_same_alone_and_in_a_batch() -> None:
    """A problem taken out of the batch has one goal, which must not count as shared."""
    goals = torch.tensor([[1.0, 0.4, 0, 0, 0, 0], [0.0, 0.2, 0, 0, 0, 0]], dtype=torch.float64).unsqueeze(1)
    cost = QuadraticCost(Q=[5.0, 1, 0, 1, 0, 1], R=[0.1, 0.1], Qf=[50.0] * 6, x_ref=goals)
    plain, _ = planar_batch(B=2, N=8)
    problem = Problem(plain.dynamics, cost, plain.constraints, plain.x0, 8)
    both, alone = (CasADiSolver().prepare(p) for p in (problem, problem.take(torch.tensor([1]))))
    assert both.program.parameters.numel() == alone.program.parameters.numel()
    assert str(both.program.objective) == str(alone.program.objective)
    assert str(both.program.rows) == str(alone.program.rows)
    assert both.program.values(problem, 1).tolist() == alone.program.values(alone.problem, 0).tolist()


@pytest.mark.parametrize("plugin", PLUGINS)
def test_a_prepared_program_serves_other_problems_of_its_form(plugin: str, solved) -> None:
    problem, U0 = three_problems()
    first, last = (torch.tensor([b]) for b in (0, 2))
    other = problem.take(last)
    prepared = CasADiSolver(plugin).prepare(problem.take(first)).of(other)
    assert torch.equal(prepared.solve(other, U0[last]).U, solved[plugin].U[last])
    plain, _ = planar_batch(B=1, N=30, obstacles=4)
    for different in (plain, Problem(other.dynamics, other.cost, other.constraints[1:], other.x0, 30)):
        with pytest.raises(InputError, match="another form"):
            prepared.of(different)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_a_bad_start_affects_its_own_problem_alone(plugin: str) -> None:
    problem, U0 = planar_batch(B=4, N=12, obstacles=2, seed=1)
    x0 = problem.x0.clone()
    x0[1, 0] = torch.nan
    x0[2, :2] = problem.constraints[0].centers[2, 0]
    reports = []
    bad = Problem(problem.dynamics, problem.cost, problem.constraints, x0, problem.N)
    solution = CasADiSolver(plugin).solve(bad, U0, callback=reports.append)
    assert solution.statuses == [Status.CONVERGED, Status.NON_FINITE, Status.INVALID_START, Status.CONVERGED]
    good = CasADiSolver(plugin).solve(problem, U0)
    assert torch.equal(solution.U[[0, 3]], good.U[[0, 3]])
    assert [(p.finished, p.total) for p in reports] == [(1, 4), (2, 4), (3, 4), (4, 4)]


@pytest.mark.parametrize("plugin", PLUGINS)
def test_a_guess_of_states(plugin: str) -> None:
    """Their own rollout as states changes nothing; states at the solution save iterations; bad shapes are named."""
    problem, U0 = three_problems()
    prepared = CasADiSolver(plugin).prepare(problem)
    plain = prepared.solve(problem, U0)
    same = prepared.solve(problem, U0, X0=open_loop(problem.dynamics, problem.x0, U0))
    assert torch.equal(same.U, plain.U) and torch.equal(same.iterations, plain.iterations)
    near = prepared.solve(problem, plain.U, X0=plain.X)
    assert at_knots(problem, near) == [Status.CONVERGED] * 3
    assert bool((near.iterations < prepared.solve(problem, U0, X0=plain.X.flip(1)).iterations).all())
    with pytest.raises(InputError, match="X0"):
        prepared.solve(problem, U0, X0=plain.X[:, 1:])
    with pytest.raises(InputError, match="X0"):
        prepared.solve(problem, U0, X0=plain.X.float())
    with pytest.raises(InputError, match="U0"):
        prepared.solve(problem, U0[:, 1:], X0=plain.X)


def test_every_kind_of_row_holds() -> None:
    """Equalities, bounds at some knots, a fixed control, a bound per problem, a row of x and u.

    FATROP finds the same optimum, but not always to its own tolerance.
    """
    upper = torch.tensor([[0.5] * 5 + [torch.inf], [9.0, 0.6, 9, 0.4, 9, 9]], dtype=torch.float64)
    problem, U0 = with_constraints(
        ControlBounds([-4.0, 0.0], [4.0, 4.0]),
        ControlBounds([-torch.inf, 1.0], [torch.inf, 1.0], knots=[3]),
        StateBounds([-2.0] * 6, upper),
        FunctionConstraint(lambda x: x[..., :1] + 0.4, "equality", knots=[-1]),
        FunctionConstraint(lambda x, u: x[..., 3:4] * u[..., :1] - 0.5, of="xu"),
    )
    found = {plugin: CasADiSolver(plugin, max_iterations=100).solve(problem, U0) for plugin in PLUGINS}
    for solution in found.values():
        for constraint in problem.constraints:
            assert float(constraint.violation(solution.X, solution.U).max()) < 1e-6
        assert float((solution.U[:, 3, 1] - 1.0).abs().max()) < 1e-6
    assert found["ipopt"].statuses == [Status.CONVERGED] * 2
    torch.testing.assert_close(found["ipopt"].cost, found["fatrop"].cost, rtol=1e-6, atol=0)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_contradictory_bounds_are_infeasible(plugin: str) -> None:
    """The second problem's bounds cross, so that CasADi refuses it; the first is still solved."""
    above = torch.tensor([[-1.0, -9.0], [3.0, -9.0]], dtype=torch.float64)
    problem, U0 = with_constraints(ControlBounds(above, [9.0, 9.0]), ControlBounds([-9.0, -9.0], [2.0, 9.0]))
    assert CasADiSolver(plugin).solve(problem, U0).statuses == [Status.CONVERGED, Status.INFEASIBLE]


@dataclass(frozen=True)
class Jerk(Constraint):
    """|u_{k+1} - u_k| <= 1 / 10: rows that join two knots."""

    joins_knots: ClassVar[bool] = True
    knots: ClassVar[slice] = slice(0, 19)

    def bind(self, dims) -> "Jerk":
        return self

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        change = U[:, 1:] - U[:, :-1]
        return torch.cat((change, -change), dim=-1) - 0.1


def test_rows_that_join_knots_are_for_ipopt_alone() -> None:
    problem, U0 = with_constraints(Jerk())
    assert CasADiSolver("ipopt").prepare(problem).solve(problem, U0).statuses == [Status.CONVERGED] * 2
    with pytest.raises(InputError, match="fatrop"):
        CasADiSolver("fatrop").prepare(problem)


def test_horizons_of_each_problem_are_refused() -> None:
    problem, U0 = three_problems()
    with pytest.raises(InputError) as caught:
        CasADiSolver("ipopt").solve(replace(problem, horizon=[problem.N - 1] * problem.B), U0)
    assert caught.value.field == "horizon"


def test_a_function_that_cannot_be_traced_names_its_part() -> None:
    problem, U0 = with_constraints(FunctionConstraint(lambda x: torch.erfinv(x[..., :1])))
    with pytest.raises(InputError, match=r"constraints\[0\].*erfinv"):
        CasADiSolver().solve(problem, U0)


def test_single_precision() -> None:
    problem, U0 = planar_batch(B=1, N=10, obstacles=2)
    cost = QuadraticCost(Q=[1.0] * 6, R=[0.1] * 2, Qf=[9.0] * 6)
    single = Problem(Planar(dt=0.1), cost, [ControlBounds([-5.0] * 2, [5.0] * 2)], problem.x0.float(), 10)
    double = Problem(Planar(dt=0.1), cost, [ControlBounds([-5.0] * 2, [5.0] * 2)], problem.x0, 10)
    short, full = CasADiSolver("fatrop").solve(single, U0.float()), CasADiSolver("fatrop").solve(double, U0)
    assert short.U.dtype == torch.float32 and short.statuses == [Status.CONVERGED]
    torch.testing.assert_close(short.cost.double(), full.cost, rtol=1e-4, atol=0)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_every_option_is_read(plugin: str) -> None:
    problem, U0 = planar_batch(B=1, N=15, obstacles=3, seed=1)
    base = CasADiSolver(plugin)
    full = base.solve(problem, U0)
    stopped = replace(base, max_iterations=3, violation_tolerance=10.0).solve(problem, U0)
    assert stopped.statuses == [Status.FEASIBLE] and stopped.iterations.item() in (3, 4)  # FATROP counts one more
    assert replace(base, violation_tolerance=1e-12).solve(problem, U0).statuses == [Status.INFEASIBLE]
    assert replace(base, tolerance=1e-2).solve(problem, U0).iterations < full.iterations
    assert not torch.equal(replace(base, options={"mu_init": 10.0}).solve(problem, U0).U, full.U)
    other = {"ipopt": "fatrop", "fatrop": "ipopt"}[plugin]
    assert not torch.equal(replace(base, plugin=other).solve(problem, U0).U, full.U)
    assert {f.name for f in fields(base)} == {
        "plugin", "max_iterations", "tolerance", "violation_tolerance", "max_seconds", "options",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("change", "field"),
    [({"plugin": "snopt"}, "plugin"), ({"max_iterations": 0}, "max_iterations"), ({"tolerance": 0.0}, "tolerance"),
     ({"violation_tolerance": -1.0}, "violation_tolerance")],
)  # fmt: skip
def test_options_out_of_range(change: dict, field: str) -> None:
    with pytest.raises(InputError, match=f"solver.{field}"):
        CasADiSolver(**change)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_an_unknown_option_is_named(plugin: str) -> None:
    problem, U0 = planar_batch(B=1, N=5, obstacles=2)
    with pytest.raises(InputError, match="no_such"):
        CasADiSolver(plugin, options={"no_such": 1}).solve(problem, U0)


def test_without_casadi_there_is_one_clear_line(monkeypatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr("torchgco.baselines.casadi.find_spec", lambda name: None if name == "casadi" else find(name))
    problem, U0 = planar_batch(B=1, N=5, obstacles=2)
    solver = CasADiSolver()
    for call in (lambda: solver.prepare(problem), lambda: solver.solve(problem, U0)):
        with pytest.raises(InputError, match="pip install casadi"):
            call()


def test_bad_calls_are_named() -> None:
    problem, U0 = planar_batch(B=2, N=5)
    with pytest.raises(InputError, match="U0"):
        CasADiSolver().solve(problem, U0[:, :3])
    with pytest.raises(InputError, match="ids"):
        CasADiSolver().solve(problem, U0, ids=torch.arange(3))
    with pytest.raises(InputError, match="problem"):
        CasADiSolver().prepare(problem).solve(problem.take(torch.tensor([1, 0])), U0)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_the_configuration_holds_the_defaults_of_the_code(plugin: str) -> None:
    limit = 120.0 if plugin == "fatrop" else None  # which may hang
    assert compose([f"solver={plugin}"]).solver == CasADiSolver(plugin, max_seconds=limit)


def test_a_study_prepares_before_the_clock_starts(monkeypatch) -> None:
    """The clock is read before and after the solve, and the preparation comes before."""
    setup = compose(["scenario=layouts", f"scenario.path={DATA / 'planar_trap.npz'}", "model=planar"])
    layouts, events = replace(setup.layouts(2), stages=5), []

    class Builder(Solver):
        def prepare(self, problem: Problem) -> Solver:
            events.append("prepare")
            self.problem = problem
            return self

        def run(self, call: Call) -> Solution:
            events.append("solve")
            assert call.problem.is_same(self.problem)
            return Hold().run(call)

    monkeypatch.setattr("torchgco.experiments.flying.flight._now", lambda device: float(events.append("clock") or 0.0))
    SolveBatch(Tasks(setup, layouts), range(layouts.count), "builder", Builder(), tqdm(disable=True)).fly()
    assert events == ["prepare", "clock", "solve", "clock"]


def test_a_flight_in_a_study() -> None:
    setup = compose(["scenario=layouts", f"scenario.path={DATA / 'planar_trap.npz'}", "model=planar", "solver=fatrop"])
    layouts = replace(setup.layouts(2), stages=20)
    with tqdm(total=2, disable=True) as bar:
        rows, U = SolveBatch(Tasks(setup, layouts), range(layouts.count), "fatrop", setup.solver, bar).fly()
    assert rows["status"].tolist() == ["CONVERGED"] * 2 and U.shape == (2, 20, 2) and bool(rows["feasible"].all())


@pytest.mark.parametrize("solver", ["ipopt", "hold"])
def test_rows_that_are_nan_are_not_called_feasible(solver: str) -> None:
    """The cost is finite at states where a row has no value."""
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 1:], u), dim=-1), 2, 1, 0.1)
    cost = QuadraticCost(Q=[1.0, 1.0], R=[0.01], Qf=[50.0, 50.0], x_ref=[1.0, 0.0])
    rows = [ControlBounds(-2.0, 2.0), FunctionConstraint(lambda x: x[..., :1].sqrt() - 0.6)]
    x0 = torch.tensor([[0.1, 0.0], [-5.0, 0.0]], dtype=torch.float64)
    found = solve(Problem(model, cost, rows, x0, 12), solver=solver)
    assert found.statuses[1] == Status.NON_FINITE and bool(found.violation[1].isnan())
    assert found.statuses[0] in (Status.CONVERGED, Status.FEASIBLE)
