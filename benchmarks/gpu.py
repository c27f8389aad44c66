"""python -m benchmarks.gpu: bits, memory and speed of the kernels for GPUs, in ten minutes on a device.

First the bits of whole solves and of rounds of MPPI are compared with those of C; then compute-sanitizer watches all
reads and writes, where it is installed; what time is left goes into speed, the smallest sizes first.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from typing import Any

import torch

import torchgco
from benchmarks.families.general import FAMILIES as GENERAL
from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import FAMILIES
from benchmarks.lib.page import machine, markdown, origin
from benchmarks.lib.provenance import provenance
from torchgco import MPPI, Problem
from torchgco.base.draws import DrawKey
from torchgco.experiments.config.build import compose
from torchgco.native.codegen.source import Form
from torchgco.native.cuda.compiler import Loaded, available, cubin
from torchgco.native.cuda.engine import OnDevice, working_on
from torchgco.native.cuda.source import INTERIOR, SAMPLER, SOLVER, source
from torchgco.native.engine import Engine

NO_DEVICE = "No CUDA device is visible, or the extra `cuda` isn't installed: nothing was measured."
MINUTES = 10.0
WATCHED = "MEMCHECK"  # the argument of the process that compute-sanitizer watches
SOLVERS = {"al_ilqr": (SOLVER, "tgco_outer"), "interior_point": (INTERIOR, "tgco_interior")}
FORMS = "forest30", "planar_random", "pendulum", "cartpole", "landing", "bicycle_discs"
BATCHES = 1, 16, 256, 1024, 4096, 16384, 65536
SAMPLES = 1000, 4096, 16384, 131072, 1048576
CPU_PROBLEMS, CPU_SAMPLES = 1024, 131072  # at most, of one core: larger ones take no longer for each
LIMIT = 0.25  # of the time left that one size may take


@dataclass
class Bench:
    """What is measured, until a deadline.

    Attributes:
        device: what serves problems; its `least` is 1.
        rows: of each table, by its heading.
    """

    device: OnDevice
    deadline: float
    batches: Sequence[int] = BATCHES
    samples: Sequence[int] = SAMPLES
    forms: Sequence[str] = FORMS
    rows: dict[tuple[str, ...], list[list[str]]] = field(default_factory=dict)

    def row(self, head: tuple[str, ...], *cells: object) -> None:
        self.rows.setdefault(head, []).append([str(cell) for cell in cells])
        print(" | ".join(self.rows[head][-1]), flush=True)

    def fits(self, seconds: float) -> bool:
        """Whether a measurement of so many seconds still fits."""
        return seconds <= LIMIT * (self.deadline - time.monotonic())


def problem_of(form: str, B: int) -> Problem:
    """Problems of a form: a family's 32 public layouts, again and again, or a general family's first problem."""
    if form in GENERAL:
        return GENERAL[form].problem(0)
    task = compose(FAMILIES[form].overrides()).task()
    return task.problem.take(torch.arange(B) % task.problem.B)


def compile_all(bench: Bench, arch: str) -> None:
    """Compile the programs of all forms, side by side; what is refused is told where it is asked for."""
    forms = {name: Engine(problem_of(name, 1), compiles=False).form for name in bench.forms}
    texts = [source(form, *SOLVERS[solver]) for form in forms.values() for solver in SOLVERS]
    texts += [source(form, SAMPLER, "tgco_sample", real) for form in _sampled(forms) for real in ("double", "float")]
    import_module("cuda.core")  # by this thread: others would see a part of it
    with ThreadPoolExecutor() as workers:
        list(workers.map(partial(_tried, arch), texts))


def _sampled(forms: dict[str, Form]) -> Iterator[Form]:
    return (form for name, form in forms.items() if name in FAMILIES)


def _tried(arch: str, text: str) -> None:
    with suppress(RuntimeError):
        cubin(text, arch)


BITS = "form", "solver", "problems", "same bits", "same status", "largest relative difference of costs"


def bits(bench: Bench, B: int = 8) -> None:
    """Whole solves, and rounds of MPPI, on the device and in C."""
    for form in bench.forms:
        for solver in SOLVERS:
            solve = lambda form=form, solver=solver: torchgco.solve(problem_of(form, B), solver=solver, verbose=False)
            expected = solve()
            with working_on(bench.device):
                found = solve()
            same = (found.X == expected.X).flatten(1).all(1) & (found.U == expected.U).flatten(1).all(1)
            status = sum(a == b for a, b in zip(found.statuses, expected.statuses, strict=True))
            apart = ((found.cost - expected.cost).abs() / expected.cost.abs().clamp(min=1e-300)).max()
            bench.row(BITS, form, solver, len(same), int(same.sum()), status, f"{float(apart):.1e}")
        for dtype in ("float64", "float32") if form in FAMILIES else ():
            improve = lambda form=form, dtype=dtype: _round(form, 1000, dtype, B)()
            expected = improve()
            with working_on(bench.device):
                found = improve()
            same = (found == expected).flatten(1).all(1)
            apart = (found - expected).abs().max() / expected.abs().max()
            bench.row(BITS, form, f"MPPI, {dtype}", B, int(same.sum()), "", f"{float(apart):.1e} (of controls)")


def _round(form: str, samples: int, dtype: str, B: int = 1) -> Callable[[], torch.Tensor]:
    problem = problem_of(form, B)
    sampler, ids = MPPI(samples=samples, covariance=1.0, dtype=dtype), torch.arange(B)
    U = problem.cost.rest_controls(torch.zeros(B, problem.N, problem.m, dtype=torch.float64))
    return lambda: sampler.improved(problem, U, DrawKey(7, ids, ids))


SPEED = "form", "solver", "problems", "GPU, problems/s", "one core, problems/s", "GPU / core"


def problems(bench: Bench, form: str = "forest30") -> None:
    """Seconds of whole solves."""
    for solver in SOLVERS:
        rate, core = 0.0, 0.0
        for B in bench.batches:
            if not bench.fits(2 * B / rate if rate else 1.0):
                break
            if B <= CPU_PROBLEMS and bench.fits(B / core if core else 1.0):
                core = B / _seconds(partial(_solve, form, B, solver))
            with working_on(bench.device):
                rate = B / _seconds(partial(_solve, form, B, solver))
            bench.row(SPEED, form, solver, f"{B:,}", f"{rate:,.1f}", f"{core:,.1f}", f"{rate / core:.1f}")


def _solve(form: str, B: int, solver: str) -> Callable[[], Any]:
    problem = problem_of(form, B)
    return lambda: torchgco.solve(problem, solver=solver, verbose=False)


ROUNDS = "form", "type", "samples", "GPU, ms a round", "one core, ms a round", "core / GPU"


def samples(bench: Bench, form: str = "forest30") -> None:
    """Milliseconds of a round of MPPI, of one problem."""
    for dtype in ("float32", "float64"):
        core = float("nan")
        for S in bench.samples:
            if not bench.fits(1.0):
                break
            if S <= CPU_SAMPLES:
                core = 1000 * _seconds(partial(_round, form, S, dtype)) / S
            with working_on(bench.device):
                took = 1000 * _seconds(partial(_round, form, S, dtype))
            bench.row(ROUNDS, form, dtype, f"{S:,}", f"{took:.2f}", f"{core * S:.1f}", f"{core * S / took:.1f}")


def _seconds(prepared: Callable[[], Callable[[], Any]], repeats: int = 3) -> float:
    """The least time of some calls after a first one, which compiles and loads."""
    work, times = prepared(), []
    work()
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
        if sum(times) > 10.0:
            break
    return min(times)


def memcheck() -> str:
    """What compute-sanitizer finds in the solves of `bits` of one form."""
    checker = shutil.which("compute-sanitizer")
    if checker is None:
        return "compute-sanitizer isn't installed: no memory was checked."
    words = [checker, "--tool", "memcheck", sys.executable, "-m", "benchmarks.gpu", WATCHED]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    found = [line for line in done.stdout.splitlines() if "ERROR SUMMARY" in line]
    return f"compute-sanitizer's memcheck: {found[-1].partition(':')[2].strip() if found else done.stderr[-300:]}."


def page(bench: Bench, checked: str, graphics: str) -> str:
    """The page: a question, its answer, and the tables; of a device by its name."""
    kept = [row for head, rows in bench.rows.items() if head == BITS for row in rows]
    equal, all_ = (sum(int(row[i]) for row in kept) for i in (3, 2))
    gains = [(float(row[5].replace(",", "")), row) for row in bench.rows.get(SPEED, [])]
    best = max(gains, default=(0.0, ["", "", "0", "0"]))
    commit = provenance("cpu")["commit"]
    head = f"{origin('Measured')}, {graphics} and one core of {machine()}, one run, a family's layouts again and again"
    tables = [markdown(head_, rows) for head_, rows in bench.rows.items()]
    return "\n\n".join(
        [
            "# Does a GPU solve many problems faster, with the bits of C?",
            f"At commit {commit} {equal} of {all_} problems have the bits of C. The largest gain"
            f" over one core is {best[0]:.0f}-fold: {best[1][1]}, {best[1][2]} problems of {best[1][0]}. {checked}",
            f"<!-- gpu -->\n{head}.",
            *tables,
            "<!-- end gpu -->\n",
        ]
    )


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__, "results/gpu.md")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"limit ({MINUTES:.0f})")
    parser.add_argument("watched", nargs="?", help=f"{WATCHED}: what compute-sanitizer watches")
    asked = parser.parse_args(words)
    if not available():
        print(NO_DEVICE)
        return 0
    torch.set_num_threads(1)
    device = torch.device("cuda", torch.cuda.current_device())
    bench = Bench(OnDevice(partial(Loaded, device=device), 1), time.monotonic() + 60 * asked.minutes)
    if asked.watched == WATCHED:
        bench.forms = bench.forms[:1]
        bits(bench)
        return 0
    major, minor = torch.cuda.get_device_capability(device)
    compile_all(bench, f"sm_{major}{minor}")
    bits(bench)
    checked = memcheck()
    print(checked)
    for section in (samples, problems):
        section(bench)
    if asked.write:
        (RESULTS / "gpu.md").write_text(page(bench, checked, torch.cuda.get_device_name(device)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
