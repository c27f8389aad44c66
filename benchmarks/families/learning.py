"""python -m benchmarks.families.learning: weights from demonstrations, and nets trained through solves, with seconds.

A part per run, `--part`, each with a table of its own on the page. Settings were chosen on seeds from 1000 on.
"""

from __future__ import annotations

from statistics import median

from torch import Tensor
from tqdm import tqdm

from benchmarks.families.learning_nets import TASKS, trained
from benchmarks.families.learning_weights import BLUR, Recovered, recovered
from benchmarks.lib.command import Command
from benchmarks.lib.page import filed, markdown, share

FOUND = 0.05  # relative error of every identifiable weight under which a seed counts


def weights(seeds: int, count: int) -> str:
    """The table of weights, with all seeds in a file."""
    head = ("demonstrations", "seed", "identifiable", "largest error at first", "largest error", "median error",
            "largest error of all", "miss", "solves", "seconds")  # fmt: skip
    every, rows = [], []
    for noise, name in ((0.0, "as flown"), (BLUR, f"blurred by {BLUR:.1%}")):
        found = [recovered(seed, count, noise) for seed in tqdm(range(seeds), name, unit="seed")]
        every += [[name, seed, *cells(one)] for seed, one in enumerate(found)]
        rows.append([name, *summary(found)])
    columns = (
        "demonstrations", f"seeds with every error under {FOUND}", "largest error, median of seeds",
        "of the worst seed", "median error, median of seeds", "identifiable", "solves, median",
        "seconds, median and most",
    )  # fmt: skip
    return filed("learning-weights", markdown(head, every), markdown(columns, rows))


def summary(found: list[Recovered]) -> list[str]:
    """A row of all seeds; errors are those of identifiable weights."""
    of = lambda name: [getattr(one, name) for one in found]
    below = sum(value < FOUND for value in of("largest"))
    known, unknown = sum(int(one.identifiable.sum()) for one in found), sum(len(one.found) for one in found)
    return [
        share(below, len(found)), f"{median(of('largest')):.0e}", f"{max(of('largest')):.0e}",
        f"{median(of('median')):.0e}", f"{known} of {unknown}",
        f"{median(of('solves')):.0f}", f"{median(of('seconds')):.1f}, {max(of('seconds')):.1f}",
    ]  # fmt: skip


def cells(one: Recovered) -> list[str]:
    """A row of one seed."""
    first, known = (one.start - 1).abs()[one.identifiable].max(), one.identifiable
    return [
        f"{int(known.sum())} of {len(known)}", f"{float(first):.1f}", f"{one.largest:.1e}", f"{one.median:.1e}",
        f"{one.of_all:.1e}", f"{one.loss:.0e}", str(one.solves), f"{one.seconds:.1f}",
    ]  # fmt: skip


def nets(kind: str, seeds: int, steps: int) -> str:
    """The table of a training, a row per seed."""
    rows = []
    for seed in range(seeds):
        one = trained(kind, seed, steps)
        rows.append([
            seed, *(distance(part) for part in (one.before, one.after)), f"{one.differentiable:.1%}",
            f"{one.seconds:.0f}", f"{one.first:.1f}",
        ])  # fmt: skip
    return markdown(("seed", "before", "after", "with gradients", "seconds", "of the first step"), rows)


def distance(missed: Tensor) -> str:
    """The median, with the 90 % quantile in brackets."""
    if len(missed) == 1:
        return f"{float(missed):.4f} m"
    return f"{float(missed.median()):.3f} m ({float(missed.quantile(0.9)):.3f})"


def text(part: str, seeds: int, steps: int, count: int) -> str:
    """The table of a part."""
    return weights(seeds, count) if part == "weights" else nets(part, seeds, steps)


main = Command(
    __doc__, "learning", text, "{seeds} seeds from 0 on, processor seconds of one thread",
    mark="learning {part}", part=("weights", "which table", ["weights", *TASKS]), seeds=(20, "number"),
    steps=(500, "of a training"), count=(12, "demonstrations"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
