"""python -m benchmarks.export: bytes, code and instructions of exported C on a Cortex-M7, emulated by QEMU.

Each controller makes the periods of its own test: the first from rest, the others warm, 0.1 % beside the plan before.
It needs Debian's gcc-arm-none-eabi, libnewlib-arm-none-eabi, libstdc++-arm-none-eabi-newlib and qemu-system-arm, and
`pip install --no-deps tinympc`. Instructions are counted by a timer of
the board at one instruction per 64 ns of emulated time; an emulator knows no cycles.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks.export_peers import HESSIANS, arrays, write_sqp, write_tiny
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
CC, CXX = ("arm-none-eabi-gcc",), ("arm-none-eabi-g++",)
LINKED = ARM / "start.c", "-T", ARM / "memory.ld", "-nostartfiles", "--specs=rdimon.specs", "-lm"
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
PENALTIES = 1.0, 10.0  # TinyMPC's own, and one that its examples of quadrotors use
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


def text_of(level: str, folder: Path, dtype: torch.dtype, sources: Sequence[str | Path] = ("car.c",)) -> int:
    """Bytes of code and tables."""
    total = 0
    for source in sources:
        compiler = CXX if str(source).endswith("cpp") else CC
        said(*compiler, *BOARDS[dtype][1], level, "-c", source, "-o", "part.o", folder=folder)
        total += int(said("arm-none-eabi-size", "part.o", folder=folder).splitlines()[1].split()[0])
    return total


def emulated(folder: Path, dtype: torch.dtype) -> str:
    """What the program `run` prints on the board."""
    emulator = "qemu-system-arm", "-M", BOARDS[dtype][0], "-nographic", "-icount", "shift=6"
    return said(*emulator, "-semihosting-config", "enable=on,target=native", "-kernel", "run", folder=folder)


def counted(level: str, folder: Path, dtype: torch.dtype) -> np.ndarray:
    """Of periods status, whether controls are Python's, iterations, instructions and bytes of stack, (periods, 5)."""
    (folder / "counted.c").write_text(COUNTED if dtype == DOUBLE else single(COUNTED))
    said(*CC, *BOARDS[dtype][1], level, f"-I{ARM}", "car.c", "counted.c", *LINKED, "-o", "run", folder=folder)
    return periods_of(emulated(folder, dtype))


def periods_of(printed: str) -> np.ndarray:
    """Rows of what a program prints for each period, with instructions in place of ticks."""
    rows = np.array([line.split() for line in printed.splitlines()], float)
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


def sqp_row(name: str) -> list[str]:
    """CasADi's SQP with one kind of Hessian on the car."""
    with tempfile.TemporaryDirectory() as room:
        folder = Path(room)
        ours = export_c(car(), folder / "ours", name="car", changes=["x_ref"])
        periods = arrays((ours / "car_test.c").read_text())
        memory = write_sqp(car(), folder, periods, HESSIANS[name])
        sizes = [text_of(level, folder, DOUBLE, ["sqp.c"]) for level in ("-Os", "-O2")]
        said(*CC, *BOARDS[DOUBLE][1], "-O2", f"-I{ARM}", "sqp.c", "peer.c", *LINKED, "-o", "run", folder=folder)
        rows = periods_of(emulated(folder, DOUBLE))
    return [
        f"car, CasADi's SQP, {name}", f"{memory / 1000:.0f}", *(f"{size / 1000:.0f}" for size in sizes),
        f"{int(rows[:, 1].sum())} of {len(rows)}", f"{rows[0, 3] / 1e6:.1f}",
        f"{rows[1:, 3].mean() / 1e6:.2f}", f"{rows[1:, 3].max() / 1e6:.1f}",
    ]  # fmt: skip


def tiny_rows(penalty: float) -> list[list[str]]:
    """TinyMPC on the linear quadrotor: a row for each number of iterations."""
    with tempfile.TemporaryDirectory() as room:
        folder = Path(room)
        *sources, room_of = write_tiny(linear(), folder, penalty)
        how = (
            *(f"-I{room_of / name}" for name in (".", "include", "include/Eigen")),
            f"-I{ARM}",
            "-DEIGEN_NO_DEBUG",
            "-fno-exceptions",
            "-fno-rtti",
            "-std=gnu++17",
            "-w",
        )
        flags = [flag for flag in BOARDS[DOUBLE][1] if not flag.startswith("-std")]
        objects = []
        for source in [*sources, folder / "peer.cpp"]:
            objects.append(f"{source.stem}.o")
            said(*CXX, *flags, "-O2", *how, "-c", source, "-o", objects[-1], folder=folder)
        said(*CC, *flags, "-O2", "-c", ARM / "start.c", "-o", "start.o", folder=folder)
        said(*CXX, *flags, "start.o", *objects, *LINKED[1:], "-o", "run", folder=folder)
        text = sum(
            int(said("arm-none-eabi-size", part, folder=folder).splitlines()[1].split()[0]) for part in objects[:-1]
        )
        lines = [line.split()[1:] for line in emulated(folder, DOUBLE).splitlines() if line.startswith("TINY")]
    return [
        [
            f"{penalty:g}",
            iterations,
            f"{int(ticks) / TICKS / 1e6:.2f}",
            off,
            f"{int(heap) / 1000:.0f}",
            f"{text / 1000:.0f}",
        ]
        for iterations, ticks, off, heap in lines
    ]


def others(peers: list[str]) -> str:
    """Peers on the same emulated processor, in double precision."""
    head = (
        "controller", "memory, kB", "code -Os, kB", "code -O2, kB", "our controls", "first step, 1e6 instructions",
        "a warm step, mean", "the longest",
    )  # fmt: skip
    tiny = (
        "TinyMPC: penalty", "iterations", "1e6 instructions", "controls outside the bounds, share of their range",
        "heap, kB", "code -O2, kB",
    )  # fmt: skip
    tables = []
    if "CasADi" in peers:
        tables.append(markdown(head, (sqp_row(name) for name in HESSIANS)))
    if "TinyMPC" in peers:
        tables.append(markdown(tiny, (row for penalty in PENALTIES for row in tiny_rows(penalty))))
    return "\n\n".join(tables)


def text(problems: list[str], peers: list[str]) -> str:
    """Our controllers, and others."""
    return f"{table(problems)}\n\n{others(peers)}".strip()


main = Command(
    __doc__, "export", text, "problems: {problems}; arm-none-eabi-gcc 12.2, QEMU 7.2", "CasADi",
    problems=(["car", "12 states", "linear"], "words in the names of problems; 30 spheres: half an hour"),
    peers=(["CasADi", "TinyMPC"], "others on the same processor", ["CasADi", "TinyMPC"]),
)  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
