"""python -m benchmarks.families.general_exact: 1e-8 on request, violation and KKT residual of `gco_exact` by family.

Both solvers get the problems of a family as one batch, in turn; the least of their times counts. Violations are those
along a rollout of the controls alone, KKT residuals those of `certify` with the multipliers that the solver returns.
"""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import torch

from benchmarks.families.general_problems import FAMILIES, SETS
from benchmarks.families.general_problems_base import Family
from benchmarks.families.general_starts import judged
from benchmarks.lib.command import Command
from benchmarks.lib.comparison import timed
from benchmarks.lib.page import chosen, filed, markdown, share, shown
from torchgco import certify, solve

EXACT, USUAL = "gco_exact", "gco"
WANTED = 1e-8  # of violation and KKT residual
HEAD = (
    "set", "n", "violation <= 1e-8", "KKT residual <= 1e-8", "both", "largest KKT residual of these",
    "times the time of `gco`, median of families", "of all families together",
)  # fmt: skip


def flown(family: Family, seed: int, rounds: int) -> pd.DataFrame:
    """A row per problem of a family; `seconds` and `usual` are those of the whole batch."""
    problem, found, seconds = family.problem(seed), {}, {}
    for name in (USUAL, EXACT):
        solve(problem.take(slice(0, 1)), solver=name)  # compiles
    for _ in range(rounds):
        for name in (USUAL, EXACT):
            found[name], took = timed(lambda name=name: solve(problem, solver=name))
            seconds[name] = min(took, seconds.get(name, took))
    solution = found[EXACT]
    certificate = certify(problem, solution.X, solution.U, multipliers=solution.multipliers.lam)
    return pd.DataFrame({
        "family": family.name, "set": family.set, "violation": judged(problem, solution.U)["violation"].numpy(),
        "kkt": certificate.kkt_residual.numpy(), "seconds": seconds[EXACT], "usual": seconds[USUAL],
    })  # fmt: skip


def table(sets: Sequence[int], families: Sequence[str], seed: int, rounds: int) -> str:
    """A row per set, and one of all; then the families that fall short."""
    rows = pd.concat([flown(FAMILIES[name], seed, rounds) for name in families if FAMILIES[name].set in sets])
    parts = [(SETS[number], rows[rows.set == number]) for number in sets]
    small = rows[rows.set != max(SETS)]
    parts += [(f"all but {SETS[max(SETS)]}", small)] * (len(sets) > 1 and max(SETS) in sets) + [("all", rows)]
    whole = markdown(HEAD, [[title, *cells(own)] for title, own in parts if len(own)])
    return filed("general-exact", whole, chosen(whole, HEAD, set=("all",)), shortfalls(rows))


def cells(own: pd.DataFrame) -> list[object]:
    tight, stationary, n = own.violation <= WANTED, own.kkt <= WANTED, len(own)
    times = own.drop_duplicates("family")
    return [
        n, share(tight.sum(), n), share(stationary.sum(), n), share((tight & stationary).sum(), n),
        shown(own.kkt[tight & stationary].max(), ".0e"), shown((times.seconds / times.usual).median(), ".2f"),
        shown(times.seconds.sum() / times.usual.sum(), ".2f"),
    ]  # fmt: skip


def shortfalls(rows: pd.DataFrame) -> str:
    """One sentence that names the problems over 1e-8 by family."""
    over = rows[~((rows.violation <= WANTED) & (rows.kkt <= WANTED))]
    named = [
        f"{family} {len(own)} (violations to {own.violation.max():.0e}, residuals to {own.kkt.max():.0e})"
        for family, own in over.groupby("family", sort=False)
    ]
    return f"Over 1e-8: {', '.join(named) or 'none'}."


main = Command(
    __doc__, "general", table, "seed {seed}, least of {rounds}", mark="exact",
    sets=(list(SETS), "1 classics, 2 obstacles, 3 constraints, 4 scale", SETS),
    families=(list(FAMILIES), "which", FAMILIES), seed=(0, "of the problems"), rounds=(2, "of solves, for their times"),
)  # fmt: skip


if __name__ == "__main__":
    torch.set_num_threads(1)
    raise SystemExit(main())
