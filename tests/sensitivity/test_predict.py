"""Predicted solutions of problems that have changed a little: right to first order, and flagged where they aren't."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import compiled
from tests.sensitivity.problems import TIGHT, D, box_numbers, boxed, discs, growth, numbers, solved
from tests.slow import mostly
from torchgco import ControlBounds, FunctionDynamics, InputError, Problem, QuadraticCost, Solution, Spheres, Status
from torchgco.base.status import Differentiability as Why

MOVED = "x0", "centers", "radii", "vehicle", "velocities", "Q", "R", "Qf", "x_ref", "upper", "drag", "bias", "budget"


def changed(th: dict[str, Tensor], name: str, by: float) -> dict[str, Tensor]:
    """One of the numbers moved, as it may be: weights by a factor, all else by a length."""
    scale = th[name] if name in ("Q", "R", "Qf") else torch.ones_like(th[name])
    return th | {name: th[name] + by * scale}


def error(found: Solution, due: Solution) -> Tensor:
    return (found.U - due.U).abs().flatten(1).amax(-1)


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", mostly(MOVED, *list(MOVED)[1::2]))
def test_its_error_is_of_second_order(name: str) -> None:
    before, known = solved(discs, numbers)
    th = {key: part.detach() for key, part in before.items()}
    errors = []
    for by in (4e-4, 2e-4):
        problem = discs(changed(th, name, by))
        found = known.predict(problem)
        due = torchgco.solve(problem, warm=known.detach(), solver=TIGHT, verbose=False)
        assert not found.U.requires_grad
        holds = found.differentiable
        assert int(holds.sum()) >= 2  # a row may begin to hold
        torch.testing.assert_close(found.cost, problem.cost.total(found.X, found.U))
        torch.testing.assert_close(torchgco.judge(problem, found.U).violation, found.violation, rtol=0, atol=1e-9)
        errors.append((error(found, due)[holds], error(known.detach(), due)[holds]))
    (wide, whole), (close, _) = errors
    rounding = 1e-8
    assert bool((close <= 0.35 * wide + rounding).all())  # a quarter
    assert bool((wide <= 0.1 * whole + rounding).all())


def test_rows_that_begin_or_cease_to_hold_are_flagged() -> None:
    model = FunctionDynamics(lambda x, u: x + 0.1 * u, 1, 1, 0.1, "none")
    cost = QuadraticCost([1.0], [0.1], [1.0])

    def line(start: float) -> Problem:
        return Problem(model, cost, [ControlBounds(-1.0, 1.0)], torch.tensor([[start], [0.1]], dtype=D), 10)

    for start in (0.3, 3.0):  # no bound holds; bounds hold at first
        known = torchgco.solve(line(start), solver="interior_point")
        near, far = known.predict(line(start + 1e-3)), known.predict(line(3.3 - start))
        assert near.differentiable.tolist() == [True, True] and far.differentiable.tolist() == [False, True]
        assert far.reason is not None and int(far.reason[0]) == Why.ROWS_CHANGE and "too large" in far.why_not[0]
        assert far.statuses[1] == Status.FEASIBLE


def test_a_solve_begins_with_it() -> None:
    before, known = solved(discs, numbers)
    problem = discs(changed({key: part.detach() for key, part in before.items()}, "centers", 0.02))
    warm, cold = (
        torchgco.solve(problem, warm=guess, solver="interior_point", verbose=False)
        for guess in (known.predict(problem), known.detach())
    )
    assert int(warm.iterations.sum()) <= int(cold.iterations.sum())
    torch.testing.assert_close(warm.cost, cold.cost, rtol=1e-6, atol=0)


@compiled
def test_each_problem_is_predicted_as_in_its_batch() -> None:
    before, known = solved(discs, numbers)
    problem = discs(changed({key: part.detach() for key, part in before.items()}, "radii", 1e-3))
    whole, rows = known.predict(problem), torch.tensor([1])
    alone = known.take(rows).predict(problem.take(rows))
    assert torch.equal(whole.take(rows).U, alone.U) and torch.equal(whole.take(rows).cost, alone.cost)


def test_trajectories_cleared_between_knots_keep_their_distance() -> None:
    before, known = solved(boxed, box_numbers)
    th = {key: part.detach() for key, part in before.items()}
    problem = boxed(changed(th, "centers", 1e-3))
    found = known.predict(problem)
    assert int(found.differentiable.sum()) >= 2
    change = growth(problem, found) - growth(boxed(th), known)
    assert bool((change.abs() < 1e-5)[found.differentiable].all())


def test_solutions_without_derivatives_keep_their_controls() -> None:
    problem = discs({key: part.detach() for key, part in numbers().items()})
    known = torchgco.solve(problem, solver="interior_point", verbose=False)
    status = known.status.clone()
    status[1] = int(Status.INFEASIBLE)
    found = replace(known, status=status).predict(problem)
    assert torch.equal(found.U[1], known.U[1]) and found.differentiable.tolist() == [True, False, True]


def test_what_it_is_not_for_is_refused() -> None:
    before, known = solved(discs, numbers)
    problem = discs({key: part.detach() for key, part in before.items()})
    with pytest.raises(InputError, match="changed: expected a problem with B, N, n, m, rows as before"):
        known.predict(problem.take(torch.tensor([0])))
    with pytest.raises(InputError, match="no longer knows it"):
        replace(known, account=None).predict(problem)
    with pytest.raises(InputError, match=r"for a prediction, got torch\.float32"):
        known.predict(problem.cast(torch.float32))
    with pytest.raises(InputError, match="a Problem"):
        known.predict(known)  # type: ignore[arg-type]
    spheres = Problem(problem.dynamics, problem.cost, [Spheres([[9.0, 9.0]], [0.1])], problem.x0, problem.N)
    with pytest.raises(InputError, match="rows as before"):
        known.predict(spheres)


def test_numbers_changed_in_place_are_no_other_problem() -> None:
    th = {key: part.detach().clone() for key, part in numbers().items()}
    problem = discs(th)
    known = torchgco.solve(problem, solver="interior_point", verbose=False)
    th["x0"] += 0.01
    with pytest.raises(InputError, match="have been changed in place"):
        known.predict(problem)
