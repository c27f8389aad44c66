"""Tables of the general families: flights of solvers next to those of IPOPT and FATROP."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pandas as pd

from benchmarks.families.general_peers import LEFT_OUT, REFUSED, SOLVED
from benchmarks.families.general_problems import SETS
from benchmarks.families.general_problems_base import Family
from benchmarks.lib.page import chosen, filed, markdown, share, shown

TIGHT, LOOSE = 1e-6, 1e-3  # violations
KEY = ["family", "instance"]
BEST, REST, FATROP = "IPOPT, best start", "IPOPT, rest", "FATROP, rest"
SET_HEAD = (
    "set", "solver", "n", "violation <= 1e-6", "<= 1e-3", "of those that IPOPT's best start solves, <= 1e-6",
    "within 1 % of IPOPT's best start", "worse than IPOPT from rest", "better", "ms per problem, as a batch",
    "ms, one by one",
)  # fmt: skip
SHOWN = (*SET_HEAD[:2], "violation <= 1e-6", *SET_HEAD[6:9], "ms, one by one")  # in the page
FAMILY_HEAD = (
    "family", "n, m, N", "solver", "<= 1e-6", "<= 1e-3", "within 1 %", "of (starts)", "worse", "better", "ms, batch",
    "ms, one", "IPOPT, rest", "ms", "FATROP", "ms", "statuses",
)  # fmt: skip
HONEST_HEAD = (
    "solver", "CONVERGED", "IPOPT from there finds 1 % less", "CONVERGED or FEASIBLE, but over 1e-3", "INFEASIBLE",
    "IPOPT has a solution",
)  # fmt: skip


def text(flights: pd.DataFrame, peers: pd.DataFrame, families: Sequence[Family], seed: int) -> str:
    """All tables below their headings."""
    references = references_of(peers)
    known = flights.merge(references[[*KEY, "best", "rest"]], on=KEY, how="left")
    every = [known, *peer_flights(references)]
    sets, optima = set_table(every, families), known_table(known, references, families, seed)
    mine = chosen(sets, SHOWN, solver=[*dict.fromkeys(flights.solver)])
    theirs = chosen(sets, SHOWN, set=("all",), solver=(REST, BEST, FATROP)).split("\n")[2:]  # below the same head
    parts = [
        ("Sets", filed("general-sets", sets, "\n".join([mine, *theirs]))),
        ("Known optima", optima and filed("general-known", optima)),
        ("Statuses", honesty_table(known)),
        ("Families", filed("general-families", family_table(known, references, families, seed))),
    ]
    return "\n\n".join(f"## {title}\n\n{table}" for title, table in parts if table)


def references_of(peers: pd.DataFrame) -> pd.DataFrame:
    """A row per problem: what IPOPT found from rest (`rest`) and at best (`best`), and FATROP; NaN where nothing."""
    flown = peers[~peers.status.isin([LEFT_OUT, REFUSED])]
    solved = flown[flown.status == SOLVED]
    rows = flown.drop_duplicates(KEY)[KEY].set_index(KEY)
    for name, peer, rest in (("rest", "ipopt", True), ("best", "ipopt", False), ("fatrop", "fatrop", True)):
        own, all_own = (t[(t.peer == peer) & ((t.start == "rest") | (not rest))] for t in (solved, flown))
        least = own.sort_values("cost").drop_duplicates(KEY).set_index(KEY)
        rows[name], rows[f"{name}_violation"] = least["cost"], least["violation"]
        rows[f"{name}_seconds"] = all_own.groupby(KEY)["seconds"].sum()
        rows[f"{name}_starts"] = all_own.groupby(KEY).size()
    return rows.reset_index()


def peer_flights(references: pd.DataFrame) -> list[pd.DataFrame]:
    """The peers as flights like those of the solvers; they fly problems one by one."""
    flights = []
    for solver, name in ((REST, "rest"), (BEST, "best"), (FATROP, "fatrop")):
        rows = references[references[f"{name}_starts"].notna()]
        columns = {"cost": rows[name], "violation": rows[f"{name}_violation"].fillna(np.inf)}
        times = {"seconds": np.nan, "alone": rows[f"{name}_seconds"]}
        flights.append(rows[KEY].assign(solver=solver, best=rows.best, rest=rows["rest"], **columns, **times))
    return flights


def within(rows: pd.DataFrame, of: str, by: float) -> pd.Series:
    """Which rows are feasible to 1e-3 and cost at most so much more than a reference, as a share of it."""
    return (rows.violation <= LOOSE) & (rows.cost - rows[of] <= by * rows[of].abs())


def worse(rows: pd.DataFrame) -> pd.Series:
    """Which rows are feasible to 1e-3 and cost over 0.1 % more than IPOPT from rest."""
    return (rows.violation <= LOOSE) & (rows.cost - rows["rest"] > 1e-3 * rows["rest"].abs())


def better(rows: pd.DataFrame) -> pd.Series:
    """Which rows are feasible to 1e-6 and cost over 0.1 % less."""
    return (rows.violation <= TIGHT) & (rows["rest"] - rows.cost > 1e-3 * rows["rest"].abs())


def set_table(flights: Iterable[pd.DataFrame], families: Sequence[Family]) -> str:
    """A row per set and solver, and the same of all sets."""
    numbers = {family.name: family.set for family in families}
    rows = pd.concat([table.assign(set=table.family.map(numbers)) for table in flights], ignore_index=True)
    cells = []
    for title, part in [(name, rows[rows.set == k]) for k, name in SETS.items()] + [("all", rows)]:
        cells += [[title, solver, *set_cells(own)] for solver, own in part.groupby("solver", sort=False)]
    return markdown(SET_HEAD, cells)


def set_cells(own: pd.DataFrame) -> list[object]:
    n, solved = len(own), own[own.best.notna()]
    both = int(((own.violation <= LOOSE) & own["rest"].notna()).sum())
    return [
        n, share((own.violation <= TIGHT).sum(), n), share((own.violation <= LOOSE).sum(), n),
        share((solved.violation <= TIGHT).sum(), len(solved)), share(within(solved, "best", 0.01).sum(), len(solved)),
        f"{int(worse(own).sum())} of {both}", f"{int(better(own).sum())} of {both}",
        milliseconds(own.seconds), milliseconds(own.alone),
    ]  # fmt: skip


def milliseconds(seconds: pd.Series) -> str:
    """The median over problems."""
    return shown(1e3 * seconds.median(), ".3g")


def family_table(known: pd.DataFrame, references: pd.DataFrame, families: Sequence[Family], seed: int) -> str:
    """A row per family and solver."""
    cells = []
    for family in families:
        problem, peers = family.problem(seed), references[references.family == family.name]
        own = known[known.family == family.name]
        starts = peers.best_starts.min() if len(peers) else 0
        beside = [
            peers["rest"].notna().sum(), milliseconds(peers.rest_seconds), peers.fatrop.notna().sum(),
            milliseconds(peers.fatrop_seconds),
        ]  # fmt: skip
        for solver, rows in own.groupby("solver", sort=False):
            statuses = ", ".join(f"{status} {count}" for status, count in Counter(rows.status).most_common())
            cells.append([
                family.name, f"{problem.n}, {problem.m}, {problem.N}", solver, (rows.violation <= TIGHT).sum(),
                (rows.violation <= LOOSE).sum(), within(rows, "best", 0.01).sum(),
                f"{rows.best.notna().sum()} ({starts:.0f})", worse(rows).sum(), better(rows).sum(),
                milliseconds(rows.seconds), milliseconds(rows.alone), *beside, statuses,
            ])  # fmt: skip
    return markdown(FAMILY_HEAD, cells)


def honesty_table(known: pd.DataFrame) -> str:
    """A row per solver: how often a status says more than is true."""
    cells = []
    for solver, own in known.groupby("solver", sort=False):
        converged, infeasible = own[own.status == "CONVERGED"], own[own.status == "INFEASIBLE"]
        lower = converged.cost - converged.restarted > 0.01 * converged.cost.abs()
        started = own.restarted.notna().any()
        claimed = own[own.status.isin(["CONVERGED", "FEASIBLE"])]
        cells.append([
            solver, len(converged), int(lower.sum()) if started else "-", int((claimed.violation > LOOSE).sum()),
            len(infeasible), int(infeasible.best.notna().sum()),
        ])  # fmt: skip
    return markdown(HONEST_HEAD, cells)


def known_table(known: pd.DataFrame, references: pd.DataFrame, families: Sequence[Family], seed: int) -> str:
    """A row per family with published optima: by how much costs exceed them; nothing where there is none."""
    solvers = list(dict.fromkeys(known.solver))
    cells = []
    for family in families:
        if family.known is None:
            continue
        optimum = family.known(family.problem(seed)).numpy()
        own = [references[references.family == family.name].set_index("instance")["best"]]
        for solver in solvers:
            rows = known[(known.family == family.name) & (known.solver == solver)].set_index("instance")
            own.append(rows.cost.where(rows.violation <= LOOSE))
        cells.append([family.name, int(np.isfinite(optimum).sum()), f"{optimum[0]:.6g}", *map(excess(optimum), own)])
    head = ("family", "problems", "optimum of the first", BEST, *solvers)
    return markdown(head, cells) if cells else ""


def excess(optimum: np.ndarray) -> Callable[[pd.Series], str]:
    """Least and largest share of the optimum by which costs exceed it, by instance."""

    def cell(cost: pd.Series) -> str:
        found = (cost.reindex(range(len(optimum))).to_numpy() - optimum) / np.abs(optimum)
        found = found[np.isfinite(found)]
        return f"{found.min():+.0e} to {found.max():+.0e}" if len(found) else "-"

    return cell
