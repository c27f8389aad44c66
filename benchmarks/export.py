"""python -m benchmarks.export: bytes, code and instructions of exported C on a Cortex-M7, emulated by QEMU.

Each controller makes the periods of its own test: the first from rest, the others warm, 0.1 % beside the plan before.
It needs Debian's gcc-arm-none-eabi, libnewlib-arm-none-eabi and qemu-system-arm. Instructions are counted by a timer of
the board at one instruction per 64 ns of emulated time; an emulator knows no cycles.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.lib import ROOT
from benchmarks.lib.command import Command
from benchmarks.lib.page import markdown
from torchgco import ControlBounds, FunctionDynamics, Problem, QuadraticCost, Spheres, export_c
from torchgco.export.single import single

ARM = ROOT / "tests" / "export" / "arm"
THUMB = "-mfloat-abi=hard", "-mthumb", "-std=gnu99", "-ffp-contract=off", "-fno-math-errno"
# Of QEMU's boards, by the type of numbers: a Cortex-M7 with doubles, and a Cortex-M4F, whose unit has none.
BOARDS = {
    torch.float64: ("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", *THUMB)),
    torch.float32: ("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", *THUMB)),
}
TICKS = 1.6  # of the timer's 25 MHz per instruction
COUNTED = """
#define main compared
#include "car_test.c"
#undef main
#include "paint.h"
static volatile uint32_t *const timer = (volatile uint32_t *)0x40000000; /* control, value, reload */
int main(void) {
    double u[NAME_NU];
    NAME_init(&workspace);
    paint();
    for (int k = 0; k < 5; k++) NAME_step(&workspace, states + k * NAME_NX, k ? NAME_STAGES : 0, INFINITY, u);
    int stack = used();
    timer[2] = timer[1] = 0xffffffffu;
    timer[0] = 1;
    NAME_init(&workspace);
    for (int k = 0; k < PERIODS; k++) {
        uint32_t before = timer[1];
        int status = NAME_step(&workspace, states + k * NAME_NX, k ? NAME_STAGES : 0, INFINITY, u), same = 1;
        uint32_t ticks = before - timer[1];
        for (int j = 0; j < NAME_NU; j++) same &= fabs(u[j] - controls[k * NAME_NU + j]) <= near[j];
        printf("%d %d %d %lu %d\\n", status, same, workspace.iterations, (unsigned long)ticks, stack);
    }
    return 0;
}
""".replace("NAME", "car")


def car() -> Problem:
    """That of the manual: a bicycle along a sine, past two discs."""

    def rates(x: Tensor, u: Tensor) -> Tensor:
        heading, speed = x[..., 2], x[..., 3]
        return torch.stack((speed * heading.cos(), speed * heading.sin(), speed * u[..., 1].tan() / 2.5, u[..., 0]), -1)

    times = 0.1 * np.arange(21)
    reference = np.stack((3 * times, 2 * np.sin(0.5 * times), 0 * times, 3 + 0 * times), -1)
    model = FunctionDynamics(rates, n=4, m=2, dt=0.1, integrator="rk4", position=slice(0, 2))
    cost = QuadraticCost([1, 1, 0.1, 0.1], [0.1, 1.0], [10, 10, 1, 1], x_ref=reference)
    parts = [ControlBounds([-3.0, -0.5], [3.0, 0.5]), Spheres([[3.5, 1.2], [6.5, -0.6]], [0.4, 0.4], 0.3)]
    return Problem(model, cost, parts, [0.0, 0.0, 0.0, 3.0], 20)


def quadrotor_rates(x: Tensor, u: Tensor) -> Tensor:
    """Position, Euler angles, velocity and body rates of 0.5 kg, by four thrusts, N."""
    roll, pitch, yaw = x[..., 3], x[..., 4], x[..., 5]
    v, p, q, r = x[..., 6:9], x[..., 9], x[..., 10], x[..., 11]
    push = u.sum(-1) / 0.5
    ahead = push * (roll.cos() * pitch.sin() * yaw.cos() + roll.sin() * yaw.sin())
    aside = push * (roll.cos() * pitch.sin() * yaw.sin() - roll.sin() * yaw.cos())
    turning = q * roll.sin() + r * roll.cos()
    angles = p + turning * pitch.tan(), q * roll.cos() - r * roll.sin(), turning / pitch.cos()
    (Ix, Iy, Iz), arm, torque = (0.0023, 0.0023, 0.004), 0.12, 0.016
    by_roll, by_pitch = arm * (u[..., 1] - u[..., 3]), arm * (u[..., 2] - u[..., 0])
    by_yaw = torque * (u[..., 0] - u[..., 1] + u[..., 2] - u[..., 3])
    rates = (by_roll + (Iy - Iz) * q * r) / Ix, (by_pitch + (Iz - Ix) * p * r) / Iy, (by_yaw + (Ix - Iy) * p * q) / Iz
    up = push * roll.cos() * pitch.cos() - 9.81
    return torch.cat((v, torch.stack(angles, -1), torch.stack((ahead, aside, up), -1), torch.stack(rates, -1)), -1)


def quadrotor(N: int = 20, spheres: int = 0) -> Problem:
    """To a place 2 m away, or 10 m away among spheres."""
    model = FunctionDynamics(quadrotor_rates, n=12, m=4, dt=0.05, integrator="rk4", position=slice(0, 3))
    goal = [10.0, 0.5, 1.0] if spheres else [2.0, 1.0, 1.0]
    Q = [0.05] * 3 + [0.1] * 9 if spheres else [5.0] * 3 + [0.5] * 6 + [0.1] * 3
    cost = QuadraticCost(Q, [0.5] * 4, [50.0] * 3 + [5.0] * 9, x_ref=goal + [0.0] * 9, u_ref=[0.5 * 9.81 / 4] * 4)
    parts: list = [ControlBounds(0.0, 3.0)]
    if spheres:
        centers = np.random.default_rng(3).uniform([1.0, -2.5, -0.5], [9.0, 2.5, 2.5], (spheres, 3))
        parts.append(Spheres(centers.tolist(), [0.35] * spheres, 0.2))
    return Problem(model, cost, parts, [0.0] * 12, N)


def linear() -> Problem:
    """The same quadrotor linearised at hover, with bounds on its controls."""

    def rates(x: Tensor, u: Tensor) -> Tensor:
        a = torch.stack((9.81 * x[..., 4], -9.81 * x[..., 3], u[..., 0] / 0.5), -1)
        turns = torch.stack((u[..., 1] / 0.0023, u[..., 2] / 0.0023, u[..., 3] / 0.004), -1)
        return torch.cat((x[..., 6:9], x[..., 9:12], a, turns), -1)

    model = FunctionDynamics(rates, n=12, m=4, dt=0.05, integrator="rk4", position=slice(0, 3))
    Q = [5.0] * 3 + [0.5] * 6 + [0.1] * 3
    bounds = ControlBounds([-2.0, -0.03, -0.03, -0.01], [4.0, 0.03, 0.03, 0.01])
    return Problem(model, QuadraticCost(Q, [0.1, 10.0, 10.0, 10.0], Q), [bounds], [1.0, -1.0, 0.5] + [0.0] * 9, 20)


DOUBLE, SINGLE = BOARDS
PROBLEMS: dict[str, tuple[Callable[[], Problem], torch.dtype]] = {
    "car, 20 stages, two discs": (car, DOUBLE),
    "quadrotor of 12 states, 20 stages": (quadrotor, DOUBLE),
    "the same, linear": (linear, DOUBLE),
    "quadrotor, 100 stages, 30 spheres": (lambda: quadrotor(100, 30), DOUBLE),
    "car in single precision": (car, SINGLE),
    "quadrotor of 12 states in single precision": (quadrotor, SINGLE),
    "linear in single precision": (linear, SINGLE),
}


def said(*words: str | Path, folder: Path) -> str:
    """What a program prints.

    Raises:
        RuntimeError: it ends with an error.
    """
    done = subprocess.run([*map(str, words)], cwd=folder, capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{words[0]}: {done.stderr[-2000:]}")
    return done.stdout


def text_of(level: str, folder: Path, dtype: torch.dtype) -> int:
    """Bytes of code and tables."""
    said("arm-none-eabi-gcc", *BOARDS[dtype][1], level, "-c", "car.c", "-o", "car.o", folder=folder)
    return int(said("arm-none-eabi-size", "car.o", folder=folder).splitlines()[1].split()[0])


def counted(level: str, folder: Path, dtype: torch.dtype) -> np.ndarray:
    """Of periods status, whether controls are Python's, iterations, instructions and bytes of stack, (periods, 5)."""
    board, flags = BOARDS[dtype]
    (folder / "counted.c").write_text(COUNTED if dtype == DOUBLE else single(COUNTED))
    words = "car.c", "counted.c", ARM / "start.c", "-T", ARM / "memory.ld", "-nostartfiles", "--specs=rdimon.specs"
    said("arm-none-eabi-gcc", *flags, level, f"-I{ARM}", *words, "-lm", "-o", "run", folder=folder)
    emulator = "qemu-system-arm", "-M", board, "-nographic", "-icount", "shift=6"
    host = "-semihosting-config", "enable=on,target=native"
    rows = np.array(
        [line.split() for line in said(*emulator, *host, "-kernel", "run", folder=folder).splitlines()], float
    )
    rows[:, 3] /= TICKS
    return rows


def row_of(name: str) -> list[str]:
    with tempfile.TemporaryDirectory() as room:
        make, dtype = PROBLEMS[name]
        folder = export_c(make(), room, name="car", changes=["x_ref"], dtype=dtype)
        workspace = re.search(r"car_workspace \| ([\d,]+)", (folder / "README.md").read_text())
        sizes, rows = [text_of(level, folder, dtype) for level in ("-Os", "-O2")], counted("-O2", folder, dtype)
    assert workspace is not None
    cold, warm = rows[0], rows[1:]
    print(name, "done", file=sys.stderr, flush=True)
    return [
        name, f"{int(workspace[1].replace(',', '')) / 1000:.0f}", f"{cold[4] / 1000:.1f}",
        *(f"{size / 1000:.0f}" for size in sizes),
        f"{int((rows[:, 0] == 1).sum())}, {int(rows[:, 1].sum())} of {len(rows)}",
        f"{cold[3] / 1e6:.1f} ({cold[2]:.0f})", f"{warm[:, 3].mean() / 1e6:.2f} ({warm[:, 2].mean():.1f})",
        f"{warm[:, 3].max() / 1e6:.1f} ({warm[warm[:, 3].argmax(), 2]:.0f})",
    ]  # fmt: skip


def table(problems: list[str]) -> str:
    head = (
        "problem", "memory, kB", "stack, kB", "code -Os, kB", "code -O2, kB", "converged, as in Python",
        "from rest, 1e6 instructions",
        "a warm step, mean", "the longest",
    )  # fmt: skip
    names = [name for name in PROBLEMS if any(word in name for word in problems)]
    return markdown(head, (row_of(name) for name in names))


main = Command(
    __doc__, "export", table, "problems: {problems}; arm-none-eabi-gcc 12.2, QEMU 7.2",
    problems=(["car", "12 states", "linear"], "words in the names of problems; 30 spheres: half an hour"),
)  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
