"""Exported C of several elements, each with numbers, bounds and starts of its own: what each would do alone."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import M7, SAME, STRICT, exported, needs, needs_compiler, on_board, said
from tests.export.free import grid, timed
from tests.export.kinds import CAR, N, point, reference
from torchgco import (
    ControlBounds,
    Field,
    FunctionConstraint,
    InputError,
    LoadedController,
    OccupancyGrid,
    Problem,
    QuadraticCost,
    Spheres,
    StateBounds,
    Status,
    load_c,
)

pytestmark = [needs_compiler, pytest.mark.usefixtures("quickly")]
INF = np.inf


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-O1")


def cars(start: float = 0.0) -> Problem:
    """Three cars among discs of their own; the second one has no bound of speed, the third alone one of its place."""
    path = np.stack([reference(), reference(0.5), reference(0.2)])
    cost = QuadraticCost([1, 1, 0.1, 0.1], [0.1, 1], [10, 10, 1, 1], x_ref=path)
    centers = [[[2.5, 0.8], [5.0, -1.0]], [[2.6, -0.8], [9.0, 3.0]], [[2.4, 1.0], [5.0, -1.2]]]
    discs = Spheres(centers, [[0.3, 0.4], [0.35, 0.2], [0.2, 0.3]], [0.2, 0.25, 0.2])
    upper = np.array([[INF, INF, INF, 4.5], [INF, INF, INF, INF], [INF, 2.5, INF, 4.0]])
    bounds = ControlBounds(np.array([[-3.0, -0.5], [-2.0, -0.4], [-3.0, -0.5]]), [3.0, 0.5])
    x0: Any = [[0.0, 0, 0, 3.0], [start, 0.1 - 0.9 * (start > 0), 0, 2.5], [0.1, 0, 0.1, 3.0]]
    return Problem(CAR, cost, [bounds, discs, StateBounds(-INF, upper)], x0, N)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(cars(), tmp_path_factory.mktemp("cars"))


def each(folder: Path) -> list[LoadedController]:
    first = load_c(folder)
    return [load_c(folder, element=b) for b in range(first.elements)]


def test_40_periods_have_the_bits_of_python(folder: Path) -> None:
    controllers, compiled = each(folder), torchgco.compile(cars(), "interior_point", receding=True)
    x, draws = cars().x0.numpy(), np.random.default_rng(0)
    for k in range(40):
        path = np.stack([reference(since + 0.1 * k) for since in (0.0, 0.5, 0.2)])
        answer = compiled(x0=x, x_ref=path)
        for b, c in enumerate(controllers):
            c.step(x[b], x_ref=path[b])
            assert c.status == answer.statuses[b] == Status.CONVERGED and torch.equal(c.plan[1], answer.U[b]), (k, b)
            assert torch.equal(c.plan[0], answer.X[b]) and c.workspace.iterations == int(answer.iterations[b])
        x = answer.X[:, 1].numpy() + 0.003 * draws.standard_normal(x.shape)


def absent() -> Problem:
    """One disc for the first point, two for the second."""
    centers: Any = [[[0.0, 0.4], [np.nan, np.nan]], [[0.1, -0.3], [0.9, 0.6]]]
    return points([Spheres(centers, [[0.3, np.nan], [0.2, 0.2]], 0.1)])


def points(parts: list[Any], **more: Any) -> Problem:
    one = point()
    x0: Any = [[-1.0, 0, 0, 0], [-0.8, 0.1, 0.2, 0]]
    return Problem(one.dynamics, one.cost, [ControlBounds(-8.0, 8.0), *parts], x0, N, **more)


def maps() -> Problem:
    cells = grid().occupied
    return points([Field(OccupancyGrid(np.stack((cells, np.roll(cells, 4, 1))), [-2.0, -2.2], 0.1), 0.1)])


def rows() -> Problem:
    width = torch.tensor([[0.5], [0.7]], dtype=torch.float64)
    return points([FunctionConstraint(lambda x, width: x[..., 1:2].square() - width.square(), values={"width": width})])


KINDS = {
    "absent discs": absent,
    "maps": maps,
    "rows of values": rows,
    "free starts": lambda: points([], free_start=[[False, True, True, False], [False, False, False, False]]),
    "free times": lambda: timed(Spheres([[0.5, 0.3]], [0.3], 0.1), x0=[[-1.0, 0, 0, 0], [-0.8, 0.1, 0, 0]]),
}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", KINDS)
def test_elements_of_every_kind_have_the_bits_of_python(kind: str, tmp_path: Path) -> None:
    problem = KINDS[kind]()
    folder = exported(problem, tmp_path)
    compiled = torchgco.compile(problem, "interior_point", receding=problem.time is None)
    controllers, x, draws = each(folder), problem.x0.numpy(), np.random.default_rng(0)
    for k in range(6):
        moved = {} if problem.time is None else {"elapsed": 0.05 * (k > 0)}
        answer, u = compiled(x0=x, **moved), np.zeros(problem.m)
        for b, c in enumerate(controllers):
            if problem.time is None:
                c.raw_step(x[b], float(k > 0), np.inf, u)
            else:
                c.workspace.period = 0.0
                c.raw_step(x[b], 0.05 * (k > 0), np.inf, u)
                if k == 0:
                    copy_iterate(c, compiled._kept, b)
                    continue
            assert np.array_equal(u, answer.u[b].numpy()) and c.status == answer.statuses[b] == Status.CONVERGED, (k, b)
            assert c.workspace.iterations == int(answer.iterations[b])
        x = answer.X[:, 1].numpy() + 1e-3 * draws.standard_normal(x.shape)
        if problem.time is not None:
            assert answer.t is not None
            near = zip(answer.t, answer.X, strict=True)
            x = np.array([[np.interp(0.05, t, values) for values in X.T] for t, X in near])


def copy_iterate(c: LoadedController, kept: Any, b: int) -> None:
    lam = torch.cat([part[b].flatten() for part in kept.lam])
    for name, values in (("x", kept.X[b]), ("u", kept.U[b]), ("lam", lam)):
        getattr(c.workspace, name)[:] = values.flatten().tolist()


def test_elements_are_those_of_problems_alone(folder: Path, tmp_path: Path) -> None:
    for b, c in enumerate(each(folder)):
        alone = load_c(exported(cars().take(slice(b, b + 1)), tmp_path / str(b)))
        x = cars().x0[b].numpy()
        for _ in range(3):
            assert torch.equal(c.step(x), alone.step(x)) and c.elements == 3 and alone.elements == 1
            x = c.plan[0][1].numpy()


def test_workspaces_know_nothing_of_each_other(folder: Path) -> None:
    """Interleaved steps are those of controllers alone, and numbers are a workspace's own."""
    order, x = [0, 2, 1, 1, 2, 0, 0, 1, 2, 2], cars().x0.numpy()
    controllers, alone = each(folder), each(folder)
    together = [(b, controllers[b].step(x[b])) for b in order]
    for b in range(3):
        assert all(torch.equal(u, alone[b].step(x[b])) for at, u in together if at == b)
    first, second = controllers[:2]
    assert not np.array_equal(first.numbers["x_ref"], second.numbers["x_ref"])
    first.step(x[0], x_ref=second.numbers["x_ref"])
    assert torch.equal(second.step(x[1]), alone[1].step(x[1]))
    first.reset()
    assert np.array_equal(first.numbers["x_ref"], second.numbers["x_ref"])


def test_bounds_that_an_element_lacks_stay_away(folder: Path) -> None:
    controllers, x = each(folder), cars().x0.numpy()
    name = "constraints_2_upper"
    assert [float(c.numbers[name][3]) for c in controllers] == [4.5, INF, 4.0]
    for c, state, status in zip(controllers, x, (1, -2, 1), strict=True):
        c.numbers[name][3] = 4.2
        c.step(state)
        assert c.workspace.status == status


@pytest.mark.filterwarnings("ignore::torchgco.StartWarning")
def test_a_bad_element_keeps_its_status_to_itself(folder: Path, tmp_path: Path) -> None:
    """The second car stands in a disc: the folder's test has no periods of it, and the others step as before."""
    bad = exported(cars(start=2.6), tmp_path)
    x, others = cars(start=2.6).x0.numpy(), each(folder)
    for b, c in enumerate(each(bad)):
        u = c.step(x[b])
        assert c.held == (b == 1) and c.status == (Status.INVALID_START if b == 1 else Status.CONVERGED)
        assert b == 1 or torch.equal(u, others[b].step(x[b]))
    assert "#define PERIODS 80" in (bad / "car_test.c").read_text()


@pytest.mark.parametrize("element", [-1, 3, 7, True, "0"])
def test_an_element_that_is_not_there(folder: Path, element: Any) -> None:
    with pytest.raises(InputError, match="element"):
        load_c(folder, element=element)
    if isinstance(element, int) and element is not True:
        c, u = load_c(folder), np.zeros(2)
        c._functions["init"](ctypes.byref(c.workspace), ctypes.c_int(element))
        assert c.raw_step(cars().x0[0].numpy(), 1.0, INF, u) == -2 and c.held and np.isfinite(u).all()


@needs("gcc")
@pytest.mark.slow
def test_its_own_test_and_example_pass_without_a_warning(folder: Path, tmp_path: Path) -> None:
    flags = *STRICT, "-O1", "-g", "-march=native", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    said("gcc", *flags, "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(SAME.replace("40", "120"))
    said("gcc", *flags, "car.c", "car_main.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).count("status 1") == 20


@pytest.mark.slow
@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m7(folder: Path, tmp_path: Path) -> None:
    told = on_board(M7, "-Os", "car.c", "car_test.c", folder=folder, program=tmp_path / "run")
    assert told.startswith(SAME.replace("40", "120"))


@pytest.mark.slow
@needs("gcc")
def test_single_precision(tmp_path: Path) -> None:
    folder = torchgco.export_c(cars(), tmp_path / "c", name="car", dtype=torch.float32)
    said("gcc", *STRICT, "-O1", "-mfma", "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith("120 of 120 periods have controls within 0.001")
    for b, c in enumerate(each(folder)):
        u = c.step(cars().x0[b])
        torch.testing.assert_close(u, torchgco.compile(cars(), "interior_point")().u[b], rtol=0, atol=2e-2)


@pytest.mark.parametrize("value", [0.0, 0.5])
def test_constants_of_a_workspace_are_those_that_were_exported(value: float, tmp_path: Path) -> None:
    """gcc 12.2 with AVX-512 copies a constant array {5, 5, 0, 0} as {5, 5, 5, 5}."""
    one = point()
    cost = QuadraticCost([1.0, 1, value, value], [0.1, 0.1], [5.0, 5, value, value], x_ref=[1.5, 0.3, 0, 0])
    problem = Problem(one.dynamics, cost, [ControlBounds(-8.0, 8.0)], one.x0, N)
    c = load_c(exported(problem, tmp_path))
    assert c.numbers["Qf"].ravel().tolist() == [5.0, 5.0, value, value]
    assert torch.equal(c.step(problem.x0[0]), torchgco.compile(problem, "interior_point")().u[0])
