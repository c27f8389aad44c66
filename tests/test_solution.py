"""Solutions are saved and loaded, and the plain baselines return them too."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

import torchgco
from tests.problems import planar_batch
from torchgco import (
    MPPI,
    AugmentedLagrangian,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    Problem,
    RateBounds,
    Solution,
    StateBounds,
)
from torchgco.baselines import Hold, IteratedMPPI
from torchgco.dynamics.rollout import open_loop


def test_save_and_load(tmp_path) -> None:
    problem, U0 = planar_batch(B=2, N=10)
    solution = AugmentedLagrangian(max_outer_iterations=2).solve(problem, U0)
    solution.save(tmp_path / "deep" / "solution.npz")
    loaded = Solution.load(tmp_path / "deep" / "solution.npz")
    for f in fields(Solution):
        if f.name not in ("multipliers", "trace", "search", "account"):
            mine, given = getattr(loaded, f.name), getattr(solution, f.name)
            assert (mine is None and given is None) or torch.equal(mine, given), f.name
    assert torch.equal(loaded.multipliers.mu, solution.multipliers.mu)
    assert all(torch.equal(a, b) for a, b in zip(loaded.multipliers.lam, solution.multipliers.lam, strict=True))
    frame = loaded.to_frame()
    assert list(frame.status) == [s.name for s in solution.statuses] and frame.cost.tolist() == solution.cost.tolist()
    with pytest.raises(InputError, match="path"):
        Solution.load(tmp_path / "absent.npz")
    (tmp_path / "code.py").write_text("import torchgco")
    with pytest.raises(InputError, match="another format") as refused:
        Solution.load(tmp_path / "code.py")
    assert "unsafe" not in str(refused.value) and "allow_pickle" not in str(refused.value)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(InputError, match="path"):
        Solution.load(tmp_path / "other.npz")


def test_hold_and_iterated_mppi() -> None:
    problem, U0 = planar_batch(B=2, N=20, obstacles=2)
    held = Hold().solve(problem, U0)
    torch.testing.assert_close(held.X, problem.x0.unsqueeze(1).expand_as(held.X), rtol=0, atol=1e-12)
    flown = IteratedMPPI(sampler=MPPI(samples=50, covariance=25.0), iterations=5).solve(problem, U0)
    assert bool((flown.cost < held.cost).all()) and flown.iterations.tolist() == [5, 5]


def cart(*constraints, B: int = 2, N: int = 8) -> Problem:
    """A point on a line; its speed squared drives it away."""
    dynamics = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0] + x[..., 1] ** 3), dim=-1), 2, 1, 0.1)
    cost = FunctionCost(lambda x, u: u[..., 0] ** 2, lambda x: 0 * x[..., 0])
    return Problem(dynamics, cost, constraints, torch.zeros(B, 2, dtype=torch.float64), N)


def flown(problem: Problem, U: torch.Tensor) -> Solution:
    """Rollouts of given controls, whatever they violate."""
    held = Hold().solve(problem, torch.zeros_like(U))
    return replace(held, X=open_loop(problem.dynamics, problem.x0, U), U=U)


def test_the_worst_row_of_each_problem() -> None:
    late = FunctionConstraint(lambda x: x - 5.0, "equality", knots=[3, 7], name="late")
    rates = RateBounds(torch.tensor([[-0.05], [-1e3]], dtype=torch.float64), 1e3)
    problem = cart(ControlBounds(-9.0, 9.0), late, StateBounds([-1.0, -1.0], [1.0, torch.inf]), rates, B=2)
    U = torch.zeros(2, 8, 1, dtype=torch.float64)
    U[0, 7] = -29.0  # 20 below its bound, and 28.95 too fast a fall
    found = flown(problem, U).worst_rows(problem)
    X = open_loop(problem.dynamics, problem.x0, U)
    for i, place in enumerate(found.constraint):
        largest = torch.stack([part.worst(X, U) for part in problem.constraints])[:, i]
        assert place == int(largest.argmax()) and found.violation[i] == float(largest.max())
        rows = problem.constraints[place].violation(X, U)[i]
        knots = list(range(9)[part]) if isinstance(part := problem.constraints[place].knots, slice) else part.tolist()
        assert rows[knots.index(found.knot[i]), found.row[i]] == rows.max()
    assert found.loc[1, ["constraint", "name", "knot", "row"]].tolist() == [1, "late", 3, 0]
    assert found.loc[0, ["constraint", "name", "knot"]].tolist() == [3, "RateBounds", 7]
    assert found.lost_at.tolist() == [-1, -1]
    easy = cart(ControlBounds(-9.0, 9.0))
    none = flown(easy, 0 * U).worst_rows(easy)
    assert none.constraint.tolist() == [-1, -1] and none.violation.tolist() == [0, 0] and none.name.tolist() == ["", ""]
    with pytest.raises(InputError, match="problem"):
        flown(easy, 0 * U).worst_rows(cart(ControlBounds(-9.0, 9.0), N=9))


def test_the_knot_at_which_states_are_lost() -> None:
    """A cubic that no step of 0.1 s can follow: speeds overflow after a jump at stage 3, and X says from which knot."""
    problem = cart(StateBounds([-1.0, -1.0], [1.0, 1.0]))
    U = torch.zeros(2, 8, 1, dtype=torch.float64)
    U[1, 3] = 1e60
    solution = flown(problem, U)
    found, finite = solution.worst_rows(problem), torch.isfinite(solution.X).all(-1)
    assert found.lost_at[0] == -1 and found.lost_at[1] == int(finite[1].long().sum()) and found.lost_at[1] in (4, 5, 6)
    assert found.violation[1] == torch.inf and found.name[1] == "StateBounds" and found.knot[1] == found.lost_at[1]


def solved(B: int = 3) -> Solution:
    problem, U0 = planar_batch(B=B, N=8)
    return AugmentedLagrangian(max_outer_iterations=2).solve(problem, U0)


def test_a_solution_is_indexed_and_looped_over_as_a_batch() -> None:
    solution = solved()
    assert len(solution) == 3 and bool(solution.take([])) and len(solution[[]]) == 0
    mask = torch.tensor([True, False, True])
    for index, places in ((0, [0]), (-1, [2]), ([2, 0], [2, 0]), (slice(1, None), [1, 2]), (mask, [0, 2]), ((1,), [1])):
        part = solution[index]
        assert torch.equal(part.X, solution.X[places]) and torch.equal(
            part.multipliers.mu, solution.multipliers.mu[places]
        )
        assert torch.equal(solution.take(index if not isinstance(index, int) else [index]).U, part.U)
    assert [one.cost.item() for one in solution] == solution.cost.tolist()
    assert all(one.explain(0).startswith("Problem 0 of 1") for one in solution)
    for wrong in (3, [-4], "first", [0.5], True, None, torch.tensor([[0]]), torch.tensor([True])):
        with pytest.raises(InputError, match="index: expected places of problems, 0 to 2"):
            solution[wrong]


def test_a_solution_as_arrays_and_on_another_device() -> None:
    solution = solved()
    held = solution.to_dict()
    assert held["status"] == [status.name for status in solution.statuses]
    assert np.array_equal(held["X"], solution.X.numpy()) and np.array_equal(held["t"], solution.t.numpy())
    assert solution.to("cpu") is solution
    moved = solution.to("meta")
    tensors = [getattr(moved, f.name) for f in fields(Solution) if isinstance(getattr(moved, f.name), torch.Tensor)]
    assert {part.device.type for part in (*tensors, *moved.multipliers.lam, moved.multipliers.mu, moved.t)} == {"meta"}
    with pytest.raises(InputError, match="device"):
        solution.to("nowhere")


def test_torch_saves_and_loads_a_solution_without_running_code(tmp_path) -> None:
    solution = solved()
    torch.save(solution, tmp_path / "solution.pt")
    loaded = torch.load(tmp_path / "solution.pt")  # of weights alone, as by default
    assert torch.equal(loaded.X, solution.X) and torch.equal(loaded.t, solution.t)
    assert loaded.explain(0).splitlines()[0] == solution.explain(0).splitlines()[0]


@pytest.mark.slow
def test_transforms_of_pytorch_are_refused_by_name() -> None:
    problem, U0 = planar_batch(B=2, N=8)
    twice = torch.stack((U0, U0))
    with pytest.raises(InputError, match=r"solve: expected a call outside of torch\.func:"):
        torch.func.vmap(lambda U: torchgco.solve(problem, U, solver="hold").cost)(twice)
    with pytest.raises(InputError, match=r"Problem: expected a call outside of torch\.func:"):
        torch.func.vmap(lambda x: Problem(problem.dynamics, problem.cost, [], x, 8).x0)(problem.x0[None])
    compiled = torch.compile(lambda U: torchgco.solve(problem, U, solver="hold").cost)
    with pytest.raises(InputError, match=r"solve: expected a call outside of torch\.compile") as refused:
        compiled(U0)
    assert len(str(refused.value).splitlines()) == 1
    assert torchgco.solve(problem, U0, solver="hold").cost.shape == (2,), "and outside all is as before"


def test_the_cause_of_an_error_begins_in_the_users_code() -> None:
    def model(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return x @ torch.zeros(3, 3, dtype=x.dtype)

    problem, _ = planar_batch(B=2, N=8)
    with pytest.raises(InputError, match=r"dynamics\.step") as refused:
        Problem(FunctionDynamics(model, 6, 2, 0.1), problem.cost, [], problem.x0, 8)
    cause = refused.value.__cause__
    assert cause is not None and cause.__traceback__ is not None
    assert cause.__traceback__.tb_frame.f_code.co_name == "model"
    with pytest.raises(InputError, match="horizon") as refused:
        Problem(problem.dynamics, problem.cost, [], problem.x0, 8, horizon="long")
    assert refused.value.__cause__ is None and refused.value.__suppress_context__
