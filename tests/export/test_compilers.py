"""Exported C by all compilers, at all levels, on other processors: the same bits, no heap, no warning, no growth."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.export.exported import M7, SAME, STRICT, exported, needs, needs_compiler, on_board, said
from tests.export.kinds import KINDS, car
from tests.slow import mostly
from torchgco import Spheres, StateBounds

pytestmark = needs_compiler
NATIVE = "-march=native"
# Bytes of text of gcc 12 -Os and of the workspace on 64 bits, by problem: a page of results has more.
SIZES = {"bounds": (51_534, 27_016), "discs": (53_841, 23_120)}
GROWTH = 1.05


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    problem = car(Spheres([[2.5, 0.6], [6.0, -1.0]], [0.3, 0.4], 0.2), StateBounds(-10.0, 10.0, knots=[4, 9]))
    return exported(problem, tmp_path_factory.mktemp("car"), "x_ref", "centers")


@pytest.mark.sampled(1)
@needs("gcc")
@pytest.mark.parametrize("level", mostly(["-O0", "-O1", "-O2", "-O3", "-Os"], "-O1", "-O3"))
def test_levels_of_gcc(folder: Path, tmp_path: Path, level: str) -> None:
    said("gcc", *STRICT, level, NATIVE, "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(SAME)


@pytest.mark.slow
@needs("gcc")
def test_fused_by_the_library_where_the_processor_is_not_told(folder: Path, tmp_path: Path) -> None:
    said("gcc", *STRICT, "-O2", "-DTGCO_FUSED", "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(SAME)


@needs("clang")
@pytest.mark.parametrize("level", mostly(["-O0", "-O3"], "-O3"))
def test_clang(folder: Path, tmp_path: Path, level: str) -> None:
    said("clang", *STRICT, level, NATIVE, "car.c", "car_test.c", "-lm", "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).startswith(SAME)


@pytest.mark.slow
@needs("gcc", "g++")
def test_the_header_serves_c_plus_plus(folder: Path, tmp_path: Path) -> None:
    said("gcc", *STRICT, "-O1", "-c", "car.c", "-o", tmp_path / "car.o", folder=folder)
    words = "-Wall", "-Wextra", "-Werror", "-x", "c++", "car_main.c", "-x", "none", tmp_path / "car.o", "-lm"
    said("g++", *words, "-o", tmp_path / "run", folder=folder)
    assert said(tmp_path / "run", folder=folder).count("status 1") == 20


@pytest.mark.slow
@needs("gcc")
def test_sanitizers_find_nothing(folder: Path, tmp_path: Path) -> None:
    checks = "-fsanitize=address,undefined", "-fno-sanitize-recover=all"
    said(
        "gcc",
        *STRICT,
        "-O1",
        "-g",
        NATIVE,
        *checks,
        "car.c",
        "car_test.c",
        "-lm",
        "-o",
        tmp_path / "run",
        folder=folder,
    )
    assert said(tmp_path / "run", folder=folder).startswith(SAME)


@pytest.mark.slow
@needs("gcc", "nm")
def test_no_heap_no_state_and_four_names(folder: Path, tmp_path: Path) -> None:
    said("gcc", *STRICT, "-O2", NATIVE, "-c", "car.c", "-o", tmp_path / "car.o", folder=folder)
    symbols = re.findall(r"(\w) (\w+)$", said("nm", tmp_path / "car.o", folder=folder), re.MULTILINE)
    assert {name for kind, name in symbols if kind in "TDBCG"} == {
        f"car_{word}" for word in ("init", "step", "guess", "reset")
    }
    assert not [name for kind, name in symbols if kind.lower() in "dbcs"]  # variables
    needed = {name for kind, name in symbols if kind == "U"} - {"_GLOBAL_OFFSET_TABLE_"}
    assert needed <= {"memcpy", "memset", "memmove", "cos", "sin", "tan", "log", "pow", "floor", "fma", "sqrt"}
    text = (folder / "car.c").read_text()
    own = text[: text.index('#include "car.h"')] + text.split("#endif\n", 3)[3]
    assert not re.search(
        r"__builtin|__attribute__|vector_size|__typeof__|malloc|calloc|aligned_alloc|clock_gettime", own
    )


@pytest.mark.sampled(1)
@needs("gcc", "size")
@pytest.mark.parametrize("kind", SIZES)
def test_sizes_do_not_grow(kind: str, tmp_path: Path) -> None:
    version = subprocess.run(["gcc", "-dumpversion"], capture_output=True, text=True).stdout.strip()
    if not version.startswith("12"):
        pytest.skip(f"sizes of gcc 12, not {version}")
    folder = exported(KINDS[kind](), tmp_path)
    said("gcc", *STRICT, "-Os", "-mfma", "-c", "car.c", "-o", "car.o", folder=folder)
    text = int(said("size", "car.o", folder=folder).splitlines()[1].split()[0])
    (tmp_path / "size.c").write_text('#include "car.h"\nint size[sizeof(car_workspace)];\n')
    said("gcc", "-c", "size.c", "-o", "size.o", folder=folder)
    workspace = int(said("size", "size.o", folder=folder).splitlines()[1].split()[2]) // 4
    assert text <= GROWTH * SIZES[kind][0] and workspace <= GROWTH * SIZES[kind][1], (text, workspace)
    (told,) = re.findall(r"car_workspace \| ([\d,]+)", (folder / "README.md").read_text())
    assert 0 <= int(told.replace(",", "")) - workspace <= 64


@pytest.mark.slow
@needs("cmake", "gcc")
def test_its_folder_builds_by_cmake(folder: Path, tmp_path: Path) -> None:
    said("cmake", "-S", folder, "-B", tmp_path / "build", folder=folder)
    said("cmake", "--build", tmp_path / "build", folder=folder)
    assert "100% tests passed" in said("ctest", "--test-dir", tmp_path / "build", folder=folder)


@pytest.mark.slow
@needs("aarch64-linux-gnu-gcc", "qemu-aarch64")
def test_a_64_bit_arm(folder: Path, tmp_path: Path) -> None:
    words = *STRICT, "-O2", "-static", "car.c", "car_test.c", "-lm", "-o", tmp_path / "run"
    said("aarch64-linux-gnu-gcc", *words, folder=folder)
    assert said("qemu-aarch64", tmp_path / "run", folder=folder).startswith(SAME)


@needs("arm-none-eabi-gcc", "qemu-system-arm")
def test_a_cortex_m7(folder: Path, tmp_path: Path) -> None:
    assert on_board(M7, "-Os", "car.c", "car_test.c", folder=folder, program=tmp_path / "run").startswith(SAME)


@pytest.mark.slow
def test_windows_by_zig(folder: Path, tmp_path: Path) -> None:
    ziglang = pytest.importorskip("ziglang")
    zig = Path(ziglang.__file__).parent / "zig"
    flags = "-std=c99", "-O2", "-ffp-contract=off", "-target", "x86_64-windows-gnu"
    said(zig, "cc", *flags, "car.c", "car_test.c", "-o", tmp_path / "run.exe", folder=folder)
