"""Exported C with bounds of rates and links: the bits of `MPC`, the controls that rates count from, and held plans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import M4F, M7, SAME, STRICT, exported, needs, needs_compiler, on_board, said
from tests.export.free import timed
from tests.export.kinds import CAR, START, N, car, point, reference
from tests.export.test_free_time import begin_alike
from tests.export.test_stack import DESKTOP, frames
from torchgco import (
    MPC,
    ControlBounds,
    InputError,
    Link,
    NormBounds,
    Problem,
    QuadraticCost,
    RateBounds,
    Spheres,
    StateBounds,
    Status,
    load_c,
)
from torchgco.constraints.bounds import rates_of
from torchgco.export.files import STACK

pytestmark = [
    needs_compiler,
    pytest.mark.usefixtures("quickly"),
    pytest.mark.filterwarnings("ignore::torchgco.ContactWarning", "ignore::torchgco.HorizonWarning"),
]
INF = np.inf
FALL, RISE = np.array([-0.15, -0.1]), np.array([0.2, 0.12])
FAR = Spheres([[2.5, 2.2]], [0.3], 0.2)


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-O1")


def gentle(previous: Any = (0.0, 0.0)) -> Problem:
    return car(FAR, RateBounds(FALL, RISE, previous=list(previous)))


def loose() -> Problem:
    return car(FAR, RateBounds(-0.4, 0.4, previous=0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(gentle(), tmp_path_factory.mktemp("rates"))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("push", [0.0, 0.02])
@pytest.mark.parametrize("stages", [1.0, 0.5, 1.3])
def test_40_periods_have_the_bits_of_mpc(folder: Path, push: float, stages: float) -> None:
    """Of parts of a stage, too, in which a loop of periods of a stage may come early or late."""
    c, mpc = load_c(folder), MPC(gentle(), "interior_point")
    x, draws, last = np.array(START), np.random.default_rng(0), np.zeros(2)
    for k in range(40):
        t = 0.1 * stages * k
        v, u = mpc.step(x, t=t, x_ref=reference(t)), c.step(x, t=t, x_ref=reference(t))
        assert mpc.answer is not None and c.status == mpc.statuses[0] == Status.CONVERGED
        assert torch.equal(u, v) and torch.equal(c.plan[0], mpc.answer.X[0]), k
        assert c.workspace.iterations == int(mpc.answer.iterations[0])
        assert k == 0 or (c.workspace.warm and torch.equal(c.plan[2], mpc.answer.K[0]))
        change = u.numpy() - last
        assert (change <= RISE + 1e-6).all() and (change >= FALL - 1e-6).all()
        assert np.array_equal(c.numbers["previous"], u) and np.array_equal(mpc.numbers["previous"][0], last)
        last = u.numpy()
        x = mpc.answer.X[0, 1].numpy() + push * draws.standard_normal(4)


KINDS: dict[str, Callable[[], Problem]] = {
    "one control": lambda: car(RateBounds([-0.2, -INF], [INF, INF], previous=0.0)),
    "some knots": lambda: car(RateBounds(-0.2, [0.3, INF], previous=[0.1, 0.0], knots=[0, 5, 3])),
    "by knot": lambda: car(RateBounds(np.linspace(-0.3, -0.1, 2 * N).reshape(1, N, 2), 0.3, previous=0.0)),
    "free at first": lambda: car(FAR, RateBounds(FALL, RISE)),
    "one stage": lambda: Problem(
        CAR, QuadraticCost([1, 1, 0.1, 0.1], [0.1, 1], [10, 10, 1, 1], [0.4, 0.1, 0.0, 3.5]),
        [ControlBounds([-3.0, -0.5], [3.0, 0.5]), RateBounds(FALL, RISE, previous=[0.0, 0.0])],
        torch.tensor([START]).double(), 1,
    ),
    "speed": lambda: car(StateBounds(-INF, [INF, INF, INF, 3.2]), RateBounds(-0.3, 0.3, previous=0.0)),
    "a link": lambda: point(Link(knots=(3, 8), components=[3, 1])),
    "an inequality": lambda: point(Link(lambda a, b, gap: a + gap - b, (3, -1), "inequality", [0], {"gap": [[1.2]]})),
    "two links and rates": lambda: point(
        Link(knots=(2, 7), components=[3]), RateBounds(-3.0, 3.0, previous=0.5), Link(knots=(4, 9), components=[1]),
        NormBounds("u", upper=6.0),
    ),
    "a free start": lambda: point(
        Link(lambda a, b: a + b, components=[1]), RateBounds(-4.0, 4.0), free_start=[False, True, False, True]
    ),
}  # fmt: skip


@pytest.mark.sampled(3)
@pytest.mark.parametrize("kind", KINDS)
def test_steps_have_the_bits_of_python(kind: str, tmp_path: Path) -> None:
    """With numbers that change, and where another step wrote what the vehicle did instead."""
    problem = KINDS[kind]()
    c, compiled = load_c(exported(problem, tmp_path)), torchgco.compile(problem, "interior_point", receding=True)
    rows = [i for i, part in enumerate(problem.constraints) if part.joins_knots]
    fields = {f"constraints[{i}].{name}" for i in rows for name in ("lower", "upper", "gap")} & set(compiled.numbers)
    previous = [name for name in compiled.numbers if name.endswith(".previous")]
    assert fields | set(previous) or kind == "a link" or kind == "a free start"
    x, u, draws = problem.x0[0].numpy().copy(), torch.zeros(2), np.random.default_rng(1)
    for k in range(8):
        numbers = {name: (0.9 if k == 3 else 1.0) * compiled.numbers[name][0] for name in fields}
        if k:
            numbers |= {name: u.numpy() + 0.05 * (k == 5) for name in previous}
        answer = compiled(x0=x, numbers=numbers)
        told = {member(c, name): value for name, value in numbers.items() if k in (3, 5)}
        u = c.step(x, numbers={name: value for name, value in told.items() if name in c.numbers})
        assert torch.equal(u, answer.u[0]) and c.status == answer.statuses[0] == Status.CONVERGED, k
        assert torch.equal(c.plan[0], answer.X[0]) and c.workspace.iterations == int(answer.iterations[0])
        x = answer.X[0, min(1, problem.N)].numpy() + 2e-3 * draws.standard_normal(len(x))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("period", [0.05, 0.07, 0.1, 0.15])
def test_rates_are_those_of_time_in_periods_of_any_length(period: float, tmp_path: Path) -> None:
    """As of MPC: else they could change in every period by as much as in a stage."""
    c = load_c(torchgco.export_c(gentle(), tmp_path, "car", period=period))
    mpc = MPC(gentle(), "interior_point", period, max_seconds=INF)
    assert c.period == pytest.approx(period)
    x, share = np.array(START), period / 0.1
    for k in range(12):
        before = c.numbers["previous"].copy()
        v, u = mpc.step(x, x_ref=reference(period * k)), c.step(x, x_ref=reference(period * k))
        assert torch.equal(u, v) and c.status == mpc.statuses[0] == Status.CONVERGED, k
        a, steering = u.numpy()
        change = u.numpy() - before
        assert (change <= share * RISE + 1e-6).all() and (change >= share * FALL - 1e-6).all()
        x = x + period * np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), x[3] * np.tan(steering) / 2.5, a])
    assert "double constraints_2_upper[" + ("24]" if share < 1 else "2]") in (tmp_path / "car.h").read_text()


def test_the_problem_of_a_loop_has_its_rates_already(tmp_path: Path) -> None:
    """They were shortened a second time."""
    loops = gentle(), MPC(gentle(), "interior_point", 0.05).compiled
    first, again = (
        torchgco.export_c(problem, tmp_path / str(i), "car", period=0.05) for i, problem in enumerate(loops)
    )
    for name, value in load_c(first).numbers.items():
        assert np.array_equal(value, load_c(again).numbers[name]), name


@pytest.mark.parametrize("period", [None, 0.1, 0.15])
def test_the_problem_of_a_loop_of_short_periods_serves_whole_stages(period: float | None, tmp_path: Path) -> None:
    """It kept the rates of the short periods."""
    short = MPC(gentle(), "interior_point", 0.05).compiled
    c = load_c(torchgco.export_c(short, tmp_path, "car", period=period))
    again = MPC(short.problem, "interior_point", period, max_seconds=INF)
    for lower, upper in (
        (c.numbers["constraints_2_lower"], c.numbers["constraints_2_upper"]),
        (again.numbers["constraints[2].lower"], again.numbers["constraints[2].upper"]),
    ):
        assert np.allclose(np.reshape(lower, (-1, 2)), FALL) and np.allclose(np.reshape(upper, (-1, 2)), RISE)


@pytest.mark.parametrize("options", [{"period": 0.0}, {"period": "1"}, {"period": 0.1, "receding": False}])
def test_periods_that_are_none(options: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="period"):
        torchgco.export_c(gentle(), tmp_path / "folder", **options)
    assert not (tmp_path / "folder").exists()


def member(c: torchgco.LoadedController, name: str) -> str:
    long = name.replace("[", "_").replace("].", "_")
    return long if long in c.numbers else name.rpartition(".")[2]


def test_failing_steps_hold_the_plan_within_bounds_and_rates_as_mpc_does(folder: Path) -> None:
    """Without feedback, which could break them."""
    c, mpc = load_c(folder), MPC(gentle(), "interior_point")
    x, last = np.array(START), np.zeros(2)
    for k in range(12):
        late: Any = {"max_seconds": 1e-9} if k in (2, 3, 4, 8) else {"max_seconds": INF}
        told: Any = {"previous": last + np.array([0.5, -0.5])} if k == 4 else {}  # the vehicle did something else
        planned = c.plan[1][min(int(c.workspace.age) + 1, N - 1)].numpy()
        v, u = mpc.step(x, **late, **told), c.step(x, **late, **told)
        assert c.status == mpc.statuses[0] and c.held == bool(mpc.held) == (k in (2, 3, 4, 8))
        assert k > 1 or torch.equal(u, v)  # where a solve isn't ready, MPC may fly it if it costs less
        change = u.numpy() - told.get("previous", last)
        assert (change <= RISE + 1e-6).all() and (change >= FALL - 1e-6).all()
        if c.held:
            before = told.get("previous", last)
            assert np.array_equal(u.numpy(), np.clip(planned, before + FALL, before + RISE))
        last = u.numpy()
        x = mpc.answer.X[0, 1].numpy() + 0.002  # type: ignore[union-attr]


def test_a_failed_warm_step_begins_again_within_rates_as_mpc_does(folder: Path) -> None:
    c, mpc = load_c(folder), MPC(gentle(), "interior_point")
    x = np.array(START)
    for k in range(6):
        if k == 3:
            c.workspace.lam[:] = [np.nan] * len(c.workspace.lam)
            for lam in mpc.compiled._kept.lam:  # type: ignore[union-attr]
                lam[:] = np.nan
        v, u = mpc.step(x), c.step(x)
        assert mpc.answer is not None and c.status == mpc.statuses[0] == Status.CONVERGED
        assert torch.equal(u, v) and bool(mpc.answer.warm[0]) == (k not in (0, 3)), k
        x = mpc.answer.X[0, 1].numpy() + 0.002


def test_a_reset_begins_with_the_exported_controls_before(folder: Path) -> None:
    c, fresh = load_c(folder), load_c(folder)
    first = fresh.step(START)
    c.numbers["constraints_2_upper"][...] = 0.3
    for _ in range(3):
        c.step(START)
    c.reset()
    assert c.numbers["previous"].tolist() == [0.0, 0.0] and c.numbers["constraints_2_upper"].tolist() == [0.3, 0.3]
    c.numbers["constraints_2_upper"][...] = RISE
    assert torch.equal(c.step(START), first)


def test_a_step_for_the_same_time_counts_from_the_same_controls(folder: Path) -> None:
    """As to go on where iterations were over."""
    c, u, again = load_c(folder), np.zeros(2), np.zeros(2)
    x = np.array(START)
    c.raw_step(x, 0.0, INF, u)
    c.raw_step(x, 1.0, INF, u)
    for _ in range(3):
        assert c.raw_step(x, 0.0, INF, again) == Status.CONVERGED
        np.testing.assert_allclose(again, u, rtol=0, atol=1e-5)
    c.raw_step(x, 1.0, INF, again)
    assert float(np.abs(again - u).max()) > 0.05


@pytest.mark.parametrize("previous", [[np.nan, 0.0], [INF, 0.0]])
def test_controls_before_that_are_no_numbers_are_no_step(folder: Path, previous: Any) -> None:
    """They bound nothing, and the next step counts from what was returned."""
    c, x = load_c(folder), np.array(START)
    c.step(x)
    planned = c.plan[1][1]
    u = c.step(x, previous=previous)
    assert c.workspace.status == -2 and c.held and torch.isfinite(u).all()
    torch.testing.assert_close(u[0], planned[0], rtol=0, atol=1e-12)
    then = c.step(x)
    assert c.status == Status.CONVERGED and bool((then - u).abs().max() <= 0.2 + 1e-6)


@pytest.mark.parametrize("bad", [np.nan, INF])
def test_a_bad_state_holds_within_rates(folder: Path, bad: float) -> None:
    c, u = load_c(folder), np.zeros(2)
    assert c.raw_step(np.array([bad, 0, 0, 3.0]), 0.0, INF, u) == -1 and np.array_equal(u, [0.0, 0.0])
    last = c.step(START).numpy()
    c.numbers["previous"][...] = last + 1.0
    assert c.raw_step(np.array([0, bad, 0, 3.0]), 1.0, INF, u) == -1 and c.held
    np.testing.assert_allclose(u, [last[0] + 1.0 + FALL[0], 0.5], rtol=0, atol=1e-12)  # its bound counts first


def test_controls_before_that_are_out_of_bounds_are_brought_back(folder: Path) -> None:
    """Where rates and bounds exclude each other, no plan is found, and bounds count."""
    c, mpc, x = load_c(folder), MPC(gentle(), "interior_point"), np.array(START)
    u = c.step(x, previous=[0.0, 2.0])
    assert c.held and c.status != Status.CONVERGED and u.tolist() == [0.0, 0.5]
    assert float(mpc.step(x, previous=[0.0, 2.0])[1]) == 0.5
    c.step(x)
    assert c.status == Status.CONVERGED and not c.held
    u = c.step(x, previous=[0.0, 0.55])
    assert c.status == Status.CONVERGED and 0.45 - 1e-6 <= float(u[1]) <= 0.5


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_bounds_of_rates_that_cannot_be(folder: Path, side: str) -> None:
    c, x, name = load_c(folder), np.array(START), f"constraints_2_{side}"
    c.step(x)
    before, beyond = c.numbers[name].copy(), {"lower": INF, "upper": -INF}[side]
    for value in (np.nan, beyond, 0.5 * np.sign(beyond)):
        c.numbers[name][0] = value
        u = c.step(x)
        assert c.workspace.status == -2 and c.held and bool((u.abs() <= torch.tensor([3.0, 0.5])).all())
        c.numbers[name][...] = before
    c.step(x)
    assert c.status == Status.CONVERGED


def test_rates_whose_horizon_stays_count_from_what_is_given(tmp_path: Path) -> None:
    """As a compiled problem's do: each step is a problem of its own."""
    c = load_c(torchgco.export_c(gentle(), tmp_path, "car", receding=False))
    compiled = torchgco.compile(gentle(), "interior_point")
    for previous in ([0.0, 0.0], [0.3, -0.1], [-0.5, 0.2]):
        answer = compiled(previous=[previous])
        assert torch.equal(c.step(START, previous=previous), answer.u[0])
        assert c.numbers["previous"].tolist() == previous and c.status == Status.CONVERGED
    c = load_c(torchgco.export_c(gentle(), tmp_path, "car", receding=False, changes=["x_ref"]))
    u = torchgco.compile(gentle(), "interior_point")().u[0]
    assert "previous" not in c.numbers and torch.equal(c.step(START), u)


def test_controls_before_always_change_in_a_loop(tmp_path: Path) -> None:
    folder = exported(gentle((0.1, 0.0)), tmp_path, "x_ref")
    c = load_c(folder)
    assert set(c.numbers) == {"x_ref", "previous"} and c.numbers["previous"].tolist() == [0.1, 0.0]
    header, page = ((folder / name).read_text() for name in ("car.h", "README.md"))
    assert "double previous[2]; /* 2: constraints[2].previous, in which each step leaves its u */" in header
    assert "`w.numbers.previous`" in page and "| `previous` | 2 | `constraints[2].previous` | 0.1, 0 |" in page
    u, v = c.step(START), MPC(gentle((0.1, 0.0)), "interior_point").step(START)
    assert torch.equal(u, v)


def test_a_guess_is_gone_on_from(folder: Path) -> None:
    found = torchgco.solve(gentle(), solver="interior_point", verbose=False)
    c = load_c(folder)
    c.guess(found.X[0], found.U[0])
    u = c.step(START)
    assert c.status == Status.CONVERGED and c.workspace.warm and c.workspace.iterations < 15
    torch.testing.assert_close(u, found.U[0, 0], rtol=0, atol=1e-5)
    c.guess(np.full((N + 1, 4), np.nan), found.U[0])
    c.step(START)
    assert c.status == Status.CONVERGED


def several() -> Problem:
    """Three cars with rates and controls before of their own; the second one's steering has none."""
    path = np.stack([reference(), reference(0.5), reference(0.2)])
    cost = QuadraticCost([1, 1, 0.1, 0.1], [0.1, 1], [10, 10, 1, 1], x_ref=path)
    rise: Any = [[0.2, 0.12], [0.3, INF], [0.25, 0.1]]
    rates = RateBounds([[-0.2, -0.1], [-0.3, -INF], [-0.2, -0.2]], rise, previous=[[0.0, 0.0], [0.3, 0.1], [0.2, -0.1]])
    x0: Any = [[0.0, 0, 0, 3.0], [0.0, 0.1, 0, 2.5], [0.1, 0, 0.1, 3.0]]
    return Problem(CAR, cost, [ControlBounds([-3.0, -0.5], [3.0, 0.5]), rates], x0, N)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("which", ["all", "x_ref"])
def test_elements_have_rates_of_their_own(which: str, tmp_path: Path) -> None:
    folder = exported(several(), tmp_path, *([] if which == "all" else ["x_ref"]))
    each, mpc = [load_c(folder, element=b) for b in range(3)], MPC(several(), "interior_point")
    x, draws, rates = several().x0.numpy(), np.random.default_rng(0), rates_of(several().constraints)
    assert rates is not None
    for k in range(12):
        late: Any = {"max_seconds": 1e-9 if k in (4, 5) else INF}
        v = mpc.step(x, **late)
        for b, c in enumerate(each):
            before = c.numbers["previous"].copy()
            u = c.step(x[b], **late)
            assert (k > 3 or torch.equal(u, v[b])) and c.status == mpc.statuses[b], (k, b)
            change = u.numpy() - before
            assert (change <= rates.upper[b].numpy() + 1e-6).all() and (change >= rates.lower[b].numpy() - 1e-6).all()
        assert mpc.answer is not None
        x = mpc.answer.X[:, 1].numpy() + 0.002 * draws.standard_normal(x.shape)


def timed_rates() -> Problem:
    return timed(RateBounds(-1.5, 1.5), segments=2)


def test_a_free_time_has_rates(tmp_path: Path) -> None:
    c, compiled = load_c(exported(timed_rates(), tmp_path)), torchgco.compile(timed_rates(), "interior_point")
    x, draws, u = timed_rates().x0[0].numpy(), np.random.default_rng(1), np.zeros(2)
    answer = compiled(x0=x)
    c.step(x)
    assert c.status == answer.statuses[0] == Status.CONVERGED
    begin_alike(c, compiled)
    c.workspace.period = 0.0
    for k, elapsed in enumerate((0.05, 0.11, 0.0, 0.4, 0.05)):
        x = np.array([np.interp(elapsed, answer.t[0], values) for values in answer.X[0].T])
        x = x + 1e-3 * draws.standard_normal(len(x))
        answer = compiled(x0=x, elapsed=elapsed)
        assert c.raw_step(x, elapsed, INF, u) == int(answer.status[0]) == Status.CONVERGED, k
        assert np.array_equal(u, answer.u[0].numpy()) and torch.equal(c.times, answer.t[0]), k
        assert torch.equal(c.plan[0], answer.X[0]) and c.workspace.iterations == int(answer.iterations[0])


def test_what_a_loop_in_free_time_refuses(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="previous"):
        exported(timed(RateBounds(-1.5, 1.5, previous=0.0)), tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
    torchgco.export_c(timed(RateBounds(-1.5, 1.5, previous=0.0)), tmp_path / "folder", receding=False)


@needs("gcc")
@pytest.mark.slow
@pytest.mark.parametrize("problem", [gentle, KINDS["two links and rates"], several, timed_rates, KINDS["a free start"]])
def test_its_own_test_and_example_pass_without_a_warning(problem: Any, tmp_path: Path) -> None:
    period = 0.06 if problem is several else None
    folder, count = torchgco.export_c(problem(), tmp_path, "car", period=period), 40 * problem().B
    flags = *STRICT, "-O1", "-g", "-march=native", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    said("gcc", *flags, "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(SAME.replace("40", str(count)))
    said("gcc", *flags, "car.c", "car_main.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).count("status 1") >= 19


@needs("gcc")
def test_a_step_takes_at_most_the_stack_that_the_page_says(folder: Path) -> None:
    assert frames(folder, "-Os", DESKTOP) <= STACK


@pytest.mark.slow
@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m7(folder: Path, tmp_path: Path) -> None:
    assert on_board(M7, "-Os", "car.c", "car_test.c", folder=folder, program=tmp_path / "run").startswith(SAME)


@pytest.mark.sampled(1)
@needs("gcc")
@pytest.mark.parametrize("problem", [loose, several])
def test_single_precision(problem: Any, tmp_path: Path) -> None:
    folder = torchgco.export_c(problem(), tmp_path / "c", name="car", dtype=torch.float32)
    said("gcc", *STRICT, "-O1", "-mfma", "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    count = 40 * problem().B
    assert said(tmp_path / "run", folder=folder).startswith(f"{count} of {count} periods have controls within 0.001")
    c, mpc, x = load_c(folder), MPC(problem(), "interior_point"), problem().x0.numpy()
    for k in range(6):
        late: Any = {"max_seconds": 1e-9 if k == 3 else INF}
        u, v = c.step(x[0], **late), mpc.step(x, **late).reshape(-1, 2)[0]
        torch.testing.assert_close(u, v, rtol=0, atol=1e-2)
        assert mpc.answer is not None
        x = mpc.answer.X[:, 1].numpy()


@pytest.mark.slow
@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m4f(tmp_path: Path) -> None:
    folder = torchgco.export_c(loose(), tmp_path / "c", name="car", dtype=torch.float32)
    told = on_board(M4F, "-O2", "car.c", "car_test.c", folder=folder, program=tmp_path / "run")
    assert told.startswith("40 of 40 periods have controls within 0.001")
