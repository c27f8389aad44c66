"""The files of an exported controller."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from torchgco.base.status import Status
from torchgco.base.version import VERSION
from torchgco.compiled import Compiled, compile
from torchgco.dynamics.names import controls_of, states_of
from torchgco.export.numbers import Changing, Member
from torchgco.export.single import single
from torchgco.export.source import HERE, Solver, firsts, replaced, table
from torchgco.native.codegen.emit import literal
from torchgco.native.interior import Kept

PERIODS = 40  # of the test
EXAMPLE = 20  # of the example
NEAR = 1e-3  # of the range of controls along the test, that those in single precision may differ from Python's
DISTURBED = 1e-3  # of the size of each state along the plan: by how much the test's states are off it
STACK = 4096  # bytes of a step, at most, on a Cortex-M: matrices lie in the workspace. tests/export/test_stack.py
SPARE = 4096  # bytes of a sample's stack beside those: for long functions, such as implicit steps
Build = Literal["cmake", "arduino", "zephyr"]
# The files beside NAME.h and NAME.c, of what builds a folder, and from which templates; the last two have both in src.
TEMPLATES: dict[Build, dict[str, str]] = {
    "cmake": {"NAME_main.c": "main.c", "NAME_test.c": "test.c", "CMakeLists.txt": "CMakeLists.txt"},
    "arduino": {
        "library.properties": "arduino/library.properties", "library.json": "arduino/library.json",
        "examples/NAME/NAME.ino": "arduino/main.ino", "examples/NAME_test/NAME_test.ino": "arduino/test.ino",
        "examples/NAME_test/NAME_test.h": "test.c",
    },
    "zephyr": {
        "zephyr/module.yml": "zephyr/module.yml", "CMakeLists.txt": "zephyr/CMakeLists.txt",
        "Kconfig": "zephyr/Kconfig",
        "samples/NAME/CMakeLists.txt": "zephyr/sample.cmake", "samples/NAME/prj.conf": "zephyr/prj.conf",
        "samples/NAME/sample.yaml": "zephyr/sample.yaml", "samples/NAME/src/main.c": "main.c",
        "samples/NAME/src/test.c": "test.c",
    },
}  # fmt: skip
HEAD = """/* NAME.c: written by torchgco {version}. NAME.h says what it offers, README.md how it is compiled. */
#include "NAME.h"
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("no-schedule-insns") /* else long functions take half as much stack again */
#endif
#if defined(ARDUINO) && defined(__GNUC__) && !defined(__clang__)
#pragma GCC optimize("fp-contract=off", "no-math-errno") /* Arduino gives a library no options */
#endif
@NEEDS@#define int64_t int32_t /* counters: no array is so long, and small processors take a tenth less code */
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#pragma GCC diagnostic ignored "-Wunused-const-variable"
#endif
#if defined(__clang__)
#pragma clang diagnostic ignored "-Wunknown-warning-option"
#pragma clang diagnostic ignored "-Wbitwise-instead-of-logical"
#endif
"""
NEEDS = "typedef char NAME_needs_doubles_of_8_bytes[sizeof(double) == 8 ? 1 : -1];\n"


@dataclass(frozen=True)
class Exported:
    """What is written."""

    compiled: Compiled
    kept: Kept
    solver: Solver
    changing: Changing
    name: str
    receding: bool
    number: int  # bytes of a number: 8 or 4

    @property
    def title(self) -> str:
        p = self.kept.problem
        return f"{p.n} states, {p.m} controls, {p.N} stages"

    @property
    def stage(self) -> str:
        """The length of a stage, s."""
        return f"{float(torch.as_tensor(self.kept.problem.dynamics.dt).flatten()[0]):g}"

    @property
    def words(self) -> dict[str, Any]:
        """What files say of its numbers."""
        near = f"controls within {NEAR:g} of their range"
        same, real = ("the same bits, status and iterations", "doubles") if self.number == 8 else (near, "floats")
        return {"SAME": same, "REAL": real}

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of X, U and K."""
        p = self.kept.problem
        return (p.N + 1) * p.n, p.N * p.m, p.N * p.m * p.n


def write_files(exported: Exported, folder: Path, build: Build) -> Path:
    """Write them all; returns the folder."""
    periods, source = _periods(exported), "" if build == "cmake" else "src/"
    words: dict[str, Any] = {
        "FILES": (HERE / f"{build}.md").read_text().rstrip(),  # before the others: it has marks of its own
        "TITLE": exported.title, "DT": exported.stage, "VERSION": VERSION,
        "SYMBOL": f"TORCHGCO_{exported.name.upper()}", "X0": _numbers(exported.kept.problem.x0),
        "EXAMPLE": EXAMPLE, "PERIODS": len(periods[2]), "MILLISECONDS": max(1, round(1e3 * float(exported.stage))),
        "STACK": STACK + SPARE,
        **exported.words,
    }  # fmt: skip
    files = {f"{source}NAME.h": _header(exported), f"{source}NAME.c": _code(exported)}
    for file, template in TEMPLATES[build].items():
        tables = _compared(exported, *periods) if template == "test.c" else {}
        files[file] = _filled(template, exported, **words, **tables)
    files["README.md"] = _readme(exported, words)
    for file, text in files.items():
        path = folder / replaced(file, exported.name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(single(text) if exported.number == 4 and path.suffix in (".c", ".h", ".ino") else text)
    return folder


def _filled(file: str, exported: Exported, **parts: Any) -> str:
    texts = {part: str(value) for part, value in parts.items()}
    return replaced((HERE / file).read_text(), exported.name, **texts)


def _numbers(values: torch.Tensor) -> str:
    return ", ".join(literal(value) for value in values.flatten().tolist())


def _header(exported: Exported) -> str:
    p, (X, U, K) = exported.kept.problem, exported.sizes
    statuses = [
        f"    NAME_{status.name} = {status.value}, /* {status.sentence.split(';')[0].rstrip('.')} */"
        for status in Status
    ]
    members = [
        f"    double {m.name}[{m.size}]; /* {' x '.join(map(str, m.shape))}: {m.full} */"
        for m in exported.changing.members
    ]
    lam = sum(exported.solver.multipliers.values())
    return _filled(
        "controller.h", exported, **exported.words, TITLE=exported.title, NX=p.n, NU=p.m, N=p.N, DT=exported.stage,
        STAGES=float(exported.receding), STATUSES="\n".join(statuses),
        NUMBERS="\n".join(members) or "    double none; /* no number may change */",
        MAX_ITERATIONS=exported.compiled.interior.max_iterations, SIZE_X=X, SIZE_U=U, SIZE_K=K,
        MULTIPLIERS=f"    double lam[{lam}];" if lam else "", ROOM=exported.solver.room,
    )  # fmt: skip


def _code(exported: Exported) -> str:
    p, solver = exported.kept.problem, exported.solver
    none = "    memset(w->lam, 0, sizeof w->lam);" if solver.multipliers else "    (void)w;"
    shifts = [
        f"        shift(w->lam + {first}, b->constraints[{i}].place, N + 1, {p.row_shapes[i][1]}, by);"
        for i, first in firsts(solver.multipliers).items()
    ]
    parts = {"NO_MULTIPLIERS": none, "SHIFTS": "\n".join(shifts)}
    head = HEAD.format(version=VERSION)
    needs = NEEDS if exported.number == 8 else ""
    return (
        replaced(head, exported.name, NEEDS=needs) + solver.solver + replaced(solver.controller, exported.name, **parts)
    )


def _periods(exported: Exported) -> tuple[list[np.ndarray], list[np.ndarray], list[int]]:
    """States, controls and iterations of periods in Python, as long as all converge."""
    compiled = compile(
        exported.compiled.now, "interior_point", ["x0"], exported.receding, exported.compiled.interior.tolerance
    )
    bounds, N = compiled.problem.control_bounds, compiled.problem.N
    x, draws = compiled.problem.x0[0].numpy().copy(), np.random.default_rng(0)
    first = x
    states, controls, iterations = list[np.ndarray](), list[np.ndarray](), list[int]()
    while len(states) < PERIODS:
        answer = compiled.call({"x0": x})
        if answer.statuses != [Status.CONVERGED]:
            break
        u = answer.u
        if bounds is not None:
            low, high = bounds.over(N)
            u = torch.minimum(torch.maximum(u, low[:, 0]), high[:, 0])
        states.append(x)
        controls.append(u[0].numpy())
        iterations.append(int(answer.iterations[0]))
        size = answer.X[0].abs().amax(0).numpy()
        x = (answer.X[0, 1].numpy() if exported.receding else first) + DISTURBED * size * draws.standard_normal(len(x))
    return states, controls, iterations


def _compared(
    exported: Exported, states: list[np.ndarray], controls: list[np.ndarray], iterations: list[int]
) -> dict[str, str]:
    """What the test compares with, and how: in double precision all bits."""
    flat = lambda rows: [float(value) for row in rows for value in row] or [0.0]
    is_double = exported.number == 8
    near = NEAR * np.ptp(np.array(controls or [np.zeros(exported.kept.problem.m)]), axis=0)
    tables = [
        table("static const double states[]", flat(states)),
        table("static const double controls[]", flat(controls)),
        table("static const double near[]", [0.0] * len(near) if is_double else near.tolist()),
        *([table("static const int iterations[]", iterations or [0])] if is_double else []),
    ]
    bits = "The bits are those of a processor with fused products, and of -ffp-contract=off."
    wrong = bits if is_double else "Controls differ by more than rounding in single precision makes them."
    same = " && workspace.iterations == iterations[k]" if is_double else ""
    return {"TABLES": "\n".join(tables), "ITERATIONS": same, "OTHERWISE": wrong}


def _readme(exported: Exported, words: dict[str, Any]) -> str:
    rows = [
        f"| `{m.name}` | {' x '.join(map(str, m.shape))} | `{m.full}` | {_shown(m)} | {_unit(m, exported)} |"
        for m in exported.changing.members
    ]
    (X, U, K), lam = exported.sizes, sum(exported.solver.multipliers.values())
    count = sum(m.size for m in exported.changing.members) or 1
    workspace = exported.number * (2 * X + 2 * U + K + lam + count) + 8 * exported.solver.room + 64
    return _filled(
        "README.md", exported, **words, WORKSPACE=f"{workspace:,}", TABLES=f"{exported.solver.flash:,}",
        BYTES=f"{STACK:,}", ROWS="\n".join(rows) or "| | | | | |",
    )  # fmt: skip


def _shown(member: Member) -> str:
    values = member.value.ravel()
    return ", ".join(f"{value:g}" for value in values) if values.size <= 4 else f"{values.size} numbers"


def _unit(member: Member, exported: Exported) -> str:
    """The units of a member's entries, where the problem's parts say."""
    last, dynamics = member.full.rpartition(".")[2], exported.kept.problem.dynamics
    states, controls = ([component.unit for component in of(dynamics)] for of in (states_of, controls_of))
    if last in ("x_ref", "u_ref"):
        return ", ".join(states if last == "x_ref" else controls)
    if last in ("centers", "radii", "vehicle_radius", "places", "half_sizes"):
        return "m"
    if last == "velocities":
        return "m/s"
    if last in ("lower", "upper") and member.shape[-1:] in ((len(controls),), (len(states),)):
        return ", ".join(controls if member.shape[-1] == len(controls) else states)
    return ""
