"""Rows as Markdown tables, and the parts of benchmarks/README.md and results/speed.md that hold them.

The page shows some quantities of a section (`SHOWN`); all rows are in results/speed.csv.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.lib.page import crossed, markdown, put
from benchmarks.speed.results import Row

NOT_MEASURED = "Not measured yet: `make benchmark` does."
NO_GPU = "No GPU was at hand: `make benchmark-gpu` measures `families`, `batch` and `mppi` where there is one."

# The text above each section's table, in the order of the page. The published pages repeat it.
WORDS = {
    "targets": "Time per problem. Under a peer's name: how many times as fast the solver is, per problem and,\n"
    "after the comma, per layout reached, as a peer that stops short of the goal may be fast.",
    "families": "Drawn layouts (seed 1000), of which the peers fly the first, before and after `gco`; the second\n"
    "table has each peer's seconds per problem / those of `gco`.",
    "latency": "One quadrotor forest problem at a time. `warm` is the problem one stage later: both start from the\n"
    "rest of the solution and from their own multipliers; `compile` is the same step by a compiled problem.\n"
    "Set-up does not count: `gco` traces the model and finds its kernels, `compile` makes its first solve, FATROP's\n"
    "program is built.",
    "loop": "A car (4 states, 2 controls, RK4) follows a reference between two discs, 20 stages of 0.1 s: time of a\n"
    "period, without the first five. FATROP and IPOPT are written by hand, to 1e-6, and keep their multipliers;\n"
    "`compile` solves to 1e-8. Disturbed cars meet discs in their way. `solved` counts periods in which all\n"
    "cars are.",
    "endless": "Loops that don't end: the resident memory of a process whose `MPC` drives a disturbed car, and the\n"
    "processor time of compilers that it starts; steps of the environment of missions, without a planner.",
    "swing_up": "A cart-pole (4 states, 1 control, RK4, both bounded) swings up and stays, 75 stages of 0.02 s, 200\n"
    "periods from each of several starts near rest, disturbed in every period: time of a period but the first,\n"
    "and of that. `up` counts starts that end within 0.2 of the upright rest.",
    "learned": "A user's models: first solves in a new process by `gco`, with an empty cache, and with one where\n"
    "another model has been solved; the interior point's time per iteration with networks (tanh); training steps,\n"
    "each a solve, a gradient of the model's error and a step; first solves of code that isn't traced.",
    "own_model": "A user's unicycle (4 states, 2 controls, a Python function, RK4), 100 stages, five discs,\n"
    "`torchgco.solve` without options.",
    "paper": "The paper's planar problem by the paper's method: a thousand stages, three circles;\n"
    "the problems differ in their random draws.",
    "mppi": "Milliseconds of one round of white noise around hovering, 30 spheres, float32, B = 1; medians.",
    "first_use": "A first solve in a new process: the model traced, differentiated, written out as C and compiled,\n"
    "and what the first solve takes more than the second, in processor seconds, the compiler's included.",
    "share": "Time of one solve, in percent, by phase of the method, in a process that has solved other problems.",
    "cores": "Elapsed time per problem of forests of 30 spheres, in processes with one core and with two.",
    "batch": "Forests of 30 spheres, unless the row names other worlds. `2 outer` ends every problem after two outer\n"
    "iterations. Memory is the peak of a separate process above its memory before the problems were made.",
    "scaling": "Seconds per problem: whole solves of forests, 16 layouts in a batch, and the first four of them by\n"
    "the peers, from the vehicle at rest; 30 spheres and 100 stages unless the row says otherwise. Stages\n"
    "divide the same 5 s, spheres fill the same region; the far ones lie 12 m and more beside it.",
    "growth": "Milliseconds per problem and iteration, line search included. Quadrotor (n = 14), 100 stages, 30\n"
    "spheres unless the row says otherwise; more stages divide the same 5 s. The planar vehicle has n = 6.",
}

# What the page shows of a section: quantities, the only solver (empty: all), and whether there is a column per solver
# instead of one per quantity.
PEERS = ("FATROP", "acados", "pytorch-mppi")
SHOWN = {
    "targets": [(("time", *PEERS), "", False)],
    "families": [
        (("seconds per problem", "reached", "median cost"), "gco", False),
        (("seconds, ratio",), "", True),
    ],
    "loop": [(("median", "99 %", "solved"), "", False)],
    "endless": [
        (("memory after 100 steps", "memory at the end", "compilers after the first step"), "", False),
        (("steps per second",), "", False),
    ],
    "swing_up": [(("median", "99 %", "first period", "up"), "", False)],
    "learned": [
        (("first solve, nothing built", "first solve, solver's objects built"), "", False),
        (("an iteration",), "", True),
        (("training step, median",), "", True),
        (("first solve",), "", True),
    ],
    "mppi": [(("per round",), "", True)],
}
LEFT_OUT = (
    "latency",
    "own_model",
    "first_use",
    "paper",
    "share",
    "cores",
    "batch",
    "scaling",
    "growth",
)  # of the page: the file alone has them


def section_text(rows: list[Row]) -> str:
    """What the page shows of the rows of one section."""
    tables = []
    for quantities, solver, peers in SHOWN.get(rows[0]["section"], []):
        held = [row for row in rows if row["quantity"] in quantities and solver in ("", row["solver"])]
        tables += [(peers_table if peers else section_table)(held)] if held else []
    return "\n\n".join(tables) or section_table(rows)


def peers_table(rows: list[Row]) -> str:
    """A row per case, a column per solver."""
    long = [[row["case"], f"`{row['solver']}`", _rounded(row["value"])] for row in rows]
    table = crossed(markdown(["case", "solver", "value"], long), "case", "solver", "value")
    return table.replace("| case |", f"| {_head(rows[0])} |", 1)


def section_table(rows: list[Row]) -> str:
    """A Markdown table: a row per case and solver, a column per quantity, in the order of measurement.

    The column of solvers is left out where there is one.
    """
    lines = dict.fromkeys((row["case"], row["solver"]) for row in rows)
    heads = dict.fromkeys(_head(row) for row in rows)
    cells = {(row["case"], row["solver"], _head(row)): _rounded(row["value"]) for row in rows}
    values = ([case, f"`{solver}`", *(cells.get((case, solver, head), "") for head in heads)] for case, solver in lines)
    one = len({solver for _, solver in lines}) == 1
    return markdown(["case", *["solver"] * (not one), *heads], ([v[0], *v[1 + one :]] for v in values))


def _rounded(value: str) -> str:
    """A number with three digits; other text unchanged."""
    try:
        number = float(value)
    except ValueError:
        return value or "-"
    return f"{number:.3g}" if abs(number) < 100 else f"{number:.0f}"


def _head(row: Row) -> str:
    return row["quantity"] + (f", {row['unit']}" if row["unit"] else "")


def targets_text(rows: list[Row]) -> str:
    """The compact table of what peers have solved, too, with its source."""
    own = [row for row in rows if row["section"] == "targets" and row["device"] == "cpu"]
    cases = {row["case"] for row in own if row["quantity"] in PEERS}
    own = [row for row in own if row["case"] in cases]
    return f"{_when(own[0])}{_how(own[0])}.\n{WORDS['targets']}\n\n{section_text(own)}" if own else NOT_MEASURED


def speed_text(rows: list[Row]) -> str:
    """All other tables."""
    rest = [row for row in rows if row["section"] != "targets"]
    blocks = [_device_text([row for row in rest if row["device"] == "cpu"]) or NOT_MEASURED]
    graphics = _device_text([row for row in rest if row["device"] == "cuda"])
    return "\n\n".join([*blocks, f"## Speed on a GPU\n\n{graphics}" if graphics else NO_GPU])


def _device_text(rows: list[Row]) -> str:
    """Tables of one device; a line on the source precedes a section where it differs from the section before."""
    blocks, before = [], ("", "")
    present = {row["section"] for row in rows}
    for section in [name for name in WORDS if name in present and name not in LEFT_OUT]:
        own = [row for row in rows if row["section"] == section]
        source = when, how = _when(own[0]), _how(own[0])
        blocks += [f"{when}{how if how != before[1] else ', all else as above'}."] if source != before else []
        blocks.append(f"### `{section}`\n\n{WORDS[section]}\n\n{section_text(own)}")
        before = source
    return "\n\n".join(blocks)


def _when(row: Row) -> str:
    return f"Measured on {row['date']} at commit {row['commit']}"


def _how(row: Row) -> str:
    where = "one core, one thread" if row["device"] == "cpu" else "one GPU"
    return (
        f", {row['processor']}, {where}; torch {row['torch']}, "
        f"CasADi {row['casadi']}, pytorch-mppi {row['pytorch_mppi']}, acados (comma-deps-acados) "
        f"{row['acados'] or 'not installed'}"
    )


def rewrite(folder: Path, rows: list[Row]) -> None:
    """Put the tables between their marks in the folder's README.md and results/speed.md."""
    put(folder / "README.md", "targets", targets_text(rows))
    put(folder / "results" / "speed.md", "speed", speed_text(rows))
