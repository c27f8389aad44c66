"""The files of an exported controller."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchgco.base.status import Status
from torchgco.base.version import VERSION
from torchgco.compiled import Compiled, compile
from torchgco.dynamics.names import controls_of, states_of
from torchgco.export.numbers import Changing, Member
from torchgco.export.source import HERE, Solver, replaced, table
from torchgco.native.codegen.emit import literal
from torchgco.native.kept import Kept

PERIODS = 40  # of the test
EXAMPLE = 20  # of the example
DISTURBED = 1e-3  # of the size of each state along the plan: by how much the test's states are off it
HEAD = """/* NAME.c: written by torchgco {version}. NAME.h says what it offers, README.md how it is compiled. */
#include "NAME.h"
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#define int64_t int32_t /* counters: no array is so long, and small processors take a tenth less code */
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#endif
#if defined(__clang__)
#pragma clang diagnostic ignored "-Wunknown-warning-option"
#pragma clang diagnostic ignored "-Wbitwise-instead-of-logical"
#endif
"""


@dataclass(frozen=True)
class Exported:
    """What is written."""

    compiled: Compiled
    kept: Kept
    solver: Solver
    changing: Changing
    name: str
    receding: bool

    @property
    def title(self) -> str:
        p = self.kept.problem
        return f"{p.n} states, {p.m} controls, {p.N} stages"

    @property
    def stage(self) -> str:
        """The length of a stage, s."""
        return f"{float(torch.as_tensor(self.kept.problem.dynamics.dt).flatten()[0]):g}"

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of X, U and K."""
        p = self.kept.problem
        return (p.N + 1) * p.n, p.N * p.m, p.N * p.m * p.n


def write_files(exported: Exported, folder: Path) -> Path:
    """Write them all; returns the folder."""
    name, periods = exported.name, _periods(exported)
    files = {
        f"{name}.h": _header(exported),
        f"{name}.c": _code(exported),
        f"{name}_main.c": _filled("main.c", exported, X0=_numbers(exported.kept.problem.x0), PERIODS=EXAMPLE),
        f"{name}_test.c": _filled("test.c", exported, TABLES=_vectors(*periods), PERIODS=len(periods[2])),
        "CMakeLists.txt": _filled("CMakeLists.txt", exported),
        "README.md": _readme(exported, len(periods[2])),
    }
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (folder / file).write_text(text)
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
    lam = [f"    double lam_{i}[{count}];" for i, count in exported.solver.multipliers.items()]
    return _filled(
        "controller.h", exported, TITLE=exported.title, NX=p.n, NU=p.m, N=p.N, DT=exported.stage,
        STAGES=float(exported.receding), STATUSES="\n".join(statuses),
        NUMBERS="\n".join(members) or "    double none; /* no number may change */",
        MAX_ITERATIONS=exported.compiled.interior.max_iterations, SIZE_X=X, SIZE_U=U, SIZE_K=K,
        MULTIPLIERS="\n".join(lam), ROOM=exported.solver.room,
    )  # fmt: skip


def _code(exported: Exported) -> str:
    p, solver = exported.kept.problem, exported.solver
    none = [f"    memset(w->lam_{i}, 0, sizeof w->lam_{i});" for i in solver.multipliers]
    shifts = [
        f"        shift(w->lam_{i}, b->constraints[{i}].place, N + 1, {p.row_shapes[i][1]}, by);"
        for i in solver.multipliers
    ]
    parts = {"NO_MULTIPLIERS": "\n".join(none) or "    (void)w;", "SHIFTS": "\n".join(shifts)}
    head = HEAD.format(version=VERSION)
    return replaced(head, exported.name) + solver.solver + replaced(solver.controller, exported.name, **parts)


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


def _vectors(states: list[np.ndarray], controls: list[np.ndarray], iterations: list[int]) -> str:
    flat = lambda rows: [float(value) for row in rows for value in row] or [0.0]
    return "\n".join(
        (
            table("static const double states[]", flat(states)),
            table("static const double controls[]", flat(controls)),
            table("static const int iterations[]", iterations or [0]),
        )
    )


def _readme(exported: Exported, periods: int) -> str:
    rows = [
        f"| `{m.name}` | {' x '.join(map(str, m.shape))} | `{m.full}` | {_shown(m)} | {_unit(m, exported)} |"
        for m in exported.changing.members
    ]
    (X, U, K), lam = exported.sizes, sum(exported.solver.multipliers.values())
    count = sum(m.size for m in exported.changing.members) or 1
    workspace = 8 * (2 * X + 2 * U + K + lam + count + exported.solver.room) + 64
    return _filled(
        "README.md", exported, VERSION=VERSION, TITLE=exported.title, PERIODS=periods, DT=exported.stage,
        WORKSPACE=f"{workspace:,}", TABLES=f"{exported.solver.flash:,}", ROWS="\n".join(rows) or "| | | | | |",
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
