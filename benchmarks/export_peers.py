"""What others' controllers take on the same emulated Cortex-M7: CasADi's SQP as generated C, and TinyMPC.

CasADi gets the car's problem as `baselines.nlp` writes it, and makes the same periods as our controller: the first from
a straight drive, the others from the plan before, a stage later; with the multipliers of that plan it takes far longer.
TinyMPC (`pip install --no-deps tinympc`, whose wheel has its C++ and Eigen) gets the linear quadrotor; its terminal
weights follow from its penalty, so its controls aren't compared.
"""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from torchgco import ControlBounds, Problem
from torchgco.baselines.nlp import transcribe
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.dynamics.rollout import open_loop

QUIET = {"print_header": False, "print_iteration": False, "print_time": False, "print_status": False}
SAME = 1e-4  # share of their range by which controls may differ from ours
QRQP = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False, "max_iter": 200}
# Hessians of CasADi's `sqpmethod`: as they are, and with their negative eigenvalues turned over.
HESSIANS: dict[str, dict[str, str]] = {
    "exact Hessians": {},
    "reflected Hessians": {"convexify_strategy": "eigen-reflect"},
}
SQP = """
#include <math.h>
#include <stdio.h>
#include <string.h>
#include "sqp.h"
#include "numbers.h"
#include "timer.h"
static double w[SZ_W], found[V];
static casadi_int iw[SZ_IW + 1];
int main(void) {
    const double *arg[SZ_ARG] = {guess, p, lower, upper, lowest, highest};
    double *res[SZ_RES] = {found};
    start();
    for (int k = 0; k < PERIODS; k++) {
        memcpy(p, states + k * NX, sizeof(double) * NX);
        uint32_t before = ticks();
        sqp(arg, res, iw, w, 0);
        uint32_t spent = before - ticks();
        int same = 1;
        for (int j = 0; j < NU; j++) same &= fabs(found[NX + j] - controls[k * NU + j]) <= near[j];
        printf("0 %d 0 %lu\\n", same, (unsigned long)spent);
        memmove(guess, found + NX + NU, sizeof(double) * (V - NX - NU));
        memcpy(guess + V - 2 * NX - NU, found + V - 2 * NX - NU, sizeof(double) * (2 * NX + NU));
    }
    return 0;
}
"""
TIMER = """
#include <stdint.h>
static volatile uint32_t *const timer = (volatile uint32_t *)0x40000000; /* control, value, reload */
static void start(void) { timer[2] = timer[1] = 0xffffffffu; timer[0] = 1; }
static uint32_t ticks(void) { return timer[1]; }
"""
TINY = """
#include <cstdio>
#include <tinympc/tiny_api.hpp>
#include "numbers.h"
#include "timer.h"
extern "C" { typedef void (*Begin)(void); extern Begin __init_array_start[], __init_array_end[]; void *_sbrk(int); }
extern "C" { void *__dso_handle; int getentropy(void *, size_t) { return -1; } } /* of libraries for a bare processor */
static tinyMatrix filled(const double *from, int rows, int columns) {
    tinyMatrix to(rows, columns);
    for (int i = 0; i < rows * columns; i++) to(i / columns, i % columns) = from[i];
    return to;
}
int main() {
    for (Begin *begin = __init_array_start; begin < __init_array_end; begin++) (*begin)();
    char *before = (char *)_sbrk(0);
    TinySolver *solver;
    const double far = 1e17;
    tiny_setup(&solver, filled(A, NX, NX), filled(B, NX, NU),
        filled(Q, NX, 1).asDiagonal(), filled(R, NU, 1).asDiagonal(), RHO, NX, NU, KNOTS,
        tinyMatrix::Constant(NX, KNOTS, -far), tinyMatrix::Constant(NX, KNOTS, far),
        filled(least, NU, 1).replicate(1, KNOTS - 1), filled(most, NU, 1).replicate(1, KNOTS - 1), 0);
    long heap = (long)((char *)_sbrk(0) - before);
    start();
    for (int most_iterations = 10; most_iterations <= 1000; most_iterations *= 10) {
        tiny_update_settings(solver->settings, 1e-6, 1e-6, most_iterations, 1, 0, 1);
        tiny_set_x0(solver, filled(x0, NX, 1));
        solver->work->y.setZero(); solver->work->g.setZero();
        solver->work->d.setZero(); solver->work->p.setZero();
        solver->work->vnew.setZero(); solver->work->znew.setZero();
        uint32_t begun = ticks();
        tiny_solve(solver);
        uint32_t spent = begun - ticks();
        double off = 0;
        for (int k = 0; k < KNOTS - 1; k++)
            for (int j = 0; j < NU; j++)
                off = fmax(off, fabs(solver->work->u(j, k) - solver->work->znew(j, k)) / (most[j] - least[j]));
        printf("TINY %d %lu %.3e %ld\\n", solver->work->iter, (unsigned long)spent, off, heap);
    }
}
"""


def written(folder: Path, **numbers: Any) -> None:
    """numbers.h: constants, and arrays that the program may change."""
    rows = []
    for name, value in numbers.items():
        if isinstance(value, int | float):
            rows.append(f"#define {name} {value}")
        else:
            flat = [repr(float(x)).replace("inf", "INFINITY") for x in np.asarray(value, float).reshape(-1)]
            rows.append(f"static double {name}[{len(flat)}] = {{{', '.join(flat)}}};")
    (folder / "numbers.h").write_text("#include <math.h>\n" + "\n".join(rows) + "\n")
    (folder / "timer.h").write_text(TIMER)


def arrays(source: str) -> dict[str, np.ndarray]:
    """The arrays of hexadecimal numbers in a test of an exported controller, by name."""
    found = re.findall(r"static const double (\w+)\[[^\]]*\] = \{([^}]*)\}", source)
    return {
        name: np.array([float.fromhex(x) for x in text.replace("\n", " ").split(",") if x.strip()])
        for name, text in found
    }


def write_sqp(problem: Problem, folder: Path, periods: dict[str, np.ndarray], how: dict[str, str]) -> int:
    """Write sqp.c and peer.c for the periods of our controller's test; bytes of memory that a step works in."""
    import casadi as ca

    program = transcribe(problem)
    nlp = {"x": program.variables, "p": program.parameters, "f": program.objective, "g": program.rows}
    options = {**QUIET, "error_on_fail": False, "max_iter": 50, "qpsol": "qrqp", "qpsol_options": QRQP, **how}
    function = ca.nlpsol("sqp", "sqpmethod", nlp, options)
    (folder / "sqp.c").write_text("")
    function.generate("sqp.c", {"with_header": True, "with_mem": False})
    for name in ("sqp.c", "sqp.h"):
        Path(name).rename(folder / name)
    p, U0 = program.values(problem, 0), torch.zeros(problem.N, problem.m, dtype=problem.x0.dtype)
    X0 = open_loop(problem.dynamics, problem.x0, U0.unsqueeze(0))[0]
    guess = torch.cat((torch.cat((X0[:-1], U0), dim=-1).flatten(), X0[-1])).numpy()
    lower, upper = program.limits.bounds(p, guess.size)
    u = slice(problem.n, problem.n + problem.m)
    lowest = np.where(program.equality, 0.0, -np.inf)
    sizes = {
        "SZ_ARG": function.sz_arg(),
        "SZ_RES": function.sz_res(),
        "SZ_IW": function.sz_iw(),
        "SZ_W": function.sz_w(),
    }
    numbers = {"NX": problem.n, "NU": problem.m, "V": guess.size, "PERIODS": len(periods["states"]) // problem.n}
    bounds = {"lower": lower, "upper": upper, "lowest": lowest, "highest": np.zeros(len(lowest))}
    near = SAME * (upper - lower)[u]
    written(folder, **sizes, **numbers, **bounds, guess=guess, p=p, **periods | {"near": near})
    (folder / "peer.c").write_text(SQP)
    return 8 * (sizes["SZ_W"] + sizes["SZ_IW"] + 4 * guess.size + 2 * len(lowest) + p.size)


def write_tiny(problem: Problem, folder: Path, penalty: float) -> list[Path]:
    """Write peer.cpp for a linear problem; TinyMPC's sources, and the folder of them and their headers last.

    Raises:
        RuntimeError: tinympc isn't installed.
    """
    if (spec := find_spec("tinympc")) is None or spec.origin is None:
        raise RuntimeError("tinympc isn't installed: pip install --no-deps tinympc")
    zero = torch.zeros(problem.m, dtype=problem.x0.dtype)

    def step(x: Tensor, u: Tensor) -> Tensor:
        return problem.dynamics.step(x.unsqueeze(0), u.unsqueeze(0))[0]

    A, B = torch.func.jacrev(step, (0, 1))(torch.zeros_like(problem.x0[0]), zero)
    bounds, cost = cast(ControlBounds, problem.constraints[0]), cast(BoundQuadratic, problem.cost)
    written(
        folder, A=A, B=B, Q=cost.Q[0, 0], R=cost.R[0, 0], least=bounds.lower.flatten(), most=bounds.upper.flatten(),
        x0=problem.x0[0], NX=problem.n, NU=problem.m, KNOTS=problem.N + 1, RHO=penalty,
    )  # fmt: skip
    (folder / "peer.cpp").write_text(TINY)
    room = Path(spec.origin).parent / "codegen" / "codegen_src"
    return [*(room / "tinympc" / f"{name}.cpp" for name in ("admm", "tiny_api", "rho_benchmark")), room]
