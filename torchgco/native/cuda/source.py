"""CUDA C++ of a form of problems: the files of C, with headers in place of those that lay out numbers and memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchgco.native.codegen.source import Form
from torchgco.native.includes import C
from torchgco.native.structures import HEADER

HERE = Path(__file__).parent / "c"
WARP = 32
THREADS = 128  # of a block
SAMPLES = 1024  # bytes of the structure Samples, at most
ROWS = 104  # bytes of the structure Rows and of two pointers, at most: of each constraint, beside numbers
OF_ONE = {name: C / "scalar" / name for name in ("vectors.h", "wide.h", "words.h")}
ON_DEVICE = "standard.h", "allocation.h", "clock.h", "asking.h", "noise.h", "strided.h", "kernels.h", "sampling.h"


@dataclass(frozen=True)
class Program:
    """What a program for a device is made of.

    Attributes:
        files: of C, beside those of the model and its cost, and the file with kernels.
        functions: of C that run on a device, and the structures that they read: those that iterate.
        stride: problems whose numbers are interleaved.
    """

    files: tuple[str, ...]
    functions: Mapping[str, str]
    stride: int

    def room_of(self, name: str) -> str:
        """The function of C that says how many numbers a solve by this one needs."""
        return ROOMS[self.functions[name]]


ROOMS = {"Interior": "tgco_room", "Kkt": "tgco_kkt_room", "Sampling": "tgco_sampler_room"}
ROOMS |= dict.fromkeys(("Problem", "Outer"), "tgco_solver_room")
SOLVER = Program(
    ("passes.c", "trajectories.c", "outer.c", "verdict.c", "kernels.h"),
    {"tgco_outer": "Outer", "tgco_ilqr": "Problem", "tgco_descend": "Problem"}, WARP,
)  # fmt: skip
INTERIOR = Program(
    ("riccati.c", "interior.c", "interior_kkt.c", "kernels.h"), {"tgco_interior": "Interior", "tgco_kkt": "Kkt"}, WARP
)
# All threads of a problem read the same numbers.
SAMPLER = Program(("mppi.c", "sampling.h"), {"tgco_sample": "Sampling"}, 1)


def source(form: Form, program: Program, name: str, real: str = "double") -> str:
    """The text that NVRTC compiles for a function; g++ compiles it, too, with calls in place of threads.

    Args:
        real: the type of numbers.
    """
    given = {name: path.read_text() for name, path in OF_ONE.items()}
    given |= {name: (HERE / name).read_text() for name in ON_DEVICE}
    given["pointers.h"] = given.pop("strided.h") if program.stride > 1 else (C / "pointers.h").read_text()
    sizes: dict[str, Any] = {"STRIDE": program.stride, "THREADS": THREADS, "SAMPLES": SAMPLES, "ROWS": ROWS}
    text = form.alone(program.files, given, REAL=real, **sizes) + HEADER.layout
    if "kernels.h" in program.files:
        text += f"KERNEL({program.functions[name]}, {name})\n"
    return text
