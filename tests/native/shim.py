"""A device without hardware: CUDA C++ that g++ compiles, whose threads are calls, one after the other."""

from __future__ import annotations

import ctypes
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from torchgco.native.cuda.source import STRIDE

FLAGS = "-std=c++20", "-march=native", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared"
SET_THREAD = '\nextern "C" void set_thread(int64_t thread) { tgco_thread = thread; }\n'
DIRTY = 0xFF


@cache
def compiled(text: str, *flags: str) -> ctypes.CDLL:
    with TemporaryDirectory() as room:
        (Path(room) / "kernels.cu").write_text(text + SET_THREAD)
        words = ["g++", *FLAGS, *(flags or ("-Og",)), "-w", "-x", "c++", "kernels.cu", "-o", "kernels.so"]
        done = subprocess.run(words, cwd=room, capture_output=True, text=True)
        assert done.returncode == 0, "\n".join(line for line in done.stderr.splitlines() if "error" in line)[:4000]
        return ctypes.CDLL(str(Path(room) / "kernels.so"))


class Shim:
    """A module of CUDA C++ on the CPU. Each problem has a thread of another place in a warp than the one before.

    Args:
        stride: problems whose numbers are interleaved.
    """

    device, multiprocessors = torch.device("cpu"), 1

    def __init__(self, text: str, stride: int = STRIDE, *flags: str) -> None:
        self._library = compiled(text.replace(f"#define STRIDE {STRIDE}\n", f"#define STRIDE {stride}\n"), *flags)
        self.launched: list[str] = []

    def free_bytes(self) -> int:
        return 1 << 32

    def launch(self, kernel: str, blocks: int, *arguments: int) -> None:
        self.launched.append(kernel)
        address, first, last, numbers, others, count, size, next_, lacks = arguments
        threads = 2  # the memory of a problem serves others after it
        for e in range(last - first):
            thread = e % threads
            ctypes.memset(numbers, DIRTY, 8 * count * threads * STRIDE) if e < threads else None
            self._library.set_thread(ctypes.c_int64(thread))
            ctypes.c_int64.from_address(next_).value = e
            most = [address, first, first + e + 1, numbers, others, count, size, next_, lacks]
            getattr(self._library, kernel)(*map(ctypes.c_int64, most))
