"""python -m benchmarks.families.general_eager: the interior point where PyTorch computes a problem's functions.

Beside it, by family, the same loop with compiled ones. Both solve the problems of a family as one batch of the size
asked for. A cost is the same where it differs by 1e-6 of itself at most; times are processor time with one thread,
without compilation.
"""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import torch

from benchmarks.families.general_problems import FAMILIES, SETS
from benchmarks.families.general_problems_base import Family
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import timed
from benchmarks.lib.page import filed, markdown, shown
from torchgco import InteriorPoint, Solution, solve
from torchgco.kernels import use_native

SAME = 1e-6  # share of the cost
HEAD = (
    "family", "B", "same status", "cost within 1e-6", "largest difference", "iterations, compiled", "by PyTorch",
    "times the time",
)  # fmt: skip


def flown(family: Family, seed: int, B: int) -> pd.DataFrame:
    """A row per problem of a family, repeated up to B of them."""
    drawn = family.problem(seed)
    problem = drawn.take(torch.arange(B) % drawn.B)
    solver, found = InteriorPoint(), list[tuple[Solution, float]]()
    for native in (True, False):
        use_native(native)
        try:
            solve(drawn.take(slice(0, 1)).renewed(), solver=InteriorPoint(max_iterations=1), verbose=False)
            found.append(timed(lambda: solve(problem.renewed(), solver=solver, verbose=False)))
        finally:
            use_native(True)
    (native, first), (eager, second) = found
    return pd.DataFrame({
        "family": family.name, "same": [a == b for a, b in zip(native.statuses, eager.statuses, strict=True)],
        "change": ((eager.cost - native.cost).abs() / native.cost.abs().clamp(min=1e-9)).numpy(),
        "native": native.iterations.numpy(), "eager": eager.iterations.numpy(), "ratio": second / first,
    })  # fmt: skip


def table(sets: Sequence[int], families: Sequence[str], seed: int, batch: int) -> str:
    """A row per family, and one sentence about all."""
    rows = []
    for name in families:
        if FAMILIES[name].set in sets:
            rows.append(flown(FAMILIES[name], seed, batch))
            print(cells(rows[-1]), flush=True)
    every = pd.concat(rows)
    ratios = every.drop_duplicates("family").ratio
    said = (
        f"Of {len(every)} statuses {int(every.same.sum())} are the same, of costs {int((every.change <= SAME).sum())}; "
        f"with PyTorch's functions a solve takes {ratios.min():.0f} to {ratios.max():.0f} times as long, "
        f"{ratios.median():.0f} in the median of families."
    )
    return filed("general-eager", markdown(HEAD, [cells(own) for own in rows]), said)


def cells(own: pd.DataFrame) -> list[object]:
    return [
        own.family.iloc[0], len(own), int(own.same.sum()), int((own.change <= SAME).sum()),
        shown(own.change.max(), ".0e"), int(own.native.sum()), int(own.eager.sum()), shown(own.ratio.iloc[0], ".0f"),
    ]  # fmt: skip


main = Command(
    __doc__, "general", table, "seed {seed}, batches of {batch}", mark="eager",
    sets=(list(SETS), "1 classics, 2 obstacles, 3 constraints, 4 scale", SETS),
    families=(list(FAMILIES), "which", FAMILIES), seed=(0, "of the problems"), batch=(8, "problems at once"),
)  # fmt: skip


if __name__ == "__main__":
    torch.set_num_threads(1)
    raise SystemExit(main())
