"""python -m benchmarks.families.board: first entries of the leaderboard, flown, and the leaderboard judged.

Each solver flies the five public families; its controls, rounded to float32, become an entry of `benchmarks/board`,
whose layouts are those of `benchmarks/data`. All entries there are judged, also those of others.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from benchmarks.families.worlds_peers import Peers, World
from benchmarks.lib import ROOT, acados
from benchmarks.lib.command import Command
from benchmarks.lib.families import FAMILIES
from benchmarks.lib.page import markdown, share, shown
from benchmarks.lib.provenance import provenance
from benchmarks.lib.studies import flown
from torchgco.base.version import VERSION
from torchgco.experiments.referee.judge import main as judge

BOARD, FLOWN = ROOT / "benchmarks" / "board", ROOT / "outputs" / "board"
METHODS = {
    "gco": "AL-iLQR and an interior point, along paths of several homotopy classes and from samples.",
    "interior_point": "A primal-dual interior point on multiple shooting, from the vehicle at rest alone.",
    "ipopt": "IPOPT with MUMPS through CasADi: multiple shooting, exact Hessians, from the vehicle at rest.",
    "fatrop": "FATROP through CasADi: multiple shooting, exact Hessians, from the vehicle at rest.",
    "fatrop_guided": "FATROP from the cheapest of four paths of torchgco's roadmap; finding them counts.",
    "acados": "SQP with Gauss-Newton and HPIPM without condensing, tolerance 1e-3, from the vehicle at rest.",
    "acados_guided": "acados' SQP from the cheapest of four paths of torchgco's roadmap; finding them counts.",
    "gco_paper": "AL-iLQR guided by MPPI samples: Algorithms 1 to 5 of Kawarabayashi, Uchiyama and Masuda (2026).",
}
TOGETHER = ("gco", "interior_point", "ipopt", "fatrop", "fatrop_guided")  # flown by one study; others by their own
NAMES = {
    "interior_point": "interior point", "ipopt": "IPOPT", "fatrop": "FATROP", "fatrop_guided": "FATROP, guided",
    "acados_guided": "acados, guided", "gco_paper": "the paper's method",
}  # fmt: skip
ACADOS = "acados", "acados_guided"  # flown in an environment of their own
LIMIT = 120  # s of processor time of a layout by acados


def enter(solver: str, families: Sequence[str]) -> None:
    """Write the card of a solver, from the records of its flights."""
    records = [json.loads((folder_of(family, solver) / "run.json").read_text()) for family in families]
    starts = [max(record, key=lambda start: start["processor_seconds"] or 0.0) for record in records]  # that flew
    commits = ", ".join(dict.fromkeys(start["torchgco"]["commit"][:8] for start in starts))
    peer = f", CasADi {starts[0]['packages']['casadi']}" if "ipopt" in solver or "fatrop" in solver else ""
    each = "wall time of a batch of 32 divided by its layouts; without set-up and compiling"
    if solver in ACADOS:
        peer = f", acados (comma-deps-acados) {acados.version()}"
        each = "processor time of each layout, without set-up and compiling"
    card = {
        "name": NAMES.get(solver, solver),
        "authors": "torchgco",
        "method": METHODS[solver],
        "hardware": f"{starts[0]['machine']['processor']}, one core, one thread, beside other work",
        "seeds": "0",
        "time": each,
        "date": max(start["started"] for start in starts)[:10],
        "version": f"torchgco {VERSION} at {commits}{peer}",
    }
    text = "".join(f"{key} = {value}\n" if key == "date" else f'{key} = "{value}"\n' for key, value in card.items())
    folder = BOARD / "entries" / solver
    (folder / "entry.toml").write_text(text)


def folder_of(family: str, solver: str) -> Path:
    return FLOWN / (family if solver in TOGETHER else f"{family}-{solver}")


def fly(family: str, first: str, *others: str) -> None:
    """Fly a family with solvers of one study, one after the other, and write their files of controls."""
    words = [*FAMILIES[family].overrides(), f"solver={first}", f"study.baselines=[{','.join(others)}]"]
    folder = folder_of(family, first)
    trials = flown(folder, *words, "study.workers=1", "device.threads=1", "study.figures=false")
    with np.load(folder / "solutions.npz") as solutions:
        for solver, U in zip(solutions["solver"].tolist(), solutions["U"], strict=True):
            seconds = trials.loc[trials["solver"] == solver].sort_values("layout")["seconds"].to_numpy()
            write(family, solver, U, seconds)


def fly_acados(family: str, solver: str) -> None:
    """Fly a family layout by layout in acados' environment, and write its file of controls."""
    folder = folder_of(family, solver)
    world = World.of(FAMILIES[family], folder / "compiled")
    peers, U0 = Peers.ready(world, "fatrop", {solver}), world.task.U0
    flights = [peers.fly(solver, layout, LIMIT) for layout in range(len(U0))]
    controls = [U0[b] if flight.U is None else flight.U[0] for b, flight in enumerate(flights)]
    write(family, solver, torch.stack(controls).numpy(), np.array([flight.seconds for flight in flights]))
    origin = provenance("cpu")
    record = {
        "started": origin["date"], "processor_seconds": 0.0, "machine": {"processor": origin["processor"]},
        "torchgco": {"commit": origin["commit"]},
    }  # fmt: skip
    (folder / "run.json").write_text(json.dumps([record]))


def write(family: str, solver: str, U: np.ndarray, seconds: np.ndarray) -> None:
    """Write an entry's file of controls (L, N, m) and seconds (L,)."""
    path = BOARD / "entries" / solver / f"{family}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, U=U.astype(np.float32), seconds=seconds.astype(np.float32))


def text(families: Sequence[str], solvers: Sequence[str]) -> str:
    """Fly, enter, judge; returns the table of the leaderboard."""
    studies = [[name for name in solvers if name in TOGETHER], *([name] for name in solvers if name not in TOGETHER)]
    for family in families:
        for names in studies:
            if names and names[0] in ACADOS:
                fly_acados(family, *names)
            elif names:
                fly(family, *names)
    for solver in solvers:
        enter(solver, families)
    judge(["--board", str(BOARD)])
    return table(BOARD / "board.csv")


def table(path: Path) -> str:
    """The leaderboard in Markdown: the most successes first, by layouts."""
    board = pd.read_csv(path)
    order = board.sort_values(["layouts", "success_count", "cost_ratio_median"], ascending=[True, False, True])
    rows = [
        [
            row["layouts"], row["name"], share(row["success_count"], row["n"]), share(row["reached_count"], row["n"]),
            shown(row["cost_ratio_median"], ".3f"), shown(row["seconds_median"], ".2g"),
        ]
        for _, row in order.iterrows()
    ]  # fmt: skip
    heads = ("layouts", "entry", "success", "reached", "median cost ratio, reached", "median s a layout, as said")
    return markdown(heads, rows)


main = Command(
    __doc__, "board", text, "the public layouts, {solvers} flown, others read", "one thread beside other work",
    families=(list(FAMILIES), "which", list(FAMILIES)), solvers=(list(METHODS), "which", list(METHODS)),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
