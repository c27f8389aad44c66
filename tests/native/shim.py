"""A device without hardware: CUDA C++ that g++ compiles, whose threads are calls, one after the other."""

from __future__ import annotations

import ctypes
import os
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from torchgco.native.cuda.source import THREADS, WARP

FLAGS = "-std=c++20", "-march=native", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-fPIC", "-shared"
# Threads of a block that wait for each other, where there are several.
BLOCK = """
#include <barrier>
#include <cstdint>
#include <thread>
#include <vector>
static thread_local int local_thread;
static int local_threads = 1;
static std::barrier<> *together;
#define LOCAL_THREAD local_thread
#define LOCAL_THREADS local_threads
#define __syncthreads() (local_threads > 1 ? together->arrive_and_wait() : (void)0)
"""
CALLS = """
extern "C" void set_thread(int64_t thread) { tgco_thread = thread; }
extern "C" void call_block(void (*kernel)(int64_t, int64_t), int64_t a, int64_t b, int64_t threads) {
    std::barrier<> barrier(threads);
    std::vector<std::thread> made;
    together = &barrier;
    local_threads = (int)threads;
    for (int i = 0; i < threads; i++) made.emplace_back([=] { local_thread = i; kernel(a, b); });
    for (auto &each : made) each.join();
    local_threads = 1;
}
"""
IN_BLOCK = 3  # threads of a block
AT_ONCE = 2  # threads that solve problems: the memory of one serves others after it


@cache
def compiled(text: str) -> ctypes.CDLL:
    with TemporaryDirectory() as room:
        (Path(room) / "kernels.cu").write_text(BLOCK + text + CALLS)
        flags = "-pthread", *FLAGS, *os.environ.get("SHIM_FLAGS", "-Og").split(), "-w"
        words = ["g++", *flags, "-x", "c++", "kernels.cu", "-o", "kernels.so"]
        done = subprocess.run(words, cwd=room, capture_output=True, text=True)
        assert done.returncode == 0, "\n".join(line for line in done.stderr.splitlines() if "error" in line)[:4000]
        return ctypes.CDLL(str(Path(room) / "kernels.so"))


class Shim:
    """A module of CUDA C++ on the CPU.

    Args:
        stride: problems whose numbers are interleaved, where threads have problems.
        free: bytes of memory.

    Attributes:
        launched: the kernels.
    """

    device, multiprocessors = torch.device("cpu"), 1

    def __init__(self, text: str, stride: int = WARP, free: int = 1 << 28) -> None:
        text = text.replace(f"#define STRIDE {WARP}\n", f"#define STRIDE {stride}\n")
        self._library, self.launched = compiled(text), list[str]()
        self._free = free

    def free_bytes(self) -> int:
        return self._free

    def launch(self, kernel: str, blocks: int, *arguments: int) -> None:
        self.launched.append(kernel)
        function = getattr(self._library, kernel)
        call = lambda *values: function(*map(ctypes.c_int64, values))
        if kernel.startswith("sample"):
            of_blocks = kernel == "sample_weigh"
            for thread in range(blocks if of_blocks else blocks * THREADS):
                self._library.set_thread(ctypes.c_int64(thread))
                if of_blocks:
                    self._library.call_block(function, *map(ctypes.c_int64, (*arguments, IN_BLOCK)))
                else:
                    call(*arguments)
            return
        address, first, last, numbers, others, count, size, next_, lacks = arguments
        ctypes.memset(numbers, 0xFF, 8 * count * WARP)  # numbers that aren't written first are NaN
        ctypes.memset(others, 0xFF, size * AT_ONCE)
        for e in range(last - first):
            self._library.set_thread(ctypes.c_int64(e % AT_ONCE))
            ctypes.c_int64.from_address(next_).value = e
            call(address, first, first + e + 1, numbers, others, count, size, next_, lacks)
