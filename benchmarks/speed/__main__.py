"""python -m benchmarks.speed [section ...] [--quick] [--device cuda]"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

# The longest sections are last, as they take the time that is left; only `targets`, which reads the others, follows.
SECTIONS = (
    "first_use", "latency", "loop", "endless", "swing_up", "learned", "own_model", "paper", "mppi", "share", "growth",
    "cores", "batch", "scaling", "families", "targets",
)  # fmt: skip
ON_GPU = ("mppi", "batch", "families")
HERE = Path(__file__).resolve().parents[1]


def main(words: Sequence[str] | None = None) -> int:
    asked = _parser().parse_args(words)
    _one_core()
    # torch reads the number of threads when it is imported, hence the late import.
    import torch

    torch.set_num_threads(1)
    if asked.device == "cuda" and not torch.cuda.is_available():
        print("No CUDA device is visible: nothing was measured, and the tables stay as they are.")
        return 0
    try:
        return _measure(asked)
    except KeyboardInterrupt:
        print(f"\nStopped. Sections that had ended are in {asked.results}.", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description="Measure torchgco and its peers.")
    parser.add_argument("sections", nargs="*", metavar="section", help=", ".join(SECTIONS) + "; default: all")
    parser.add_argument("--quick", action="store_true", help="small sizes; the published tables stay unchanged")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="cuda: " + ", ".join(ON_GPU))
    parser.add_argument("--minutes", type=float, default=30.0, help="limit; longer measurements are left out (30)")
    parser.add_argument("--results", type=Path, help="the csv; default benchmarks/results/speed.csv")
    parser.add_argument("--pages", type=Path, help="folder of README.md and results/speed.md; default benchmarks")
    return parser


def _one_core() -> None:
    """One thread on one core, for this process and those it starts."""
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def _measure(asked: argparse.Namespace) -> int:
    from importlib import import_module

    from benchmarks.lib.provenance import provenance
    from benchmarks.speed.bench import Bench
    from benchmarks.speed.figure import figure
    from benchmarks.speed.results import Results, read_rows
    from benchmarks.speed.sizes import QUICK, Sizes
    from benchmarks.speed.tables import rewrite, section_table
    from torchgco.plotting.style import save

    possible = ON_GPU if asked.device == "cuda" else SECTIONS
    unknown = sorted(set(asked.sections) - set(possible))
    if unknown:
        print(f"No section {', '.join(unknown)}: there are {', '.join(possible)} on {asked.device}.", file=sys.stderr)
        return 2
    asked.results, pages = _files(asked)
    deadline = time.monotonic() + 60 * asked.minutes
    results, source = Results(asked.results), provenance(asked.device)
    bench = Bench(QUICK if asked.quick else Sizes(), results, source, asked.device, deadline)
    for section in [name for name in possible if not asked.sections or name in asked.sections]:
        began = time.monotonic()
        print(f"{section} ...", flush=True)
        import_module(f"benchmarks.speed.{section}").run(bench)
        results.finish(section, asked.device)
        own = [row for row in results.rows if row["section"] == section]
        print(f"\n{section_table(own)}\n\n{section} took {time.monotonic() - began:.0f} s\n", flush=True)
        if pages is not None:
            rewrite(pages, read_rows(asked.results))
            save(figure(read_rows(asked.results)), pages / "results" / "speed.png")
    results.close()
    print(f"Written: {asked.results}" + (f", tables in {pages}" if pages else ""))
    return 0


def _files(asked: argparse.Namespace) -> tuple[Path, Path | None]:
    """Where rows and tables go: a quick look doesn't overwrite the published files."""
    if asked.quick:
        return asked.results or HERE.parent / "outputs" / "speed" / "results.csv", asked.pages
    return asked.results or HERE / "results" / "speed.csv", asked.pages or HERE


if __name__ == "__main__":
    sys.exit(main())
