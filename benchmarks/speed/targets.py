"""The goals of the native kernels beside what the other sections measured, in this run or a former one."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.speed.bench import Bench
from benchmarks.speed.results import Row, read_rows

SECTION = "targets"


@dataclass(frozen=True)
class Measured:
    """A row of another section, and how it reads in the table: its value goes into `text`.

    Args:
        section, quantity: of the row.
        case: of the row; None: of all cases the largest value.
        solver: of the row.
        text: a format.
    """

    section: str
    case: str | None
    solver: str
    quantity: str
    text: str = "{:.2g} x FATROP"

    def read(self, rows: list[Row], commit: str) -> str:
        """The text, with the commit where that isn't this one; or that there is no such row."""
        wanted = (self.section, self.solver, self.quantity)
        found = [
            row
            for row in rows
            if (row["section"], row["solver"], row["quantity"]) == wanted
            and self.case in (None, row["case"])
            and row["value"] not in ("", "inf")
        ]
        if not found:
            return "not measured"
        row = max(found, key=lambda row: float(row["value"]))
        return self.text.format(float(row["value"])) + (f" (at {row['commit']})" if row["commit"] != commit else "")


def _family(case: str) -> Measured:
    return Measured("families", case, "fatrop / gco", "seconds, ratio")


def _acados(case: str, quantity: str, text: str) -> Measured:
    return Measured("families", case, "acados / gco", quantity, text)


def _seconds(case: str) -> Measured:
    return Measured("families", case, "gco", "seconds a problem", "{:.3f} s")


# What it is, what was measured, what was asked for, and what is aimed at.
TARGETS: tuple[tuple[str, tuple[Measured, ...], str, str], ...] = (
    ("forest30, B = 256", (_family("forest30, B = 256"), _seconds("forest30, B = 256")), "6 x FATROP", "10 x"),
    ("forest60, B = 256", (_family("forest60, B = 256"), _seconds("forest60, B = 256")), "6 x FATROP", "10 x"),
    ("forest30, B = 32", (_family("forest30, B = 32"), _seconds("forest30, B = 32")), "6 x FATROP", "10 x"),
    ("forest60, B = 32", (_family("forest60, B = 32"), _seconds("forest60, B = 32")), "6 x FATROP", "10 x"),
    (
        "forest30, B = 1, cold",
        (
            Measured("latency", "cold", "gco", "seconds fatrop / gco"),
            Measured("latency", "cold", "gco", "mean", "{:.0f} ms"),
        ),
        "4 x FATROP", "8 x",
    ),
    (
        "forest30, B = 256, acados",
        (
            _acados("forest30, B = 256", "seconds, ratio", "{:.2g} x"),
            _acados("forest30, B = 256", "per layout reached, ratio", "{:.2g} x per layout reached"),
        ),
        "2 x, 4 x per layout reached", "4 x, 8 x",
    ),
    (
        "one stage later, B = 1, warm",
        (
            Measured("latency", "warm", "gco", "seconds fatrop / gco"),
            Measured("latency", "warm", "gco", "mean", "{:.0f} ms"),
        ),
        "5 x FATROP", "10 ms",
    ),
    ("walls, B = 32", (_seconds("walls, B = 32"),), "0.25 s", "0.1 s"),
    ("planar_trap, B = 32", (_family("planar_trap, B = 32"), _seconds("planar_trap, B = 32")), "1 x FATROP", "0.15 s"),
    (
        "planar_random, B = 32", (_family("planar_random, B = 32"), _seconds("planar_random, B = 32")),
        "1 x FATROP", "0.15 s",
    ),
    (
        "a user's unicycle, B = 1",
        (Measured("own_model", "B = 1", "torchgco.solve", "seconds a problem", "{:.3f} s"),), "0.2 s", "0.05 s",
    ),
    (
        "planar_trap_paper, N = 1000, 8 problems",
        (Measured("paper", "planar_trap_paper, N = 1000, B = 8", "gco_paper", "all", "{:.1f} s"),), "60 s", "20 s",
    ),
    (
        "MPPI, S = 1000", (Measured("mppi", "S = 1000", "torchgco", "seconds pytorch-mppi / torchgco", "{:.2g} x"),),
        "8 x pytorch-mppi", "15 x",
    ),
    (
        "first use of a model, the slowest",
        (Measured("first_use", None, "torchgco.solve", "both", "{:.1f} s"),), "5 s", "2 s",
    ),
    (
        "import torchgco",
        (
            Measured("first_use", "import torchgco", "python", "seconds", "{:.1f} s"),
            Measured("first_use", "import torch", "python", "seconds", "import torch alone {:.1f} s"),
        ),
        "no slower", "",
    ),
)  # fmt: skip


def run(bench: Bench) -> None:
    rows, commit = [] if bench.results is None else _known(bench), bench.source.get("commit", "")
    for case, measured, asked, aim in TARGETS:
        texts = dict.fromkeys(one.read(rows, commit) for one in measured)  # each once
        bench.row(SECTION, case, "gco", "measured", "; ".join(texts))
        bench.row(SECTION, case, "gco", "asked", asked)
        bench.row(SECTION, case, "gco", "aim", aim)


def _known(bench: Bench) -> list[Row]:
    """This run's rows, and of the sections that it doesn't hold those that are kept; of its device."""
    assert bench.results is not None
    own = bench.results.rows
    present = {row["section"] for row in own}
    kept = [row for row in read_rows(bench.results.path) if row["section"] not in present]
    return [row for row in (*kept, *own) if row["device"] == bench.device]
