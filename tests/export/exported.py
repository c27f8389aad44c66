"""Folders of C, and what compilers and emulators make of them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from torchgco import Problem, export_c
from torchgco.native.compiler import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
ARM = Path(__file__).parent / "arm"
THUMB = "-mfloat-abi=hard", "-mthumb", "-std=gnu99", "-ffp-contract=off", "-fno-math-errno"
M7 = "-mcpu=cortex-m7", "-mfpu=fpv5-d16", *THUMB
M4F = "-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", *THUMB
BOARDS = {M7: "mps2-an500", M4F: "mps2-an386"}  # of QEMU
STRICT = "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fno-math-errno"
SAME = "40 of 40 periods have the same bits, status and iterations; 40 converged; largest difference 0"


def needs(*programs: str) -> Any:
    missing = [program for program in programs if shutil.which(program) is None]
    return pytest.mark.skipif(bool(missing), reason=f"no {', '.join(missing)}: .ci/crosscompilers installs it")


def exported(problem: Problem, folder: Path, *changes: str, name: str = "car") -> Path:
    return export_c(problem, folder, name=name, changes=list(changes) if changes else None)


def said(*words: str | Path, folder: Path) -> str:
    """What a program prints that ends without an error."""
    done = subprocess.run([*map(str, words)], cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout[-2000:]}\n{done.stderr[-3000:]}"
    return done.stdout


def on_board(board: tuple[str, ...], level: str, *files: str, folder: Path, program: Path) -> str:
    """What a program prints on an emulated Cortex-M."""
    words = ARM / "start.c", "-T", ARM / "memory.ld", "-nostartfiles", "--specs=rdimon.specs"
    linked = "-Wl,--no-warn-rwx-segments", "-lm", "-o", program
    said("arm-none-eabi-gcc", *board, level, *files, *words, *linked, folder=folder)
    machine = "-M", BOARDS[board], "-nographic", "-semihosting-config", "enable=on,target=native", "-kernel"
    return said("qemu-system-arm", *machine, program, folder=folder)
