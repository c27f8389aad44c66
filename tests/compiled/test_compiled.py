"""A compiled problem gives what a fresh solve of the problem with the same numbers gives."""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchgco
from tests.slow import mostly
from torchgco import (
    Body,
    Boxes,
    ControlBounds,
    Dynamics,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    InputError,
    InteriorPoint,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Status,
    Unicycle,
)
from torchgco.kernels import use_native
from torchgco.native import interior
from torchgco.native.compiler import find_compiler

pytestmark = [
    pytest.mark.skipif(find_compiler() is None, reason="no C compiler"),
    pytest.mark.filterwarnings("ignore::torchgco.ContactWarning"),
]
D, INF, N, DT = torch.float64, torch.inf, 20, 0.1
Numbers = dict[str, Any]


def bicycle(x: Tensor, u: Tensor) -> Tensor:
    speed, heading = x[..., 3], x[..., 2]
    rates = speed * heading.cos(), speed * heading.sin(), speed * u[..., 1].tan() / 2.5, u[..., 0]
    return torch.stack(rates, -1)


CAR = FunctionDynamics(bicycle, 4, 2, DT, "rk4", position=slice(0, 2))


def path(t: float) -> np.ndarray:
    times = t + DT * np.arange(N + 1)
    return np.stack((3 * times, 2 * np.sin(0.5 * times), 0 * times, 3 + 0 * times), -1)


def driven(n: Numbers) -> Problem:
    """Cars that follow a reference between discs, all of whose numbers are given."""
    parts = [ControlBounds(n["lower"], n["upper"]), Spheres(n["centers"], n["radii"], n["vehicle_radius"])]
    cost = QuadraticCost(n["Q"], n["R"], n["Qf"], n["x_ref"], n["u_ref"])
    return Problem(CAR, cost, parts, n["x0"], N)


def of_driven(B: int, seed: int) -> Numbers:
    random = np.random.default_rng(seed)
    near = lambda value, share=0.2: np.asarray(value) * (1 + share * random.uniform(-1, 1, (B, *np.shape(value))))
    weights = lambda value: np.stack([np.diag(row) for row in near(value)])[:, None]
    return {
        "x0": near([0.0, 0, 0, 3.0]) + 0.1 * random.standard_normal((B, 4)),
        "x_ref": path(0.0) + 0.2 * random.standard_normal((B, N + 1, 4)),
        "u_ref": 0.1 * random.standard_normal((B, N, 2)),
        "Q": weights([1.0, 1, 0.1, 0.1]), "R": weights([0.1, 1.0]), "Qf": weights([10.0, 10, 1, 1])[:, 0],
        "lower": near([-3.0, -0.5]), "upper": near([3.0, 0.5]),
        "centers": near([[4.0, 1.6], [7.0, -1.4]]), "radii": near([0.5, 0.4]), "vehicle_radius": near(0.3),
    }  # fmt: skip


def as_diagonals(n: Numbers) -> Numbers:
    """Numbers as calls take them: a compiled cost has its weights as diagonals."""
    diagonals = {name: np.diagonal(n[name], axis1=-2, axis2=-1) for name in ("Q", "R", "Qf")}
    return n | diagonals


def heated(n: Numbers) -> Problem:
    """Functions with values of every kind."""

    def rate(x: Tensor, u: Tensor, loss: Tensor, outside: Tensor) -> Tensor:
        return torch.stack((u[..., 0] - loss * (x[..., 0] - outside), x[..., 0] - 0.2 * x[..., 1].sin()), -1)

    model = FunctionDynamics(
        rate, 2, 1, DT, "midpoint", values={"loss": n["loss"]}, knot_values={"outside": n["outside"]}
    )
    cost = FunctionCost(
        lambda x, u, goal, price: (x[..., 1] - goal).square() + price * u[..., 0].square(),
        lambda x, goal: 10 * (x[..., 1] - goal).square(),
        values={"goal": n["goal"]}, knot_values={"price": n["price"]},
    )  # fmt: skip
    row = FunctionConstraint(lambda x, most: (x[..., 0] / most).square().unsqueeze(-1) - 1, values={"most": n["most"]})
    return Problem(model, cost, [ControlBounds(n["lower"], n["upper"]), row], n["x0"], N)


def of_heated(B: int, seed: int) -> Numbers:
    random = torch.Generator().manual_seed(seed)
    drawn = lambda low, high, *shape: low + (high - low) * torch.rand(B, *shape, dtype=D, generator=random)
    return {
        "x0": drawn(-0.5, 0.5, 2), "loss": drawn(0.1, 0.5), "outside": drawn(-0.2, 0.2, N), "goal": drawn(0.5, 1.0),
        "price": drawn(0.05, 0.2, N + 1), "most": drawn(0.6, 1.2), "lower": drawn(-4, -2, 1), "upper": drawn(2, 4, 1),
    }  # fmt: skip


KINDS: dict[str, tuple[Callable[[Numbers], Problem], Callable[[int, int], Numbers], Callable[[Numbers], Numbers]]] = {
    "driven": (driven, of_driven, as_diagonals), "heated": (heated, of_heated, lambda n: n),
}  # fmt: skip


@pytest.mark.parametrize("kind", mostly(KINDS, "heated"))
def test_other_numbers_give_what_a_fresh_solve_gives(kind: str) -> None:
    make, draw, as_taken = KINDS[kind]
    B, now = 3, draw(3, 0)
    mpc = torchgco.compile(make(now), "interior_point", tolerance=1e-12)
    exact, warm = InteriorPoint(tolerance=1e-12), 0
    mpc()
    names = sorted(now)
    for seed in range(1, 14):
        other = draw(B, seed)
        changed = names if seed == 1 else [names[seed % len(names)], "x0"]
        now = now | {name: other[name] for name in changed}
        answer = mpc(**{name: as_taken(now)[name] for name in changed})
        fresh = torchgco.solve(make(now), solver=exact)
        assert answer.statuses == fresh.statuses == [Status.CONVERGED] * B
        torch.testing.assert_close(answer.U, fresh.U, rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(mpc.solution().cost, fresh.cost, rtol=1e-9, atol=1e-12)
        warm += int(answer.warm.sum())
    assert warm > 30  # of 39


@pytest.mark.parametrize("kind", KINDS)
def test_written_numbers_lie_in_memory_as_bound_ones_do(kind: str) -> None:
    """Bit for bit, whatever way they came."""
    make, draw, as_taken = KINDS[kind]
    now, new = draw(3, 1), draw(3, 2)
    written, bound = torchgco.compile(make(now)), torchgco.compile(make(new))
    written.numbers.write(as_taken(new))
    written._refresh()
    bound._refresh()
    for one, other in zip(memory(written), memory(bound), strict=True):
        assert torch.equal(one, other)
    for name in written.numbers:
        np.testing.assert_allclose(written.numbers[name], bound.numbers[name], rtol=1e-14)


def memory(mpc: torchgco.Compiled) -> list[Tensor]:
    """All numbers that C reads."""
    packed = mpc._kept
    assert isinstance(packed, interior.Kept)
    arrays = [packed._model, *packed._cost]
    arrays += [value for numbers in packed._numbers for value in numbers.values() if hasattr(value, "size")]
    return [tensor for array in arrays for tensor in getattr(array, "kept", [])] + [packed.X[:, 0]]


def test_a_receding_horizon() -> None:
    x, mpc = np.array([[0.0, 0, 0, 3.0]]), torchgco.compile(driven(of_driven(1, 0)), receding=True)
    for k in range(60):
        answer = mpc(x0=x, x_ref=path(DT * k), u_ref=np.zeros((N, 2)), centers=[[9.0, 2.8], [14.0, -0.5]])
        assert answer.statuses == [Status.CONVERGED] and bool(answer.warm) == (k > 0)
        torch.testing.assert_close(answer.X[:, 1], CAR.step(torch.tensor(x), answer.u))
        x = answer.X[:, 1].numpy()
    assert int(answer.iterations) < 10 and np.abs(x[0, :2] - path(6.0)[0, :2]).max() < 0.5


def test_problems_of_a_batch_are_as_alone() -> None:
    """Some of them jump, so that no warm start leads to their solutions."""
    now, far = of_driven(12, 3), of_driven(12, 4)
    jumps = np.arange(12) % 5 == 2
    far["x0"][jumps] += [0, 0, 2.5, 0]
    whole = torchgco.compile(driven(now), "interior_point")
    whole()
    answer = whole(**as_diagonals(far))
    for b in (0, 2, 7, 11):
        row = lambda numbers, b=b: {name: value[b : b + 1] for name, value in numbers.items()}
        alone = torchgco.compile(driven(row(now)), "interior_point")
        alone()
        one = alone(**row(as_diagonals(far)))
        assert torch.equal(one.U[0], answer.U[b]) and one.statuses[0] == answer.statuses[b]
        assert bool(one.warm) == bool(answer.warm[b])


def test_what_no_warm_start_solves_is_solved_again() -> None:
    numbers = of_driven(2, 5)
    mpc = torchgco.compile(driven(numbers))
    mpc()
    broken = numbers["x0"].copy()
    broken[1, 3] = np.nan
    answer = mpc(x0=broken)
    assert answer.statuses == [Status.CONVERGED, Status.NON_FINITE] and answer.warm.tolist() == [True, False]
    assert mpc(x0=numbers["x0"]).statuses == [Status.CONVERGED] * 2  # nothing of the failed solve is used


def test_a_deadline_ends_a_call() -> None:
    numbers = of_driven(64, 6)
    mpc = torchgco.compile(driven(numbers), "interior_point")
    began = time.monotonic()
    answer = mpc(max_seconds=1e-6)
    assert set(answer.statuses) <= {Status.TIME_LIMIT, Status.FEASIBLE, Status.CONVERGED}
    assert time.monotonic() - began < 5.0 and torch.isfinite(answer.U).all()
    mpc(warm=False)
    jumped = mpc(x0=numbers["x0"] + 0.5, max_seconds=1e-6)
    assert Status.TIME_LIMIT in jumped.statuses and torch.isfinite(jumped.U).all()
    late = jumped.iterations == 0  # not begun: there is no feedback, rather than that of the last call
    assert bool(late.any()) and bool((jumped.K[late] == 0.0).all())
    assert mpc().statuses == [Status.CONVERGED] * 64


@pytest.fixture
def native_again() -> Iterator[None]:
    yield
    use_native(True)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("form", mostly(["rates", "horizon", "free start", "pytorch", "boxes"], "rates"))
@pytest.mark.usefixtures("native_again")
def test_problems_of_every_form(form: str) -> None:
    """What isn't packed for C goes the long way, with the same answers."""
    x0, more = torch.tensor([[0.0, 0.0], [0.3, 0.0]], dtype=D), {}
    model = FunctionDynamics(lambda x, u: torch.stack((x[..., 1], u[..., 0]), -1), 2, 1, DT, "rk4", slice(0, 1))
    parts: list[Any] = [ControlBounds(-2.0, 2.0), StateBounds([-INF, -1.0], [INF, 1.0])]
    if form == "rates":
        parts.append(RateBounds(-0.5, 0.5))
    elif form == "horizon":
        more = {"horizon": torch.tensor([N, N // 2])}
    elif form == "free start":
        more = {"free_start": [False, True]}
    elif form == "boxes":
        plane = lambda x, u: torch.cat((x[..., 2:], u), -1)
        model, x0 = FunctionDynamics(plane, 4, 2, DT, "rk4", slice(0, 2)), torch.zeros(2, 4, dtype=D)
        parts = [ControlBounds(-2.0, 2.0), Boxes([[0.5, 0.1]], [[0.1, 0.1]], 0.05)]
    goal = torch.zeros(2, 1, x0.shape[1], dtype=D)
    goal[:, 0, 0] = torch.tensor([1.0, 0.8])
    of = lambda goal: Problem(
        model, QuadraticCost([1.0] + [0.1] * (x0.shape[1] - 1), 0.1 * np.ones(model.m), [10.0] * x0.shape[1], goal),
        parts, x0, N, **more,
    )  # fmt: skip
    use_native(form != "pytorch")
    mpc = torchgco.compile(of(goal), "interior_point")
    mpc()
    answer = mpc(x_ref=(0.9 * goal).expand(2, N + 1, -1))
    expected = torchgco.solve(of(0.9 * goal), solver="interior_point")
    assert answer.statuses == expected.statuses
    torch.testing.assert_close(mpc.solution().cost, expected.cost, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_what_a_function_captures_is_read_at_each_call() -> None:
    wind, limit = torch.tensor([0.1, 0.0], dtype=D), np.array([0.8])
    weight, gain = torch.nn.Parameter(torch.zeros(1, dtype=D)), [1.0]
    field = lambda x, u, load: torch.stack((x[..., 1], gain[0] * u[..., 0] + wind[0] / load + wind[1] * x[..., 1]), -1)
    table = torch.linspace(0.0, 1.0, N, dtype=D)
    cost = FunctionCost(
        lambda x, u, k: (x[..., 0] - table[k]).square() + 0.1 * u.square().sum(-1) + (weight[0] * x[..., 1]).square(),
        lambda x: 10.0 * (x[..., 0] - table[-1]).square(),
    )
    slow = FunctionConstraint(lambda x: x[..., 1:] - torch.from_numpy(limit))
    make = lambda: Problem(
        FunctionDynamics(field, 2, 1, DT, "rk4", values={"load": [1.5]}), cost, [ControlBounds(-2.0, 2.0), slow],
        torch.zeros(1, 2, dtype=D), N,
    )  # fmt: skip
    mpc = torchgco.compile(make(), "interior_point", tolerance=1e-10)
    before = mpc()

    @torch.no_grad()
    def now() -> None:
        nonlocal before
        answer, fresh = mpc(), torchgco.solve(make(), solver=replace(InteriorPoint(), tolerance=1e-10))
        assert answer.statuses == [Status.CONVERGED] and mpc.stale() is None
        torch.testing.assert_close(answer.X, fresh.X, rtol=1e-6, atol=1e-7)
        torch.testing.assert_close(mpc.solution().cost, fresh.cost, rtol=1e-9, atol=1e-9)
        assert float((answer.X - before.X).abs().max()) > 1e-4
        before = answer

    wind[0] = 0.6
    now()
    limit[0] = 0.5
    now()
    table *= 0.7
    now()
    with torch.no_grad():
        weight.fill_(0.5)
    now()
    wind[1] = -0.3  # no longer a zero, which is part of the code: compiled again
    now()
    wind.data = torch.tensor([0.2, 0.1], dtype=D)
    now()
    gain[0] = 1.1
    assert "compile it again" in str(mpc.stale())
    gain[0], wind = 1.0, torch.tensor([0.3, 0.1], dtype=D)
    assert "compile it again" in str(mpc.stale())


@pytest.mark.slow
def test_what_python_reads_of_captured_tensors_is_read_again_too() -> None:
    """And tensors whose numbers lie apart in memory."""
    table, sharp, side = torch.rand(4, 3, dtype=D), torch.tensor(1.5, dtype=D), torch.tensor([0.3], dtype=D)
    drag = table[:, 1]
    field = lambda x, u: torch.stack((x[..., 1], u[..., 0] - drag.sum() * x[..., 1]), -1)
    cost = FunctionCost(lambda x, u: torch.nn.functional.softplus(x[..., 0], beta=sharp) + u.square().sum(-1))
    rows = FunctionConstraint(lambda x: x[..., :1] - 2.0 if side < 1.0 else 1.5 - x[..., :1], knots=slice(10, None))
    problem = Problem(FunctionDynamics(field, 2, 1, DT), cost, [rows], torch.ones(1, 2, dtype=D), N)
    mpc = torchgco.compile(problem, "interior_point", tolerance=1e-10)
    before = mpc()
    for change in (lambda: table.mul_(2.0), lambda: sharp.mul_(0.3), lambda: side.add_(1.0)):
        change()
        answer, fresh = mpc(warm=False), torchgco.solve(problem, solver=replace(InteriorPoint(), tolerance=1e-10))
        assert answer.statuses == [Status.CONVERGED] and mpc.stale() is None
        torch.testing.assert_close(answer.X, fresh.X, rtol=1e-6, atol=1e-7)
        assert float((answer.X - before.X).abs().max()) > 1e-4
        before = answer


@pytest.mark.slow
def test_what_python_reads_of_a_problems_own_numbers_is_no_code() -> None:
    class Cart(Dynamics):
        n, m, dt = 2, 1, DT
        per_element = ("mass",)

        def __init__(self, mass: float) -> None:
            self.mass = torch.tensor([mass], dtype=D)

        def field(self, x: Tensor, u: Tensor) -> Tensor:
            return torch.cat((x[..., 1:], u / float(self.mass)), dim=-1)

    make = lambda mass: Problem(Cart(mass), QuadraticCost([1.0] * 2, [1.0], [9.0] * 2), [], [[1.0, 0.0]], N)
    mpc = torchgco.compile(make(1.5), "interior_point")
    answers = mpc(), mpc(mass=0.5)
    for answer, mass in zip(answers, (1.5, 0.5), strict=True):
        torch.testing.assert_close(answer.X, torchgco.solve(make(mass), solver="interior_point").X)


def test_one_thread_at_a_time_and_processes_compile_their_own() -> None:
    mpc = torchgco.compile(driven(of_driven(2, 7)))
    first = mpc()
    other = pickle.loads(pickle.dumps(mpc))
    torch.testing.assert_close(other().U, first.U, rtol=1e-6, atol=1e-6)
    errors, inside = list[Exception](), threading.Event()

    def call() -> None:
        try:
            mpc()
        except InputError as error:
            errors.append(error)
        inside.set()

    with mpc._lock:
        thread = threading.Thread(target=call)
        thread.start()
        inside.wait()
        thread.join()
    assert "one call at a time" in str(errors[0])
    assert mpc().statuses == [Status.CONVERGED] * 2


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"x0": np.zeros((1, 5))}, "x0: expected shape (2, 4), or (4,) for all problems, got (1, 5)"),
        ({"speed": 1.0}, "numbers: expected one of x0, x_ref, u_ref, Q, R, Qf, lower, upper, centers, radii"),
        ({"upper": [np.inf, 1.0]}, None),
        ({"upper": [-9.0, 1.0]}, "constraints[0].upper: expected lower bounds of at most the upper ones"),
        ({"lower": [4.0, -0.5], "upper": [3.9, 0.5]}, "constraints[0].lower: expected lower bounds of at most"),
        ({"radii": [-1.0, 1.0]}, "constraints[1].radii: expected lengths of at least 0, got -1.0"),
        ({"Q": [[-1.0, 1, 1, 1]]}, "cost.Q: expected numbers of at least 0, got -1.0"),
        ({"x_ref": np.nan * path(0.0)}, "cost.x_ref: expected finite numbers, got NaN or infinity"),
        ({"x0": "fast"}, "x0: expected numbers, got str"),
        ({"x0": ["0", "1", "2", "3"]}, "x0: expected numbers, got list"),
        ({"x0": torch.full((4,), 1j)}, "x0: expected numbers, got Tensor"),
        ({"radii": np.array([0.5, 0.5j])}, "constraints[1].radii: expected numbers, got ndarray"),
        ({"upper": torch.zeros(2, device="meta")}, "constraints[0].upper: expected numbers, got Tensor"),
        ({"numbers": [("x0", np.ones(4))]}, "numbers: expected a dict of numbers by name, got [("),
        ({"warm": "no"}, "warm: expected true or false, got 'no'"),
        ({"shift": -1}, "shift: expected a number of stages, at least 0, got -1"),
        ({"max_seconds": 0.0}, "max_seconds: expected"),
    ],
)
def test_a_mistake_changes_nothing_and_gets_one_line(numbers: Numbers, message: str | None) -> None:
    mpc = torchgco.compile(driven(of_driven(2, 8)))
    before = {name: mpc.numbers[name] for name in mpc.numbers}
    if message is None:
        assert mpc(**numbers).statuses == [Status.CONVERGED] * 2
        return
    with pytest.raises(InputError) as error:
        mpc(**({"x0": np.ones(4)} | numbers))
    assert str(error.value).startswith(message) and "\n" not in str(error.value)
    assert all(np.array_equal(mpc.numbers[name], value) for name, value in before.items() if name != "x0")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.StepWarning")  # of a car far beyond its bounds
def test_numbers_of_one_call_are_checked_together() -> None:
    problem = driven(of_driven(2, 8))
    weights = QuadraticCost([1.0] * 4, [0.1] * 2, [1.0] * 4, H=0.01 * np.ones((2, 4)))
    mpc = torchgco.compile(Problem(CAR, weights, problem.constraints, problem.x0, N))
    upper = mpc.numbers["upper"]
    beyond = mpc(lower=upper + 1.0, upper=upper + 2.0, max_seconds=1.0)
    assert beyond.U.shape == (2, N, 2), "lower bounds above the old upper ones"
    with pytest.raises(InputError, match=r"cost.H: expected a weight .* that is positive semidefinite"):
        mpc(Q=[1e-6 * np.eye(4)])


@pytest.mark.parametrize("context", [torch.inference_mode, lambda: torch.device("meta")], ids=["inference", "device"])
def test_modes_and_default_devices_of_the_caller_change_nothing(context: Callable[[], Any]) -> None:
    numbers = of_driven(1, 8)
    problem, expected = driven(numbers), torchgco.compile(driven(numbers))()
    with context():
        mpc = torchgco.compile(problem)
        first = mpc()
    assert torch.equal(first.X, expected.X) and mpc(x0=numbers["x0"]).statuses == [Status.CONVERGED]
    with context():
        assert mpc(x0=numbers["x0"]).statuses == [Status.CONVERGED] and mpc.stale() is None


def test_numbers_are_listed_and_only_the_chosen_ones_change() -> None:
    problem = driven(of_driven(2, 9))
    mpc = torchgco.compile(problem, changes=["x0", "constraints[1].centers"])
    assert list(mpc.numbers) == ["x0", "constraints[1].centers"] and "2x2x2" in repr(mpc.numbers)
    mpc.numbers["centers"] = np.zeros((2, 2)) + 30.0
    assert float(mpc.numbers["constraints[1].centers"].min()) == 30.0
    assert float(problem.constraints[1].centers.min()) < 30.0  # the problem keeps its own
    with pytest.raises(InputError, match="numbers: expected one of x0, centers, got radii"):
        mpc(radii=[1.0, 1.0])
    with pytest.raises(InputError, match="solver: expected"):
        torchgco.compile(problem, "al_ilqr")


def test_a_number_is_given_once() -> None:
    """Whatever the two names and the two ways are; nothing is changed then."""
    numbers = of_driven(1, 3)
    mpc = torchgco.compile(driven(numbers), "interior_point")
    before = mpc.numbers["x_ref"]
    for call in (
        lambda: mpc(x_ref=before + 1.0, numbers={"cost.x_ref": before}),
        lambda: mpc(x_ref=before + 1.0, numbers={"x_ref": before}),
        lambda: mpc(numbers={"x_ref": before + 1.0, "cost.x_ref": before}),
        lambda: mpc.numbers.write({"x_ref": before + 1.0, "cost.x_ref": before}),
    ):
        with pytest.raises(InputError, match=r"numbers: expected each number once, got cost\.x_ref twice, as"):
            call()
        assert np.array_equal(mpc.numbers["x_ref"], before)
    assert mpc(numbers={"cost.x_ref": before}).statuses == [Status.CONVERGED]


def test_captured_numbers_that_become_or_cease_to_be_0_or_1_are_no_change_of_code() -> None:
    k, random = torch.tensor([1.5, 2.0]).double(), np.random.default_rng(0)
    other = torch.tensor([0.0, 3.0]).double()
    rates = lambda x, u: torch.cat((x[..., 2:], u - k * x[..., 2:] + 0.0 * other), -1)
    model = FunctionDynamics(rates, 4, 2, DT, "rk4", position=slice(0, 2))
    cost = QuadraticCost([1.0] * 4, [0.1] * 2, [1.0] * 4)
    mpc = torchgco.compile(Problem(model, cost, [ControlBounds(-2, 2)], [[1.0, 0.5, 0.0, 0.0]], 8), "interior_point")
    for _ in range(12):
        k.copy_(torch.tensor(random.choice([0.0, 1.0, -1.0, 0.3, 2.7], 2)))
        mpc()
        assert mpc.stale() is None, k.tolist()
    kept, rates_now = rates, lambda x, u: torch.cat((x[..., 2:], 2.0 * u), -1)
    object.__setattr__(mpc.problem.dynamics, "function", rates_now)
    assert "compile it again" in str(mpc.stale())
    object.__setattr__(mpc.problem.dynamics, "function", kept)
    assert mpc.stale() is None


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["discs", "moving discs", "boxes"])
def test_obstacles_among_a_body_have_numbers(kind: str) -> None:
    random = np.random.default_rng(0)

    def among(centers: Any, velocities: Any = None, radii: Any = 0.3) -> Problem:
        robot = Body.covering([-0.5, -0.3], [0.5, 0.3], [2, 1])
        parts: Any = Boxes(centers, [[0.3, 0.4], [0.3, 0.3]], robot)
        if kind != "boxes":
            parts = Spheres(centers, radii, robot, velocities)
        cost = QuadraticCost([0.1, 0.1, 0, 0.1], [0.1, 0.1], [10, 10, 0, 1], x_ref=[4.0, 0.3, 0, 0])
        return Problem(Unicycle(dt=DT), cost, [parts, ControlBounds([-3, -2], [3, 2])], [[0.0, 0.0, 0.0, 1.0]], 25)

    first = np.array([[2.0, 1.6], [2.0, -1.6]])
    moves = {"velocities": np.zeros((2, 2))} if kind == "moving discs" else {}
    mpc = torchgco.compile(among(first, **moves), "interior_point")
    mpc()
    for _ in range(4):
        new: dict[str, Any] = {"centers": first + random.uniform(-0.4, 0.4, (2, 2))}
        if moves:
            new["velocities"] = random.uniform(-0.2, 0.2, (2, 2))
        if kind != "boxes":
            new["radii"] = random.uniform(0.2, 0.4, 2)
        answer, fresh = mpc(**new, warm=False), torchgco.compile(among(**new), "interior_point")()
        assert answer.statuses == fresh.statuses == [Status.CONVERGED] and mpc.stale() is None
        torch.testing.assert_close(answer.X, fresh.X, rtol=0, atol=1e-6)
        torch.testing.assert_close(mpc.solution().cost, torchgco.judge(among(**new), answer.U).cost)


def test_numbers_of_the_given_problem_that_change_in_place_are_named() -> None:
    centers = torch.tensor([[1.5, 0.1]], dtype=D)
    model = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.15, "rk4", position=slice(0, 2))
    cost = QuadraticCost([1, 1, 0.1, 0.1], [0.1, 0.1], [50, 50, 5, 5], x_ref=[3.0, 0, 0, 0])
    problem = Problem(model, cost, [Spheres(centers, [0.4], 0.1), ControlBounds(-4, 4)], torch.zeros(1, 4, dtype=D), 20)
    mpc, found = torchgco.compile(problem, "interior_point"), torchgco.solve(problem, solver="interior_point")
    before = mpc()
    assert mpc.stale() is None and len(found.trajectories(100.0)) > 20
    centers += torch.tensor([0.0, -0.3], dtype=D)
    assert "in place" in str(mpc.stale()) and torch.equal(mpc(warm=False).X, before.X), "it has numbers of its own"
    for figure in (lambda: found.trajectories(100.0), lambda: found.t, lambda: found.duration):
        with pytest.raises(InputError, match="changed in place since"):
            figure()
    assert len(found.trajectories(100.0, problem=problem)) > 20
