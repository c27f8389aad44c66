"""export_c: a folder of C for a compiled problem."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch

from torchgco.base.errors import InputError, shown
from torchgco.base.options import Seconds, check_value
from torchgco.compiled import Compiled, compile
from torchgco.compiled.motion import Motion
from torchgco.compiled.stages import check_loop_in_free_time, follows, in_periods, previous_of, stage_of
from torchgco.constraints.gates import has_gates
from torchgco.constraints.link import Integral
from torchgco.export.beginning import beginning
from torchgco.export.exported import Exported
from torchgco.export.files import Build, write_files
from torchgco.export.numbers import changing
from torchgco.export.source import solver_source
from torchgco.kernels import current, interior_of, served_by
from torchgco.native.interior import InteriorEngine, Kept
from torchgco.problem.horizons import for_solvers
from torchgco.problem.problem import Problem

BYTES = {torch.float64: 8, torch.float32: 4}  # of numbers in C
C_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while"
)


def export_c(
    problem: Problem | Compiled,
    folder: str | Path,
    name: str = "controller",
    receding: bool = True,
    changes: Sequence[str] | None = None,
    build: Build = "cmake",
    dtype: torch.dtype = torch.float64,
    period: float | None = None,
) -> Path:
    """Write a problem's interior point as C99 that stands alone: no heap, no global state, no library but libm.

        torchgco.export_c(problem, "car_c", name="car", changes=["x_ref"])

    NAME.h has the workspace and four functions, NAME.c all else in one file; NAME_main.c is an example, NAME_test.c
    makes 40 periods and compares all bits with Python's, CMakeLists.txt builds both, and README.md says how large it is
    and which numbers may change; `build` gives the same as a library of Arduino and PlatformIO or a module of Zephyr.
    A step does what a step of `MPC` with `solver="interior_point"` does: it continues
    from the plan before, else begins again from what that leads to now, else from rest, and where all fail it holds the
    plan before with feedback. It doesn't search for other ways, nor for ways to come to rest, and obstacles that move
    are where its numbers say that they are now. In a free time the first step begins with a plan that is sought here.
    Several problems are elements, of which a workspace is given one.

    Args:
        problem: B problems, or a compiled problem. Numbers of a GPU are copied.
        folder: is made if it isn't there; files of these names are overwritten.
        name: of files, types and functions: a word of C.
        receding: each step's horizon begins a `period` after that of the step before.
        changes: names of the numbers that steps may change, beside the places of obstacles that move and the controls
            that rates count from where `receding`; the others are constants. None: all that C reads as they are or
            copies of.
        build: what builds the folder: "cmake"; "arduino", a library for Arduino and PlatformIO with sketches; or
            "zephyr", a module with a sample. Of the last two NAME.h and NAME.c lie in `src`.
        dtype: of all numbers in C. torch.float32 is for processors without a unit for doubles: half of the memory, and
            controls to 1e-3 of their range or, mostly, 1e-4.
        period: s, from one step to the next, as of `MPC`; None: a stage of dt.

    Returns:
        the folder.

    Raises:
        InputError: a name that is no word of C, or a problem that C can't serve: no element, horizons, `Integral`, a
            problem in single precision, code that can't be compiled, where `receding` gates, obstacles that move
            without numbers that say where they are and, in a free time, rates that count from controls before; a number
            that can't change; another dtype. No file is written then.
    """
    _check_options(name, build, dtype, receding, period)
    if isinstance(problem, Compiled):
        changes = problem.changes if changes is None else changes
    compiled = _compiled(problem, period)
    kept = _served(compiled, receding)
    places = [*Motion(compiled.problem).places, *previous_of(compiled.problem)] if receding else []
    if changes is not None:
        changes = list(dict.fromkeys(compiled.numbers.find(name).name for name in [*changes, *places]))
    some = changing(kept, compiled, changes)
    if lacking := sorted({*places} - {member.full for member in some.members}):
        raise InputError("problem", "obstacles whose places C reads as they are, where they move", lacking[0])
    with torch.no_grad():
        begin = beginning(compiled.now, kept.problem.m)
    solver = solver_source(kept, some, compiled.interior, begin, BYTES[dtype], receding)
    exported = Exported(compiled, kept, solver, some, begin, name, receding, BYTES[dtype], period)
    return write_files(exported, Path(folder), build)


def _check_options(name: Any, build: Any, dtype: Any, receding: Any, period: Any) -> None:
    """Raise InputError unless these are words and values that `export_c` takes."""
    check_value(receding, bool, "receding")
    check_value(build, Build, "build")
    if dtype not in BYTES:
        raise InputError("dtype", "torch.float64 or torch.float32", shown(dtype))
    if check_value(period, Seconds | None, "period") is not None and not receding:
        raise InputError("period", "None where the horizon doesn't recede", shown(period))
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name) or name in re.findall(r"\w+", C_WORDS):
        raise InputError("name", "a word of C, such as controller", shown(name))


def _compiled(problem: Problem | Compiled, period: float | None) -> Compiled:
    """The problem as it is now, for the interior point and steps of this period."""
    again = isinstance(problem, Compiled)
    asked = _checked(problem.now if again else problem)
    if asked.time is None and any(map(follows, asked.constraints)):
        asked = in_periods(asked, 1.0 if period is None else min(1.0, period / stage_of(asked)))
    with served_by(*problem.origin) if again else nullcontext():
        return compile(asked, "interior_point", tolerance=problem.interior.tolerance if again else None)


def _checked(problem: Any) -> Problem:
    if not isinstance(problem, Problem):
        raise InputError("problem", "a Problem, or what torchgco.compile makes of one", type(problem).__name__)
    if problem.B == 0:
        raise InputError("problem", "one element or more", "0 problems")
    if problem.x0.dtype != torch.float64:
        raise InputError("problem.x0", "double precision", str(problem.x0.dtype))
    if problem.horizon is not None:
        raise InputError("problem.horizon", "None in exported C", type(problem.horizon).__name__)
    for i, part in enumerate(problem.constraints):
        if isinstance(part, Integral):
            raise InputError(f"constraints[{i}]", "one without Integral in exported C", "Integral")
    return problem


def _served(compiled: Compiled, receding: bool) -> Kept:
    """The packed problem, or what keeps C from serving it."""
    problem = _checked(compiled.problem)
    if receding and has_gates(problem):
        raise InputError("problem", "one without Gates unless receding=False: a loop would put them off", "Gates")
    if receding and problem.time is not None:
        check_loop_in_free_time(problem, 0.0)
    kept = compiled._kept
    if kept is None:
        kernels = interior_of(current(for_solvers(problem)))  # raises, or warns, what is missing
        told = "code that reads a problem's numbers in Python" if isinstance(kernels, InteriorEngine) else "functions"
        raise InputError("problem", "functions that C compiles, of its numbers as tensors", told)
    return kept
