"""User costs and constraints in C against the same in PyTorch."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import engine_of, in_c
from tests.native.test_engine import DAMPED, eager, natively, normal, running_state
from tests.native.users import PROBLEMS, Each, Smooth, Tube, each, errands, with_cost
from tests.problems import planar_batch, quick_gco
from tests.slow import mostly
from torchgco import InputError, Problem, Status, kernels
from torchgco.constraints.base import Constraint
from torchgco.ilqr.step import lifted_search
from torchgco.kernels import EagerWarning, cost_scale, kernels_of
from torchgco.native.compiler import find_compiler

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.fixture(autouse=True)
def native_again() -> Iterator[None]:
    yield
    kernels.use_native(True)


def blocks(slopes: Tensor, curvatures: Tensor) -> Tensor:
    """Gradient and the Hessian's upper triangle as one tensor (..., n+m, n+m+1)."""
    return torch.cat((slopes.unsqueeze(-1), curvatures.triu()), dim=-1)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("unit", mostly([False, True], True), ids=["as it is", "in cost units"])
@pytest.mark.parametrize("name", mostly(PROBLEMS, *list(PROBLEMS)[1::2]))
def test_value_expansion_and_iterations_are_pytorchs(name: str, unit: bool) -> None:
    problem = PROBLEMS[name]()
    problem = problem.in_cost_units() if unit else problem
    state, lagrangian = running_state(problem)
    kernels, n = in_c(problem), problem.n
    assert kernels is not None
    values = kernels.value(lagrangian, state.X, state.U)
    for mine, theirs in zip(values, lagrangian.value(state.X, state.U), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)
    z = [i for i in range(n + 1 + problem.m) if i != n]
    H = lagrangian.expand(state.X, state.U).transpose(0, 1)
    expected = blocks(H[..., z, n], H[..., z, :][..., z])
    torch.testing.assert_close(
        blocks(*kernels.expand(problem, state.X, state.U, lagrangian)), expected, rtol=1e-10, atol=1e-10
    )
    for count in (1, 4):
        (a, first), (b, second) = running_state(problem), running_state(problem)
        ends = eager(DAMPED, a, first, count)
        out = natively(DAMPED, b, second, count)
        torch.testing.assert_close(b.merit, a.merit, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(b.U, a.U, rtol=1e-8, atol=1e-8)
        assert torch.equal(b.iterations, a.iterations) and torch.equal(b.inner, a.inner)
        assert [bool(x) for x in out.converged] == [ends[i][0] for i in range(problem.B)]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_unit_of_cost_is_pytorchs(name: str) -> None:
    problem, same = PROBLEMS[name](), PROBLEMS[name]()
    torch.testing.assert_close(cost_scale(problem).unit, same.cost_unit, rtol=1e-12, atol=0)


def test_at_rest_kinks_have_pytorchs_derivatives() -> None:
    problem = with_cost(PROBLEMS["kinks"]().cost)
    X, U = torch.zeros(5, 13, 4, dtype=torch.float64), torch.zeros(5, 12, 2, dtype=torch.float64)
    H = X.new_zeros(5, 13, 7, 7)
    problem.cost.expand(X, U, H)
    slopes, curvatures = in_c(problem).expand(problem, X, U, None)
    z = [0, 1, 2, 3, 5, 6]
    torch.testing.assert_close(blocks(slopes, curvatures), blocks(H[..., z, 4], H[..., z, :][..., z]))


def test_a_subset_has_the_numbers_of_its_problems() -> None:
    problem = PROBLEMS["constraints"]()
    state, lagrangian = running_state(problem)
    whole = in_c(problem).value(lagrangian, state.X, state.U)[1]
    for rows in (torch.tensor([3]), torch.tensor([4, 0, 0, 2])):
        part = problem.take(rows)  # of a batch whose parameters are known; `alone` is of a new batch
        alone = PROBLEMS["constraints"]().take(rows)
        for some in (part, alone, part.take(torch.arange(len(rows)))):
            own = replace(lagrangian.take(rows), problem=some)
            assert torch.equal(in_c(some).value(own, state.X[rows], state.U[rows])[1], whole[rows])


def test_the_library_may_be_compiled_for_one_problem_first() -> None:
    """The weight (1, 1) of one problem must not be taken for one that the whole batch shares."""
    problem, other = PROBLEMS["constraints"](), PROBLEMS["constraints"]()
    state, lagrangian = running_state(problem)
    expected = in_c(problem).value(lagrangian, state.X, state.U)[1]
    assert engine_of(other.take(torch.tensor([2]))) is not None
    again = replace(lagrangian, problem=other)
    assert torch.equal(in_c(other).value(again, state.X, state.U)[1], expected)


@pytest.mark.parametrize("name", ["per problem", "by knot", "constraints"])
def test_a_problem_has_the_same_bits_in_every_batch(name: str) -> None:
    whole = PROBLEMS[name]()
    all_of_them, lagrangian = running_state(whole)
    natively(DAMPED, all_of_them, lagrangian, 5)
    names = ("X", "U", "cost", "merit", "inner", "iterations", "rung", "regularisation", "rows", "outer")
    for rows in (torch.tensor([2]), torch.arange(5).flip(0), torch.tensor([1, 3] * 6)):
        state, lagrangian = running_state(whole)
        part = replace(state, **{name: getattr(state, name)[rows] for name in names})
        natively(DAMPED, part, lagrangian.take(rows), 5)
        for name in ("X", "U", "cost", "merit", "iterations"):
            assert torch.equal(getattr(part, name), getattr(all_of_them, name)[rows]), name


def test_a_problem_built_alone_has_the_bits_of_the_batch() -> None:
    """A cost built for one problem has tensors with one row."""
    cost, whole = each(), with_cost(each())
    own = Each(cost.target[3:4], cost.weight[3:4], cost.shared)
    alone = Problem(whole.dynamics, own, whole.constraints, whole.x0[3:4], whole.N)
    (a, first), (b, second) = running_state(whole), running_state(alone)
    b.X, b.U, b.cost, b.merit = a.X[3:4], a.U[3:4], a.cost[3:4], a.merit[3:4]
    second = replace(second, multipliers=first.take(torch.tensor([3])).multipliers)
    natively(DAMPED, a, first, 5)
    natively(DAMPED, b, second, 5)
    assert torch.equal(b.U[0], a.U[3]) and torch.equal(b.merit[0], a.merit[3])


def test_a_neighbour_that_is_not_finite_changes_no_bits() -> None:
    problem = PROBLEMS["by knot"]()
    expected, lagrangian = running_state(problem)
    natively(DAMPED, expected, lagrangian, 5)
    target = problem.cost.own_path.clone()
    target[1] = torch.nan
    broken = problem._with({"cost": replace(problem.cost, own_path=target)})
    state, lagrangian = running_state(problem)
    state.X[3] = torch.nan
    end = natively(DAMPED, state, replace(lagrangian, problem=broken), 5)
    assert [int(s) for s in end.status] == [0, 0, 0, int(Status.NON_FINITE), 0]
    assert torch.equal(state.U[1], running_state(problem)[0].U[1]) and not torch.equal(state.U[1], expected.U[1])
    for name in ("X", "U", "merit", "iterations"):
        assert torch.equal(getattr(state, name)[[0, 2, 4]], getattr(expected, name)[[0, 2, 4]]), name


def test_steps_in_states_and_controls_together_are_pytorchs() -> None:
    """Search from states that are no rollout until the merit is low enough, in one or several steps."""
    problem = planar_batch(B=11, N=30, obstacles=3)[0]
    state, lagrangian = running_state(problem)
    X = state.X + 0.1 * normal(*state.X.shape, seed=40)
    X[:, 0] = problem.x0
    merit = torch.full_like(state.merit, 1e9)
    for _ in range(2):
        mine, theirs = (search(lagrangian, X, state.U, merit) for search in (kernels_of(problem).lifted, lifted_search))
        assert torch.equal(mine.accepted, theirs.accepted) and bool(mine.accepted.any())
        for name in ("X", "U", "merit"):
            torch.testing.assert_close(getattr(mine, name), getattr(theirs, name), rtol=1e-8, atol=1e-8)
        rows = mine.accepted
        torch.testing.assert_close(mine.cost[rows], theirs.cost[rows], rtol=1e-8, atol=0)
        assert bool((mine.merit[rows] < 0.99 * merit[rows]).all())
        merit = theirs.merit
    none = kernels_of(problem).lifted(lagrangian, X, state.U, -merit.abs())
    assert not bool(none.accepted.any()) and torch.equal(none.X, X) and torch.equal(none.U, state.U)


@pytest.mark.slow
def test_solve_is_native_for_a_users_own_car_and_cost() -> None:
    problem = errands()
    with warnings.catch_warnings():
        warnings.simplefilter("error", EagerWarning)
        solution = torchgco.solve(problem, solver=quick_gco(problem))
    assert engine_of(problem) is not None
    assert set(solution.statuses) <= {Status.CONVERGED, Status.FEASIBLE}
    torch.testing.assert_close(solution.cost, problem.cost.total(solution.X, solution.U))
    assert bool((solution.cost < 0.3 * problem.cost.total(*problem.at_rest)).all())


@pytest.mark.slow
def test_a_native_solve_does_not_load_dynamo() -> None:
    code = (
        "import sys, torchgco; from tests.native.users import errands; from dataclasses import replace;"
        "problem = errands(1, 20); solver = torchgco.presets.gco(problem);"
        "solver = replace(solver, local=replace(solver.local, max_outer_iterations=2));"
        "torchgco.solve(problem, solver=solver); print('torch._dynamo' in sys.modules)"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == "False"


class Looks(Smooth):
    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        return super().stage(x, u, k) if bool((x < 1e9).all()) else x[..., 0]


class Beside(Smooth):
    """It reads the stage before only where that is in a window that no point shows."""

    def stage(self, x: Tensor, u: Tensor, k: int | Tensor) -> Tensor:
        value = super().stage(x, u, k)
        return value if isinstance(k, int) else value + 1.0 * ((x[..., 0].roll(1, -1) - 3.0).abs() < 0.1)


@dataclass(frozen=True)
class Window(Constraint):
    """Rows that read the control before only where that is in a window that no point shows."""

    knots: ClassVar[slice] = slice(1, 12)

    def bind(self, dims: Any) -> Window:
        return self

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return U[:, 1:] - 0.1 + 1.0 * ((U[:, :-1] - 3.0).abs() < 0.1)


def with_rows(row: Constraint) -> Problem:
    base = with_cost(Smooth())
    return Problem(base.dynamics, base.cost, [row], base.x0, base.N)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: with_cost(Looks()), r"cost.stage \(Looks\): expected a function that can be traced"),
        (lambda: with_rows(Tube(torch.zeros(13, 2), torch.ones(5), slice(1, 1))), "at least one knot"),
    ],
)
def test_parts_that_cannot_be_native_are_named_once(make, message: str) -> None:
    problem = make()
    with pytest.warns(EagerWarning, match=message) as caught:
        assert engine_of(problem) is None and engine_of(problem.in_cost_units()) is None
    assert len(caught) == 1


@pytest.mark.parametrize(
    ("make", "field"),
    [(lambda: with_cost(Beside()), "cost.stage (Beside)"), (lambda: with_rows(Window()), "constraints[0] (Window)")],
)
def test_parts_that_the_trace_alone_shows_to_join_knots_are_refused(make, field: str) -> None:
    """They were solved by PyTorch's kernels, whose derivatives leave the other knots out."""
    problem = make()
    with pytest.raises(InputError, match="expected rows that read their own knot alone") as caught:
        torchgco.solve(problem, verbose=False)
    assert caught.value.field == field
