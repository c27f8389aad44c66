"""Exported C with a free time: the bits of `compile` and `MPC` from an iterate on, and what it does beside a search."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import M7, SAME, STRICT, exported, needs, needs_compiler, on_board, said
from tests.export.free import TIMES, timed
from tests.slow import mostly
from torchgco import (
    ControlBounds,
    FreeTime,
    InputError,
    Integral,
    LoadedController,
    Problem,
    QuadraticCost,
    RateBounds,
    Status,
    load_c,
)

pytestmark = [
    needs_compiler,
    pytest.mark.usefixtures("quickly"),
    pytest.mark.filterwarnings("ignore::torchgco.ContactWarning", "ignore::torchgco.HorizonWarning"),
]
H = 0.06  # s, of a period


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-O1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(TIMES["discs"](), tmp_path_factory.mktemp("timed"))


def begin_alike(c: LoadedController, compiled: Any) -> None:
    """Give C the iterate of Python: the first solve of a free time is a search there, and from a plan here."""
    kept, w = compiled._kept, c.workspace
    lam = torch.cat([part.flatten() for part in kept.lam])
    for name, values in (("x", kept.X), ("u", kept.U), ("lam", lam)):
        getattr(w, name)[:] = values.flatten().tolist()
    w.able = w.begun = 1


def plant(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A point after a period."""
    d = len(u)
    return np.concatenate((x[:d] + H * x[d:] + 0.5 * H * H * u, x[d:] + H * u))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("push", [0.0, 0.01])
def test_40_periods_have_the_bits_of_mpc(folder: Path, push: float) -> None:
    c, mpc = load_c(folder, period=H), torchgco.MPC(TIMES["discs"](), "interior_point", H, max_seconds=float("inf"))
    x, draws, warm = np.array([-1.0, 0.0, 0.0, 0.0]), np.random.default_rng(0), 0
    for k in range(40):
        v, u = mpc.step(x), c.step(x)
        assert mpc.answer is not None and mpc.answer.t is not None and c.status == mpc.statuses[0] == Status.CONVERGED
        if bool(mpc.answer.warm[0]):
            warm += 1
            assert torch.equal(u, v) and torch.equal(c.times, mpc.answer.t[0]), k
            assert torch.equal(c.plan[0], mpc.answer.X[0]) and torch.equal(c.plan[2], mpc.answer.K[0])
            assert c.workspace.iterations == int(mpc.answer.iterations[0]) and c.workspace.warm and not c.held
        else:
            torch.testing.assert_close(c.times[-1], mpc.answer.t[0, -1], rtol=0, atol=1e-5)
            begin_alike(c, mpc.compiled)
        x = plant(x, v.numpy()) + push * draws.standard_normal(4)
    assert warm >= 37


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", mostly(TIMES, *(set(TIMES) - {"a goal", "segments", "moving discs"})))
def test_steps_have_the_bits_of_python(kind: str, tmp_path: Path) -> None:
    """Of a call, whose controls are those of the first stage."""
    problem = TIMES[kind]()
    c, compiled = load_c(exported(problem, tmp_path)), torchgco.compile(problem, "interior_point")
    x, draws, u = problem.x0[0].numpy(), np.random.default_rng(1), np.zeros(problem.m)
    answer = compiled(x0=x)
    c.step(x)
    assert c.status == answer.statuses[0] == Status.CONVERGED
    assert float(c.times[-1]) <= float(answer.t[0, -1]) + 1e-5
    begin_alike(c, compiled)
    c.workspace.period = 0.0
    for k, elapsed in enumerate((0.05, 0.11, 0.0, 0.4, 0.05)):
        x = np.array([np.interp(elapsed, answer.t[0], values) for values in answer.X[0].T])
        x = x + 1e-3 * draws.standard_normal(len(x))
        answer = compiled(x0=x, elapsed=elapsed)
        assert c.raw_step(x, elapsed, np.inf, u) == int(answer.status[0]) == Status.CONVERGED, k
        assert np.array_equal(u, answer.u[0].numpy()) and torch.equal(c.times, answer.t[0]), k
        assert torch.equal(c.plan[0], answer.X[0]) and c.workspace.iterations == int(answer.iterations[0])


@pytest.mark.parametrize("seed", range(3))
def test_numbers_change_between_steps_as_in_python(folder: Path, seed: int) -> None:
    problem, draws = TIMES["discs"](), np.random.default_rng(seed)
    c, compiled = load_c(folder), torchgco.compile(problem, "interior_point")
    x = problem.x0[0].numpy()
    compiled(x0=x)
    c.step(x)
    begin_alike(c, compiled)
    shares = {"state": 0.05, "centers": 0.05, "radii": 0.05, "R": 0.5, "least": 0.2, "most": 0.1}
    assert set(shares) < set(c.numbers) and "weight" not in c.numbers
    for name, share in shares.items():
        new = c.numbers[name] * (1.0 + share * draws.uniform(-1.0, 1.0, c.numbers[name].shape))
        answer, u = compiled(numbers={name: new[None]}), np.zeros(2)
        c.numbers[name][...] = new
        c.workspace.period = 0.0
        c.raw_step(x, 0.0, np.inf, u)
        assert answer.statuses == [Status.CONVERGED] and np.array_equal(u, answer.u[0].numpy()), name
        assert torch.equal(c.times, answer.t[0]) and c.workspace.iterations == int(answer.iterations[0]), name


def test_references_change_up_to_the_last_knot(tmp_path: Path) -> None:
    one = timed()
    cost = QuadraticCost([0.1] * 4, [0.02] * 2, [5.0] * 4, x_ref=[2.0, 0.3, 0.0, 0.0])
    problem = Problem(one.dynamics, cost, [ControlBounds(-2.0, 2.0)], one.x0, one.N, time=FreeTime(0.2, 4.0, 1.0))
    c, compiled, u = load_c(exported(problem, tmp_path)), torchgco.compile(problem, "interior_point"), np.zeros(2)
    x = problem.x0[0].numpy()
    compiled(x0=x)
    c.step(x)
    begin_alike(c, compiled)
    c.workspace.period = 0.0
    c.numbers["x_ref"][...] += [0.0, 0.2, 0.0, 0.0]
    answer = compiled(x_ref=c.numbers["x_ref"][None])
    assert c.raw_step(x, 0.0, np.inf, u) == int(answer.status[0]) == Status.CONVERGED
    assert torch.equal(c.plan[0], answer.X[0]) and torch.equal(c.times, answer.t[0])


@pytest.mark.parametrize("name", ["least", "most"])
def test_bounds_of_time_that_cross_are_refused(folder: Path, name: str) -> None:
    c, x = load_c(folder), np.array([-1.0, 0.0, 0.0, 0.0])
    c.step(x)
    for value in ({"least": 5.0, "most": 0.1}[name], np.nan, -1.0, 0.0):
        before = float(c.numbers[name][0])
        c.numbers[name][...] = value
        c.step(x)
        assert c.workspace.status == -2 and c.held
        c.numbers[name][...] = before
    c.step(x)
    assert c.status == Status.CONVERGED


def test_numbers_are_the_same_at_all_stages(folder: Path) -> None:
    """As in Python: what a stage's number is for, if stages have no times of their own, isn't known."""
    c, x = load_c(folder), np.array([-1.0, 0.0, 0.0, 0.0])
    c.numbers["u_ref"][:, 1] = 0.1
    c.step(x)
    assert c.status == Status.CONVERGED
    c.numbers["u_ref"][4, 1] = 0.2
    c.step(x)
    assert c.workspace.status == -2 and c.held
    c.numbers["u_ref"][4, 1] = 0.1
    c.numbers["R"][...] = -1.0
    c.step(x)
    assert c.workspace.status == -2


def test_a_late_step_flies_on_with_feedback(folder: Path) -> None:
    """The plan's means over the period, and feedback on what differs from the model's states then."""
    c, x = load_c(folder, period=H), np.array([-1.0, 0.0, 0.0, 0.0])
    c.step(x)
    (X, U, K), t = c.plan, c.times
    model = TIMES["discs"]()
    plan = torchgco.receding.plan.Plan(
        X=X[None], U=U[None], K=K[None], start=torch.zeros(1, dtype=torch.float64), dt=0.2, dynamics=model.dynamics,
        bounds=model.control_bounds, knots=t[None],
    )  # fmt: skip
    for k in range(1, 60):
        state = plan.at(k * H).x[0].numpy() + np.array([0.01, -0.02, 0.0, 0.01])
        u = c.step(state, max_seconds=1e-9)
        assert c.held and c.status == Status.TIME_LIMIT and c.workspace.age == pytest.approx(k * H)
        torch.testing.assert_close(u, plan.mean(k * H, H, state)[0], rtol=0, atol=1e-9)
    c.step(X[-1])
    assert c.status == Status.CONVERGED and not c.held


@pytest.mark.parametrize("times", [0.0, np.nan, -1.0, 1e6, np.inf])
def test_a_guess_of_a_wrong_time_does_no_harm(folder: Path, times: float) -> None:
    c, problem = load_c(folder), TIMES["discs"]()
    found = torchgco.solve(problem, solver="interior_point", verbose=False)
    assert found.times is not None
    c.guess(found.X[0], found.U[0], times * np.arange(1.0, 14.0))
    c.step(problem.x0[0])  # perhaps past the other side of the disc
    assert c.status == Status.CONVERGED and float(c.times[-1]) == pytest.approx(float(found.times[0, -1]), rel=0.01)
    with pytest.raises(InputError, match="times"):
        c.guess(found.X[0], found.U[0])
    c.guess(found.X[0], found.U[0], found.times[0])
    u = c.step(problem.x0[0])
    torch.testing.assert_close(u, torchgco.receding.plan.Plan.mean(flown(c, problem), 0.0, 0.2)[0])
    assert c.workspace.iterations < 20


def flown(c: LoadedController, problem: Any) -> torchgco.receding.plan.Plan:
    X, U, K = (part[None] for part in c.plan)
    start = torch.zeros(1, dtype=torch.float64)
    return torchgco.receding.plan.Plan(
        X=X, U=U, K=K, start=start, dt=0.2, dynamics=problem.dynamics, knots=c.times[None]
    )


@pytest.mark.slow
@pytest.mark.parametrize("push", [0.02, 0.05])
@pytest.mark.parametrize("kind", ["discs", "boxes", "segments"])
def test_a_pushed_point_arrives_as_with_mpc(kind: str, push: float, tmp_path: Path) -> None:
    """Where a push asks for another way, as past the goal and back, C holds the time first and then frees it."""
    problem = TIMES[kind]()
    c, mpc = load_c(exported(problem, tmp_path), period=H), torchgco.MPC(problem, "interior_point", H, max_seconds=1e9)
    x = y = problem.x0[0].numpy()
    draws, held = np.random.default_rng(0), 0
    for k in range(70):
        u, v = c.step(x).numpy(), mpc.step(y).numpy()
        held += c.held
        noise = push * draws.standard_normal(4) * (k < 30)
        x, y = plant(x, u) + noise, plant(y, v) + noise
    assert held == 0 and np.abs(x - y).max() < 1e-3 and np.abs(x - [2.0, 0.3, 0.0, 0.0]).max() < 2e-3


def test_without_a_plan_it_finds_the_time_from_rest(folder: Path, tmp_path: Path) -> None:
    """From states that are far from the exported start; from inside a disc there is no plan."""
    c = load_c(exported(timed(), tmp_path))
    for x0 in ([-1.0, -0.8, 0.3, 0.0], [-0.5, 0.9, 0.0, -0.4], [1.5, -0.5, 0.0, 0.0], [1.9, 0.3, 1.5, 0.0]):
        c.reset()
        c.workspace.able = 0
        c.step(x0)
        found = torchgco.solve(timed(x0=x0), solver="interior_point", verbose=False)
        assert found.times is not None and c.status == found.statuses[0] == Status.CONVERGED
        assert float(c.times[-1]) == pytest.approx(float(found.times[0, -1]), abs=1e-5)
    c = load_c(folder)
    c.step([0.5, 0.3, 0.0, 0.0])
    assert c.status == Status.INVALID_START and c.held


def test_a_goal_that_no_time_allows_is_held_at_rest(tmp_path: Path) -> None:
    """There is no plan to begin with, and the folder's test has no periods; once there is time enough, it flies."""
    folder = exported(timed(most=0.25), tmp_path)
    assert "#define PERIODS 0" in (folder / "car_test.c").read_text()
    c, x = load_c(folder), np.array([-1.0, 0.0, 0.0, 0.0])
    for _ in range(2):
        u = c.step(x)
        assert (
            c.held and c.status not in (Status.CONVERGED, Status.FEASIBLE) and torch.equal(u, torch.zeros(2).double())
        )
    c.step(x, most=[4.0])
    assert c.status == Status.CONVERGED and not c.held
    found = torchgco.solve(timed(), solver="interior_point", verbose=False)
    assert found.times is not None and float(c.times[-1]) == pytest.approx(float(found.times[0, -1]), abs=1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_state_is_no_step(folder: Path, bad: float) -> None:
    c, x, u = load_c(folder, period=0.0001), np.array([-1.0, 0.0, 0.0, 0.0]), np.zeros(2)
    assert c.raw_step(np.array([bad, 0, 0, 0]), 0.0, np.inf, u) == -1 and np.array_equal(u, [0.0, 0.0]) and c.held
    c.step(x)
    U = c.plan[1]
    assert c.raw_step(np.array([0, bad, 0, 0]), 0.1, np.inf, u) == -1 and c.held
    np.testing.assert_allclose(u, U[0].numpy(), rtol=0, atol=1e-12)
    assert c.raw_step(x, -1.0, np.inf, u) == -1 and c.raw_step(x, bad, np.inf, u) == -1
    assert c.raw_step(x, 1e9, np.inf, u) == Status.CONVERGED, "long after the plan has ended"


@pytest.mark.parametrize(
    ("parts", "options", "told"),
    [
        ((RateBounds(-1.0, 1.0, previous=0.0),), {}, "rate_bounds.previous"),
        ((Integral(lambda x, u: u.square().sum(-1), most=3.0),), {}, "Integral"),
        ((torchgco.Gates([[0.5, 0.2]], radius=0.3),), {}, "Gates"),
        ((), {"changes": ["weight"]}, "time.weight"),
    ],
)
def test_what_cannot_go_is_refused_by_name(parts: tuple[Any, ...], options: Any, told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=told):
        torchgco.export_c(timed(*parts), tmp_path / "folder", **options)
    assert not (tmp_path / "folder").exists()


@needs("gcc")
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["discs", "segments", "a path"])
def test_its_own_test_and_example_pass_without_a_warning(kind: str, tmp_path: Path) -> None:
    folder = exported(TIMES[kind](), tmp_path)
    flags = *STRICT, "-O1", "-g", "-march=native", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    said("gcc", *flags, "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(SAME)
    said("gcc", *flags, "car.c", "car_main.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).count("status 1") >= 19


@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m7(folder: Path, tmp_path: Path) -> None:
    assert on_board(M7, "-Os", "car.c", "car_test.c", folder=folder, program=tmp_path / "run").startswith(SAME)


@needs("gcc")
def test_single_precision(tmp_path: Path) -> None:
    problem = TIMES["discs"]()
    folder = torchgco.export_c(problem, tmp_path / "c", name="car", dtype=torch.float32)
    said("gcc", *STRICT, "-O1", "-mfma", "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith("40 of 40 periods have controls within 0.001")
    c, found = load_c(folder), torchgco.solve(problem, solver="interior_point", verbose=False)
    c.step(problem.x0[0])
    assert found.times is not None and float(c.times[-1]) == pytest.approx(float(found.times[0, -1]), abs=1e-3)
