"""The compact table: results of the other sections, from this run or a former run, compared with the peers."""

from __future__ import annotations

from dataclasses import dataclass, field

from benchmarks.speed.bench import Bench
from benchmarks.speed.results import Row, read_rows

SECTION = "targets"
NOT_MEASURED = "not measured"
BEFORE = "67fc464"  # on another processor: only its ratios compare


@dataclass(frozen=True)
class Measured:
    """A row of another section; its value goes into `text` for the table.

    Args:
        section, quantity: of the row.
        case: of the row; None: the case with the largest value.
        solver: of the row.
        text: a format; {} shows two significant digits, from 100 on a whole number.
    """

    section: str
    case: str | None
    solver: str
    quantity: str
    text: str

    def read(self, rows: list[Row], commit: str) -> str:
        """The text, followed by the commit where it isn't this run's; NOT_MEASURED where there is no such row."""
        wanted = (self.section, self.solver, self.quantity)
        found = [
            row
            for row in rows
            if (row["section"], row["solver"], row["quantity"]) == wanted
            and self.case in (None, row["case"])
            and row["value"] not in ("", "inf")
        ]
        if not found:
            return NOT_MEASURED
        row = max(found, key=lambda row: float(row["value"]))
        value = float(row["value"])
        number = (f"{value:.2g}" if value < 100 else f"{value:.0f}") if "{}" in self.text else value
        return self.text.format(number) + (f" (at {row['commit']})" if row["commit"] != commit else "")


def _ratios(case: str, peer: str) -> tuple[Measured, Measured]:
    """Ratios of seconds per problem, and per layout reached, as a peer that stops short of the goal may be fast."""
    source = "families", case, f"{peer} / gco"
    return Measured(*source, "seconds, ratio", "{} x"), Measured(*source, "per layout reached, ratio", "{} x")


def _seconds(case: str) -> Measured:
    return Measured("families", case, "gco", "seconds per problem", "{:.3f} s")


@dataclass(frozen=True)
class Target:
    """A line of the table: a case, its times, and their ratios to peers.

    Args:
        case, solver: the line's name.
        times: rows with the times of the case.
        ratios: by peer, rows that divide the peer's time by it.
        before: what this table said at commit `BEFORE`, of time and ratios.
        aim: what we want of time or ratios.
    """

    case: str
    solver: str
    times: tuple[Measured, ...]
    ratios: dict[str, tuple[Measured, ...]] = field(default_factory=dict)
    before: str = ""
    aim: str = ""


def _batch(case: str, before: str = "", aim: str = "") -> Target:
    ratios = {"FATROP": _ratios(case, "fatrop"), "acados": _ratios(case, "acados")}
    return Target(case, "gco", (_seconds(case),), ratios, before, aim)


def _latency(case: str, kind: str, before: str, aim: str, solver: str = "gco") -> Target:
    ratio = Measured("latency", kind, solver, f"seconds fatrop / {solver}", "{} x")
    longest = Measured("latency", kind, solver, "longest", "longest {:.0f} ms")
    times = (Measured("latency", kind, solver, "mean", "{:.0f} ms"), longest)
    return Target(case, solver, times, {"FATROP": (ratio,)}, before, aim)


def _times_typical(case: str, before: str, aim: str) -> Target:
    times = Measured("scaling", case, "gco", "times 30 spheres", "{} x the time of 30 spheres")
    return Target(f"{case}, B = 16", "gco", (times,), {}, before, aim)


TARGETS = (
    _batch("forest30, B = 256", "0.013 s, FATROP 22 x", "FATROP 30 x"),
    _batch("forest60, B = 256", "0.024 s, FATROP 17 x", "FATROP 30 x"),
    _batch("forest30, B = 32"),
    _batch("forest60, B = 32"),
    _batch("walls, B = 32", "0.068 s, FATROP 51 x", "FATROP 80 x"),
    _batch("planar_trap, B = 32", "0.139 s, acados 0.55 x, 4.4 x", "acados 1.2 x, 9 x"),
    _batch("planar_random, B = 32", "0.290 s, acados 0.52 x, 0.78 x", "acados 1.2 x, 1.8 x"),
    _latency("forest30, B = 1, cold", "cold", "62 ms, longest 182 ms, FATROP 5.4 x", "longest 25 ms, FATROP 12 x"),
    _latency("forest30, B = 1, one stage later, warm", "warm", "12 ms, FATROP 5.6 x", "5 ms, FATROP 12 x"),
    _latency("forest30, B = 1, one stage later", "warm", "", "5 ms, FATROP 12 x", solver="compile"),
    Target(
        "woods40, B = 8", "gco", (Measured("batch", "woods40, B = 8", "gco", "per problem", "{:.0f} ms"),),
        before="920 ms", aim="250 ms",
    ),
    Target(
        "memory of woods60, B = 8", "gco",
        (Measured("batch", "woods60, B = 8", "gco", "memory per problem", "{:.1f} MiB per problem"),),
        before="25 MiB", aim="4 MiB",
    ),
    _times_typical("500 spheres", "7.8 x", "2 x"),
    _times_typical("30 spheres and 470 far", "9.6 x", "2 x"),
    Target(
        "two threads, B = 256", "gco",
        (Measured("cores", "B = 256, threads: 2", "gco", "times one thread", "{} x as fast as one, by elapsed time"),),
        before="", aim="1.8 x",
    ),
    Target(
        "a user's unicycle, B = 1", "torchgco.solve",
        (Measured("own_model", "B = 1", "torchgco.solve", "seconds per problem", "{:.3f} s"),),
        before="0.113 s", aim="0.025 s",
    ),
    Target(
        "planar_trap_paper, N = 1000, all of 8 problems", "gco_paper",
        (Measured("paper", "planar_trap_paper, N = 1000, B = 8", "gco_paper", "all", "{:.1f} s"),),
    ),
    Target(
        "one round of MPPI, S = 1000", "torchgco",
        (Measured("mppi", "S = 1000", "torchgco", "per round", "{:.1f} ms"),),
        {"pytorch-mppi": (Measured("mppi", "S = 1000", "torchgco", "seconds pytorch-mppi / torchgco", "{} x"),)},
    ),
    Target(
        "first use of a model, the slowest", "torchgco.solve",
        (Measured("first_use", None, "torchgco.solve", "both", "{:.1f} s"),),
        before="2.6 s", aim="1 s",
    ),
    Target(
        "import torchgco", "python",
        (
            Measured("first_use", "import torchgco", "python", "seconds", "{:.1f} s"),
            Measured("first_use", "import torch", "python", "seconds", "import torch alone {:.1f} s"),
        ),
    ),
)  # fmt: skip


def run(bench: Bench) -> None:
    rows, commit = [] if bench.results is None else _known(bench), bench.source.get("commit", "")
    for target in TARGETS:
        for quantity, measured in {"time": target.times, **target.ratios}.items():
            bench.row(SECTION, target.case, target.solver, quantity, ", ".join(_texts(measured, rows, commit)))
        for quantity, text in ((f"at {BEFORE}", target.before), ("aim", target.aim)):
            if text:
                bench.row(SECTION, target.case, target.solver, quantity, text)


def _texts(measured: tuple[Measured, ...], rows: list[Row], commit: str) -> list[str]:
    texts = [one.read(rows, commit) for one in measured]
    return texts[:1] if set(texts) == {NOT_MEASURED} else texts


def _known(bench: Bench) -> list[Row]:
    """Rows of this run's device: its own, and for all other sections the kept rows."""
    assert bench.results is not None
    own = bench.results.rows
    present = {row["section"] for row in own}
    kept = [row for row in read_rows(bench.results.path) if row["section"] not in present]
    return [row for row in (*kept, *own) if row["device"] == bench.device]
