"""Exported C in single precision: the same plans but for 1e-3, in as many iterations, without doubles but for times."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import M4F, STRICT, needs, needs_compiler, on_board, said
from tests.export.kinds import KINDS, START, car
from tests.slow import mostly
from torchgco import InputError, Spheres, StateBounds, Status, export_c, load_c
from torchgco.export.single import single
from torchgco.export.source import structure_numbers

pytestmark = [needs_compiler, pytest.mark.usefixtures("quickly")]
NEAR = "40 of 40 periods have controls within 0.001 of their range; 40 converged"
FIRST, WARM = 3e-3, 1e-3  # of the range of controls: by which a first, and a warm step, may differ


@pytest.fixture
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-O1")


def discs() -> Any:
    return car(Spheres([[2.5, 0.6], [6.0, -1.0]], [0.3, 0.4], 0.2), StateBounds(-10.0, 10.0, knots=[4, 9]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export_c(discs(), tmp_path_factory.mktemp("car"), name="car", changes=["x_ref"], dtype=torch.float32)


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning", "ignore::torchgco.HorizonWarning")
@pytest.mark.parametrize("kind", mostly(KINDS, *(set(KINDS) - {"discs", "a function"})))
def test_steps_are_those_of_python_but_for_rounding(kind: str, tmp_path: Path) -> None:
    problem = KINDS[kind]()
    c = load_c(export_c(problem, tmp_path, name="car", dtype=torch.float32))
    compiled = torchgco.compile(problem, "interior_point", receding=True)
    x, draws, made, known = problem.x0[0].numpy().copy(), np.random.default_rng(1), 0, 0
    for k in range(6):
        answer, u = compiled(x0=x), c.step(x)
        size = float(np.ptp(answer.U[0].numpy(), axis=0).max())
        assert c.status == Status.CONVERGED and u.dtype == torch.float64
        assert float((u - answer.u[0]).abs().max()) <= (WARM if k else FIRST) * max(size, 0.1), k
        made, known = made + c.workspace.iterations, known + int(answer.iterations[0])
        x = answer.X[0, 1].numpy() + 1e-3 * draws.standard_normal(len(x))
    assert made <= 1.7 * known  # of all kinds together 1.01


def test_it_takes_half_of_the_memory(folder: Path, tmp_path: Path) -> None:
    double = export_c(discs(), tmp_path, name="car", changes=["x_ref"])
    sizes = [re.search(r"car_workspace \| ([\d,]+)", (one / "README.md").read_text()) for one in (folder, double)]
    half, whole = (int(size[1].replace(",", "")) for size in sizes if size)
    other = 8 * structure_numbers(len(discs().constraints)) + 64  # bytes of counters, pointers and times, in either
    assert 0.5 * whole < half <= 0.5 * (whole + other) + 8
    header = (folder / "car.h").read_text()
    assert "all numbers are floats" in header and "double (*clock)(void)" in header and "double max_seconds" in header


@needs("gcc", "nm")
def test_no_double_is_computed_with(folder: Path, tmp_path: Path) -> None:
    """But times; functions of libm are those of floats."""
    words = *STRICT, "-Wdouble-promotion", "-O1", "-mfma"
    said("gcc", *words, "-c", "car.c", "-o", tmp_path / "car.o", folder=folder)
    needed = set(re.findall(r"U (\w+)$", said("nm", tmp_path / "car.o", folder=folder), re.MULTILINE))
    needed -= {"memcpy", "memset", "memmove", "_GLOBAL_OFFSET_TABLE_"}
    assert needed <= {"cosf", "sinf", "tanf", "logf", "powf", "floorf", "sqrtf"}


@pytest.mark.sampled(1)
@needs("gcc")
@pytest.mark.parametrize("level", ["-O0", "-O3"])
def test_its_own_test_passes(folder: Path, tmp_path: Path, level: str) -> None:
    said("gcc", *STRICT, level, "-mfma", "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(NEAR)


@pytest.mark.slow
@needs("gcc")
def test_sanitizers_find_nothing(folder: Path, tmp_path: Path) -> None:
    checks = "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-O1", "-mfma"
    said("gcc", *STRICT, *checks, "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(NEAR)


@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m4f(folder: Path, tmp_path: Path) -> None:
    """Whose unit has no doubles."""
    told = on_board(M4F, "-O2", "car.c", "car_test.c", folder=folder, program=tmp_path / "run")
    assert told.startswith(NEAR)


def test_the_horizon_moves_on_between_steps(folder: Path) -> None:
    """By constants that C has as hexadecimal numbers."""
    c, other, u = load_c(folder), load_c(folder), np.zeros(2, np.float32)
    assert c.period == c.dt == 0.1
    for moved in (0.0, 1.0):
        other.raw_step(np.array(START, np.float32), moved, np.inf, u)
        assert np.array_equal(c.step(START).numpy(), u)


def test_guesses_numbers_and_held_plans_are_floats_too(folder: Path) -> None:
    c, problem = load_c(folder), discs()
    found = torchgco.solve(problem, solver="interior_point", verbose=False)
    c.guess(found.X[0], found.U[0])
    u = c.step(START)
    torch.testing.assert_close(u, found.U[0, 0], rtol=0, atol=1e-2)
    assert c.numbers["x_ref"].dtype == np.float32 and all(part.dtype == torch.float64 for part in c.plan)
    u = c.step(c.plan[0][1], max_seconds=1e-9, x_ref=c.numbers["x_ref"] + 0.01)
    assert c.held and c.status == Status.TIME_LIMIT and bool(torch.isfinite(u).all())


@pytest.mark.parametrize("dtype", [torch.float16, torch.int32, "float32", None])
def test_other_types_are_refused(dtype: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="dtype"):
        export_c(discs(), tmp_path / "folder", dtype=dtype)
    assert not (tmp_path / "folder").exists()


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("double a = 0.1;", "float a = 0x1.99999a0000000p-4f;"),
        ("x = 1e300 * -1e-300;", "x = INFINITY * -0x0.0p+0f;"),
        ("y = 0x1.8p+52 + 3 * a[2];", "y = 0x1.8000000000000p+52f + 3 * a[2];"),
        ("z = fabs(x) + tgco_fabs(x) + TGCO_MATH(pow)(x, y);", "z = fabsf(x) + tgco_fabs(x) + TGCO_MATH(pow)(x, y);"),
        ("double (*clock)(void); double max_seconds, u[2]; double room[3];",) * 2,
        ('/* double 0.5 fabs(x) */ f("double 0.5");',) * 2,
        ("const double x[NX], double stages", "const float x[NX], float stages"),
        ("size_t n = sizeof(double) * 0x1F + 7;",) * 2,
        ("float f = TGCO_IS_DOUBLE_double + x1.y;",) * 2,
    ],
)  # fmt: skip
def test_text_in_single_precision(text: str, wanted: str) -> None:
    assert single(text) == wanted
