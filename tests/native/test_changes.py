"""A kept trace is never one of other code: whatever a function reads, changes of it are seen at the next solve."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import torchgco
from tests.engines import in_c
from tests.native import changes
from tests.native.changes import CODE, INPUTS, D, Drag, number
from torchgco import FunctionDynamics, Problem, QuadraticCost
from torchgco.dynamics.rollout import open_loop as by_pytorch
from torchgco.kernels import choice, current
from torchgco.native import compiler
from torchgco.native.compiler import find_compiler
from torchgco.tracing import contents

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
N = 4
X0, U = torch.tensor([[0.0, 0.0, 1.0, -1.0]], dtype=D), torch.ones(1, N, 2, dtype=D)
COST = QuadraticCost([1.0] * 4, [1.0] * 2, [1.0] * 4)


@pytest.fixture(autouse=True)
def usual() -> Any:
    before, names = torch.get_default_dtype(), dict(vars(changes))
    yield
    torch.set_default_dtype(before)
    vars(changes).update({name: names[name] for name in ("GAIN", "helper")})


def after(problem: Problem) -> tuple[Tensor, bool]:
    """The states of a rollout in C as of a solve's, which are those of PyTorch, and whether a trace was kept for it."""
    fresh = current(problem)
    kernels = in_c(fresh)
    assert kernels is not None
    found, engine = kernels.open_loop(fresh, U), kernels.engine
    return found, any(engine.captured is kept.captured for kept, _ in choice._engines.values())


def made(drag: Drag) -> Problem:
    field = lambda x, u: torch.cat((x[..., 2:], u - drag(x[..., 2:])), dim=-1)
    return Problem(FunctionDynamics(field, 4, 2, 0.1), COST, [], X0, N)


@pytest.mark.sampled(21)
@pytest.mark.parametrize("name", [*INPUTS, *CODE])
def test_a_change_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    drag, change = (INPUTS | CODE)[name]()
    problem = made(drag)
    before, _ = after(problem)
    again, _ = after(problem)
    assert torch.equal(before, again)
    change()
    if name in INPUTS:
        monkeypatch.setattr(compiler, "_start", lambda *args: pytest.fail("a compiler was called"))
    found, _ = after(problem)
    assert not torch.allclose(found, before, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found, by_pytorch(problem.dynamics, X0, U).detach(), rtol=1e-12, atol=1e-12)


def test_modes_of_pytorch_are_surroundings() -> None:
    weight = number().view(1, 1)
    problem = made(lambda v: (v.unsqueeze(-1) @ weight).squeeze(-1))
    before, is_kept = after(problem)
    assert is_kept

    class Doubling(torch.overrides.TorchFunctionMode):
        def __torch_function__(self, func, types, args=(), kwargs=None):
            return 2.0 * func(*args, **(kwargs or {})) if func is torch.Tensor.matmul else func(*args, **(kwargs or {}))

    with Doubling():
        assert not torch.equal(after(problem)[0], before)
    assert torch.equal(after(problem)[0], before)


@pytest.mark.parametrize("solver", ["gco", "interior_point"])
def test_training_calls_no_compiler_and_keeps_nothing(solver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(4, 6), torch.nn.Tanh(), torch.nn.Linear(6, 2)).double()
    steps = torch.optim.SGD(net.parameters(), lr=0.1)
    problem = made(lambda v: net(torch.cat((v, v.square()), dim=-1)))
    compiled = torchgco.compile(problem, solver, tolerance=1e-10)
    found = [torchgco.solve(problem, solver=solver).X.detach()]
    compiled()
    kept = len(compiler._loaded), len(choice._engines)
    monkeypatch.setattr(compiler, "_start", lambda *args: pytest.fail("a compiler was called"))
    for _ in range(4):
        steps.zero_grad()
        net(torch.ones(1, 4, dtype=D)).square().sum().backward()
        steps.step()
        solution, answer = torchgco.solve(problem, solver=solver).detach(), compiled()
        found.append(solution.X)
        model = by_pytorch(problem.dynamics, X0, solution.U).detach()
        torch.testing.assert_close(solution.X, model, rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(answer.X, solution.X, rtol=1e-6, atol=1e-7)
        assert float((found[-1] - found[-2]).abs().max()) > 1e-5
    assert (len(compiler._loaded), len(choice._engines)) == kept


@pytest.mark.parametrize("name", ["tensor in place", "weight", "array in place", "cell", "attribute", "training flag"])
def test_what_stays_isnt_traced_again(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = made((INPUTS | CODE)[name]()[0])
    after(problem)
    monkeypatch.setattr(choice, "Engine", lambda *args: pytest.fail("traced again"))
    assert after(problem)[1]
    assert after(problem.started_at(X0 + 1.0, ()))[1]


def test_what_is_kept_holds_no_numbers_of_problems() -> None:
    """Nor does it serve others with them."""
    B = 1000

    def given(drag: float) -> Problem:
        field = lambda x, u, by: torch.cat((x[..., 2:], u - by * x[..., 2:]), dim=-1)
        values = {"by": torch.full((B, 2), drag, dtype=D)}
        return Problem(FunctionDynamics(field, 4, 2, 0.1, values=values), COST, [], X0.repeat(B, 1), N)

    for drag in (0.2, 2.0):
        problem = given(drag)
        kernels = in_c(current(problem))
        assert kernels is not None
        engine = kernels.engine
        assert engine.captured is [*choice._engines.values()][-1][0].captured
        found = kernels.open_loop(problem, U.repeat(B, 1, 1))
        expected = by_pytorch(problem.dynamics, problem.x0, U.repeat(B, 1, 1)).detach()
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
        held = [tensor for traced in engine.captured.traces for tensor in traced._captured.values()]
        assert max(tensor.untyped_storage().nbytes() for tensor in held) < 100


def test_large_tensors_leave_room_for_fewer_engines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "_engines", {})
    monkeypatch.setattr(choice, "CAPTURED", 1000)
    for _ in range(4):
        drag = torch.rand(2, 50, dtype=D)  # 800 bytes
        assert after(made(lambda v, drag=drag: v * drag.mean(-1)))[1]
    assert len(choice._engines) == 1


@pytest.mark.parametrize("layout", ["strided", "sparse"])
def test_changes_of_tensors_of_any_layout_are_seen(layout: str) -> None:
    numbers = torch.arange(1.0, 7.0, dtype=D).reshape(3, 2)
    tensor = numbers[:, 1] if layout == "strided" else numbers.to_sparse()
    before = contents([tensor])
    assert contents([tensor]) == before
    (numbers[2:] if layout == "strided" else tensor).mul_(2.0)
    assert before is None or contents([tensor]) != before
    assert (before is None) == (layout == "sparse")


def test_a_sparse_tensor_that_is_kept_leaves_other_problems_alone() -> None:
    """Each new trace is weighed against those that are kept."""
    sparse = torch.eye(2, dtype=D).to_sparse()
    after(made(lambda v: v @ sparse.to_dense()))
    found, kept = after(made(lambda v: 0.5 * v))
    assert kept and bool(torch.isfinite(found).all())
    found, kept = after(made(lambda v: (sparse @ v.reshape(-1, 2).mT).mT.reshape(v.shape)))
    assert bool(torch.isfinite(found).all())
