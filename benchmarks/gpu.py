"""python -m benchmarks.gpu: bits, memory and speed of the kernels for GPUs, in ten minutes on a device.

First the bits of whole solves and of rounds of MPPI are compared with those of C; then compute-sanitizer watches all
reads and writes, where it is installed; what time is left goes into speed, the smallest sizes first. After each part
the page is written, with the parts that failed. The exit status is 1 where the device didn't solve what it was given,
or with other bits.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

import torchgco
from benchmarks.families.general import FAMILIES as GENERAL
from benchmarks.lib import RESULTS, ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import FAMILIES
from benchmarks.lib.page import machine, markdown, origin
from torchgco import MPPI, DeviceWarning, Problem
from torchgco.base.draws import DrawKey
from torchgco.base.errors import first_line
from torchgco.experiments.config.build import compose
from torchgco.native.codegen.source import Form
from torchgco.native.cuda.compiler import Loaded, available, cubin
from torchgco.native.cuda.engine import OnDevice, has_served, working_on
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
LIMIT = 0.25  # of the time left that one size, or compute-sanitizer, may take
MOST_OF_GCO = 4096  # problems: its search for paths runs on the CPU


@dataclass
class Bench:
    """What is measured, until a deadline.

    Attributes:
        device: what serves problems; its `least` is 1.
        rows: of each table, by its heading.
        checked: what compute-sanitizer said.
        failures: parts that ended with an error, and what the device left to the CPU.
    """

    device: OnDevice
    deadline: float
    batches: Sequence[int] = BATCHES
    samples: Sequence[int] = SAMPLES
    forms: Sequence[str] = FORMS
    rows: dict[tuple[str, ...], list[list[str]]] = field(default_factory=dict)
    checked: str = "No memory was checked."
    failures: list[str] = field(default_factory=list)

    @property
    def left(self) -> float:
        """Seconds until the deadline."""
        return self.deadline - time.monotonic()

    @property
    def proven(self) -> tuple[int, int]:
        """How many problems have the bits of C, and of how many."""
        rows = self.rows.get(BITS, [])
        return sum(int(row[3]) for row in rows), sum(int(row[2]) for row in rows)

    def row(self, head: tuple[str, ...], *cells: object) -> None:
        self.rows.setdefault(head, []).append([str(cell) for cell in cells])
        print(" | ".join(self.rows[head][-1]), flush=True)

    def fits(self, seconds: float) -> bool:
        """Whether a measurement of so many seconds still fits."""
        return seconds <= LIMIT * self.left

    def on_device(self, what: str, call: Callable[[], Any]) -> tuple[Any, bool]:
        """What a call returns where the device serves, and whether it did: the CPU takes what that can't."""
        with working_on(self.device), warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", DeviceWarning)
            found, served = call(), has_served()
        refused = [str(one.message).splitlines()[0] for one in told if issubclass(one.category, DeviceWarning)]
        if refused or not served:
            self.failures.append(f"{what}: {'; '.join(dict.fromkeys(refused)) or 'left to the CPU'}")
        return found, served and not refused


def problem_of(form: str, B: int) -> Problem:
    """Problems of a form: a family's 32 public layouts, again and again, or a general family's first problem."""
    if form in GENERAL:
        return GENERAL[form].problem(0)
    task = compose(FAMILIES[form].overrides()).task()
    return task.problem.take(torch.arange(B) % task.problem.B)


def compile_all(arch: str, bench: Bench) -> None:
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
            expected, (found, served) = solve(), bench.on_device(f"{form}, {solver}", solve)
            same = served & (found.X == expected.X).flatten(1).all(1) & (found.U == expected.U).flatten(1).all(1)
            status = sum(a == b for a, b in zip(found.statuses, expected.statuses, strict=True))
            apart = ((found.cost - expected.cost).abs() / expected.cost.abs().clamp(min=1e-300)).max()
            bench.row(BITS, form, solver, len(same), int(same.sum()), status, f"{float(apart):.1e}")
        for dtype in ("float64", "float32") if form in FAMILIES else ():
            improve = lambda form=form, dtype=dtype: _round(form, 1000, dtype, B)()
            expected, (found, served) = improve(), bench.on_device(f"{form}, MPPI in {dtype}", improve)
            same = served & (found == expected).flatten(1).all(1)
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
    for solver in (*SOLVERS, "gco"):
        rate, core = 0.0, 0.0
        for B in bench.batches:
            if not bench.fits(2 * B / rate if rate else 1.0) or (solver == "gco" and B > MOST_OF_GCO):
                break
            if B <= CPU_PROBLEMS and bench.fits(B / core if core else 1.0):
                core = B / _seconds(partial(_solve, form, B, solver))
            work = partial(_seconds, partial(_solve, form, B, solver))
            took, served = bench.on_device(f"{B} of {form}, {solver}", work)
            if not served:
                break
            rate = B / took
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
            took, served = bench.on_device(f"{S} samples", partial(_seconds, partial(_round, form, S, dtype)))
            if not served:
                break
            took *= 1000
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


def memcheck(bench: Bench) -> None:
    """What compute-sanitizer finds in the solves of `bits` of one form, in its share of the time."""
    found = shutil.which(
        "compute-sanitizer", path=os.pathsep.join((os.environ.get("PATH", ""), *map(str, _toolkits())))
    )
    if found is None:
        bench.checked = "compute-sanitizer isn't installed: no memory was checked."
        return
    words = [found, "--tool", "memcheck", sys.executable, "-m", "benchmarks.gpu", WATCHED]
    limit = max(1.0, LIMIT * bench.left)
    try:
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        bench.checked = f"compute-sanitizer's memcheck was stopped after {limit:.0f} s."
        return
    told = [line for line in done.stdout.splitlines() if "ERROR SUMMARY" in line]
    bench.checked = (
        f"compute-sanitizer's memcheck: {told[-1].partition(':')[2].strip() if told else done.stderr[-300:]}."
    )


def _toolkits() -> list[Path]:
    """Folders with the programs of CUDA."""
    roots = [Path(root) for name in ("CUDA_HOME", "CUDA_PATH") if (root := os.environ.get(name))]
    return [root / "bin" for root in (*roots, *sorted(Path("/usr/local").glob("cuda*"), reverse=True))]


def page(bench: Bench, machinery: str) -> str:
    """The page: a question, its answer, and the tables.

    Args:
        machinery: the device, its driver, and the versions of what compiles for it.
    """
    equal, all_ = bench.proven
    gains = [(float(row[5].replace(",", "")), row) for row in bench.rows.get(SPEED, [])]
    best = max(gains, default=None)
    gain = (
        f" The largest gain over one core is {best[0]:.0f}-fold: {best[1][1]}, {best[1][2]} problems." if best else ""
    )
    failed = " ".join(f"{failure[:1].upper()}{failure[1:]}." for failure in bench.failures)
    head = f"{origin('Measured')}, {machinery} and one core of {machine()}, one run, a family's layouts again and again"
    tables = [markdown(head_, rows) for head_, rows in bench.rows.items()]
    return "\n\n".join(
        [
            "# Does a GPU solve many problems faster, with the bits of C?",
            f"{equal} of {all_} problems have the bits of C.{gain} {bench.checked} {failed}".rstrip(),
            f"<!-- gpu -->\n{head}.",
            *tables,
            "<!-- end gpu -->\n",
        ]
    )


def measure(bench: Bench, sections: Sequence[Callable[[Bench], None]], machinery: str, path: Path | None) -> int:
    """Run sections, whatever becomes of them, and write the page after each; the exit status."""
    for section in sections:
        try:
            section(bench)
        except Exception as error:  # of a driver, say: what was measured before stays
            bench.failures.append(f"{getattr(section, '__name__', 'compiling')} failed: {first_line(error)}")
            print(bench.failures[-1], flush=True)
        if path is not None:
            path.write_text(page(bench, machinery))
    print(bench.checked)
    equal, all_ = bench.proven
    return int(equal < all_ or all_ == 0 or bool(bench.failures))


def machinery_of(device: torch.device) -> str:
    """The device, its driver and the versions of what compiles for it."""
    words = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    driver = "unknown"
    with suppress(OSError, subprocess.SubprocessError):
        driver = subprocess.run(words, capture_output=True, text=True, check=True, timeout=30).stdout.split()[0]
    nvrtc = ".".join(map(str, import_module("cuda.bindings.nvrtc").nvrtcVersion()[1:]))
    return f"{torch.cuda.get_device_name(device)} (driver {driver}, NVRTC {nvrtc}, PyTorch {torch.__version__})"


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
        return measure(bench, [bits], "", None)
    major, minor = torch.cuda.get_device_capability(device)
    sections = partial(compile_all, f"sm_{major}{minor}"), bits, memcheck, samples, problems
    return measure(bench, sections, machinery_of(device), RESULTS / "gpu.md" if asked.write else None)


if __name__ == "__main__":
    sys.exit(main())
