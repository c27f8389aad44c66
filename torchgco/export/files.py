"""The files of an exported controller."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import torch

from torchgco.base.status import Status
from torchgco.base.version import VERSION
from torchgco.dynamics.names import controls_of, states_of
from torchgco.export.exported import Exported
from torchgco.export.numbers import Member
from torchgco.export.periods import compared, periods_of
from torchgco.export.single import single
from torchgco.export.source import HERE, firsts, replaced
from torchgco.native.codegen.emit import literal

EXAMPLE = 20  # periods of the example
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
# What headers say of both kinds of time, and of the number of elements.
FIXED = {
    "DEFINED": "STAGES @PERIOD@ /* by which the horizon moves from step to step, unless `stages` says otherwise */",
    "TIMES_FIELD": "", "MOVES": "stages",
    "MOVED_BY": "The plan before is moved on by so many stages", "GUESS_TIMES": "", "GUESS_NAMED": "",
    "AGE": "stages", "NO_PLAN": "and there is no plan.",
}  # fmt: skip
FREE = {
    "DEFINED": "PERIOD @PERIOD@ /* s: what `period` begins with */",
    "TIMES_FIELD": "    double t[@KNOTS@]; /* times of the plan's knots, s: t[NAME_N] is how long it lasts */\n",
    "MOVES": "elapsed", "MOVED_BY": "The plan before is moved on by the seconds that have `elapsed`",
    "GUESS_TIMES": ", const double *t", "GUESS_NAMED": " at the times t (N+1) of its knots, s", "AGE": "seconds",
    "NO_PLAN": "and the first step begins with\n   the plan that was found from the exported start.",
}  # fmt: skip
ONE = {"ELEMENTS": "", "ELEMENT_FIELD": "", "OF_ELEMENT": "", "THAT": ""}
SEVERAL = {
    "ELEMENTS": "#define NAME_ELEMENTS @B@ /* problems of this form; a workspace is of one of them */\n",
    "ELEMENT_FIELD": "    int element; /* whose constants these are: NAME_init sets it */\n",
    "OF_ELEMENT": ", int element",
    "THAT": "\n   element: from 0 to NAME_ELEMENTS - 1; with another one all steps return NAME_BAD_NUMBER.",
}  # fmt: skip
LEFT = ", in which each step leaves its u"
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


def write_files(exported: Exported, folder: Path, build: Build) -> Path:
    """Write them all; returns the folder."""
    periods, source = periods_of(exported), "" if build == "cmake" else "src/"
    words: dict[str, Any] = {
        "FILES": (HERE / f"{build}.md").read_text().rstrip(),  # before the others: it has marks of its own
        "TITLE": exported.title, "DT": exported.stage, "VERSION": VERSION,
        "SYMBOL": f"TORCHGCO_{exported.name.upper()}", "X0": _numbers(exported.problem.x0[0]),
        "EXAMPLE": EXAMPLE, "PERIODS": len(periods), "STACK": STACK + SPARE,
        "MILLISECONDS": max(1, round(1e3 * (exported.seconds or exported.dt))),
        **exported.words,
    }  # fmt: skip
    files = {f"{source}NAME.h": _header(exported), f"{source}NAME.c": _code(exported)}
    for file, template in TEMPLATES[build].items():
        tables = compared(exported, periods) if template == "test.c" else {}
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
    p, (X, U, K), (x, u) = exported.problem, exported.sizes, exported.sizes_of_iterate
    statuses = [
        f"    NAME_{status.name} = {status.value}, /* {status.sentence.split(';')[0].rstrip('.')} */"
        for status in Status
    ]
    members = [
        f"    double {m.name}[{m.size}]; /* {' x '.join(map(str, m.shape))}: {m.full}{left} */"
        for m in exported.changing.members
        for left in [LEFT if m.full in exported.previous else ""]
    ]
    lam, before = sum(exported.solver.multipliers.values()), f"\n    double before[{p.m}];" if exported.previous else ""
    kind = FREE if exported.is_free else FIXED
    shapes = {"SIZE_X": X, "SIZE_U": U, "SIZE_K": K, "SIZE_x": x, "SIZE_u": u, "ROOM": exported.solver.room}
    words: dict[str, Any] = {
        **exported.words, **kind, **(SEVERAL if p.B > 1 else ONE), **shapes, "TITLE": exported.title,
        "NX": p.n, "NU": p.m, "N": p.N, "KNOTS": p.N + 1, "B": p.B, "DT": exported.stage,
        "PERIOD": f"{exported.period!r}",
        "STATUSES": "\n".join(statuses), "NUMBERS": "\n".join(members) or "    double none; /* no number may change */",
        "MAX_ITERATIONS": exported.compiled.interior.max_iterations,
        "MULTIPLIERS": f"    double lam[{lam}];" if lam else "", "BEFORE": before,
    }  # fmt: skip
    return _filled("controller.h", exported, **words)


def _code(exported: Exported) -> str:
    p, solver, many = exported.kept.problem, exported.solver, exported.problem.B > 1
    none = "    memset(w->lam, 0, sizeof w->lam);" if solver.multipliers else "    (void)w;"
    shifts = [
        f"        shift(w->lam + {first}, b->constraints[{i}].place, N + 1, {p.row_shapes[i][1]}, by);"
        for i, first in firsts(solver.multipliers).items()
    ]
    own = ["    w->element = element;"] * many + [f"    w->period = {exported.period_seconds!r};"]
    parts = {
        "NO_MULTIPLIERS": none, "STAGE": f"{exported.dt!r}", "SHIFTS": "\n".join(shifts), "OWN": "\n".join(own),
        "OF_ELEMENT": ", int element" * many, "OF_TIMES": ", const double *t" * exported.is_free,
    }  # fmt: skip
    head = HEAD.format(version=VERSION)
    needs = NEEDS if exported.number == 8 else ""
    return (
        replaced(head, exported.name, NEEDS=needs) + solver.solver + replaced(solver.controller, exported.name, **parts)
    )


def _readme(exported: Exported, words: dict[str, Any]) -> str:
    rows = [
        f"| `{m.name}` | {' x '.join(map(str, m.shape))} | `{m.full}` | {_shown(m)} | {_unit(m, exported)} |"
        for m in exported.changing.members
    ]
    lam = sum(exported.solver.multipliers.values())
    count = sum(m.size for m in exported.changing.members) or 1
    count += sum(exported.sizes) + sum(exported.sizes_of_iterate) + lam
    count += 1 + (exported.problem.N + 1) * exported.is_free  # a period, and times
    workspace = exported.number * count + 8 * exported.solver.room + 64
    return _filled(
        "README.md", exported, **words, WORKSPACE=f"{workspace:,}", TABLES=f"{exported.solver.flash:,}",
        BYTES=f"{STACK:,}", ROWS="\n".join(rows) or "| | | | | |",
    )  # fmt: skip


def _shown(member: Member) -> str:
    values = member.values[0].ravel()
    if not (member.values == member.values[:1]).all():
        return "by element"
    return ", ".join(f"{value:g}" for value in values) if values.size <= 4 else f"{values.size} numbers"


def _unit(member: Member, exported: Exported) -> str:
    """The units of a member's entries, where the problem's parts say."""
    last, dynamics = member.full.rpartition(".")[2], exported.problem.dynamics
    states, controls = ([component.unit for component in of(dynamics)] for of in (states_of, controls_of))
    if last in ("x_ref", "u_ref", "previous"):
        return ", ".join(states if last == "x_ref" else controls)
    if last in ("centers", "radii", "vehicle_radius", "places", "half_sizes"):
        return "m"
    if last == "velocities":
        return "m/s"
    if last in ("lower", "upper") and member.shape[-1:] in ((len(controls),), (len(states),)):
        return ", ".join(controls if member.shape[-1] == len(controls) else states)
    return ""
