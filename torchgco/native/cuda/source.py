"""CUDA C++ of a form of problems: the files of C, with headers in place of those that lay out numbers and memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from torchgco.native.codegen.source import Form
from torchgco.native.includes import C
from torchgco.native.structures import HEADER

HERE = Path(__file__).parent / "c"
STRIDE = 32  # problems whose numbers are interleaved: a warp's
THREADS = 128  # threads of a block: each may have as many registers as there are
_SCALAR = {"vectors.h": C / "scalar.h", "wide.h": C / "wide_scalar.h", "words.h": C / "words_scalar.h"}
_OWN = {
    "standard.h": HERE / "standard.h", "pointers.h": HERE / "strided.h", "allocation.h": HERE / "arena.h",
    "clock.h": HERE / "clock.h", "asking.h": HERE / "asking.h", "kernels.h": HERE / "kernels.h",
}  # fmt: skip


@dataclass(frozen=True)
class Program:
    """What a program for a GPU is made of: files of C beside the model's, and kernels by the structures that they read."""

    files: tuple[str, ...]
    kernels: Mapping[str, str]

    def room_of(self, name: str) -> str:
        """The function of C that says how many numbers a solve of this one needs."""
        return {"Interior": "tgco_room", "Kkt": "tgco_kkt_room"}.get(self.kernels[name], "tgco_solver_room")


_OF_PROBLEMS = (
    "value", "open_loop", "closed_loop", "begin", "expand", "ilqr", "descend", "lift", "violation", "penetration",
    "gains", "costates", "follow",
)  # fmt: skip
SOLVER = Program(
    ("passes.c", "trajectories.c", "outer.c", "verdict.c"),
    {"tgco_outer": "Outer", **{f"tgco_{name}": "Problem" for name in _OF_PROBLEMS}},
)
INTERIOR = Program(
    ("riccati.c", "interior.c", "interior_kkt.c"), {"tgco_interior": "Interior", "tgco_kkt": "Kkt"}
)


def source(form: Form, program: Program, stride: int = STRIDE, threads: int = THREADS) -> str:
    """The text that NVRTC compiles; g++ compiles it, too, with calls in place of threads."""
    given = {name: path.read_text() for name, path in (_SCALAR | _OWN).items()}
    text = form.alone((*program.files, "kernels.h"), given, STRIDE=stride, THREADS=threads)
    kernels = "".join(f"KERNEL({kind}, {name})\n" for name, kind in program.kernels.items())
    return text + HEADER.layout + kernels
