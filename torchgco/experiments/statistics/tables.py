"""Summaries and comparisons as text: for a terminal, a paper or another program."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from torchgco.experiments.statistics.statistics import STATUS, TASK, task_columns

OUTPUTS = ("table", "csv", "markdown", "latex", "json")
# Where a spreadsheet finds a formula: where a cell begins, and where it would begin with another separator than the
# comma, which is read where the comma is that of decimals. The wide signs count in some languages.
FORMULA = re.compile(r"(^|[;\n\t])([^\S\n\t]*[=+\-@＝＋－＠])")
RATES_TEXT = "rates: attained of defined, share, [95 % Wilson interval]; -: undefined"
Cell = Callable[[pd.Series], str]  # of a row of a summary, or of comparisons
Columns = dict[str, Cell]  # by their heads


@dataclass(frozen=True)
class Kind:
    """A kind of trials: its name, its statistics, and what texts and papers show of these.

    Args:
        rates, effort: columns of its summary.
        paper: those of `effort` that a paper prints.
        compared: columns of comparisons.
        notes: what is said below all tables.
        of: said before the name of a task.
        statuses: whether statuses are counted in a table of their own.
        effort_note: what is said below the effort of a task, from its summary.
        more_rates, more_effort: further columns of these, from a summary.
    """

    name: str
    summarise: Callable[[pd.DataFrame], pd.DataFrame]
    rates: Columns
    effort: Columns
    paper: Sequence[str]
    compared: Columns
    notes: str
    of: str = ""
    statuses: bool = False
    effort_note: Callable[[pd.DataFrame], str] = lambda task: ""
    more_rates: Callable[[pd.DataFrame], Columns] = lambda task: {}
    more_effort: Callable[[pd.DataFrame], Columns] = lambda task: {}

    def text(self, summary: pd.DataFrame, paired: pd.DataFrame) -> str:
        """The report for a terminal, some 120 columns wide: rates, effort, statuses and comparisons of each task.

        Args:
            summary, paired: as `summarise` and `compare` return them; `paired` may have no rows.

        A rate reads "30/32 94 % [80, 98]". Lines at the end tell what the numbers in brackets and parentheses are.
        """
        blocks = []
        for (scenario, model), task in summary.groupby(TASK, sort=False, dropna=False):
            seeds, swept = dict.fromkeys(seed for text in task["seed"] for seed in text.split()), swept_of(task)
            blocks.append(f"{self.of}{scenario} ({model}), seed {', '.join(seeds)}")
            blocks.append(_lines(task, swept, solver() | self.rates | self.more_rates(task)))
            blocks.append(_lines(task, swept, solver() | self.effort | self.more_effort(task)) + self.effort_note(task))
            if self.statuses:
                blocks.append(_lines(task, swept, solver() | _statuses(task)))
            rows = paired[(paired["scenario"] == scenario) & (paired["model"] == model) & (paired["n"] > 0)]
            blocks += [_lines(rows, swept, self.compared)] if len(rows) else []
        return "\n\n".join([*blocks, self.notes])

    def printed(self, summary: pd.DataFrame, paired: pd.DataFrame) -> list[pd.DataFrame]:
        """The tables that a paper prints: rates and effort, and comparisons where there are any."""
        effort = {head: self.effort[head] for head in self.paper}
        rates = solver() | self.rates | self.more_rates(summary)
        tables = [_printed(summary, rates | effort), _printed(paired[paired["n"] > 0], self.compared)]
        return [table for table in tables if len(table)]


def solver() -> dict[str, Cell]:
    """The column that names the solver of a row."""
    return {"solver": lambda row: row["solver"]}


def number(form: str, *names: str) -> Cell:
    """Numbers of a row, written in one form; "-" where the first is undefined."""
    return lambda row: "-" if pd.isna(row[names[0]]) else form.format(*(row[name] for name in names))


def rate(name: str) -> Cell:
    """Attained of defined, and the share with its interval in percent."""

    def cell(row: pd.Series) -> str:
        if not row[f"{name}_n"]:
            return "-"
        share, low, high = (100 * row[f"{name}_{suffix}"] for suffix in ("rate", "low", "high"))
        return f"{row[f'{name}_count']}/{row[f'{name}_n']} {share:.0f} % [{low:.0f}, {high:.0f}]"

    return cell


def cost_ratio(row: pd.Series) -> str:
    """The ratio of costs of two solvers with its interval, which is the same for every outcome."""
    if row["outcome"] != "reached" or not row["cost_n"]:
        return "-"
    ends = "" if pd.isna(row["cost_low"]) else f" [{row['cost_low']:.3f}, {row['cost_high']:.3f}]"
    return f"{row['cost_ratio']:.3f}{ends}"


COUNTS = {"n": "n", "both": "both", "first": "only_a", "second": "only_b", "neither": "neither"}
PAIR_CELLS: Columns = {
    "paired": lambda row: f"{row['solver_a']} - {row['solver_b']}",
    "outcome": lambda row: row["outcome"],
    **{head: number("{}", name) for head, name in COUNTS.items()},
    "difference": lambda row: f"{100 * row['difference']:+.0f} points",
    "McNemar p": number("{:.2g}", "p_value"),
    "left out": lambda row: str(row["undefined"] + row["unmatched"]),
}


def _statuses(task: pd.DataFrame) -> Columns:
    """How many trials ended with each status that occurs."""
    names = [str(name) for name in task.columns if str(name).startswith(STATUS) and task[name].sum() > 0]
    return {name.removeprefix(STATUS): number("{}", name) for name in names}


def _lines(rows: pd.DataFrame, swept: Sequence[str], columns: Columns) -> str:
    """A line for each row: the values of swept variables, and its cells under their heads; the first flush left."""
    text = [[*cells(row, swept), *(cell(row) for cell in columns.values())] for _, row in rows.iterrows()]
    return aligned([[*headers(swept), *columns], *text], len(swept) + 1)


def _printed(rows: pd.DataFrame, columns: Columns) -> pd.DataFrame:
    """A row for each row, with its task and swept variables before its cells."""
    swept = swept_of(rows)
    table = [
        [row["scenario"], row["model"], *cells(row, swept), *(cell(row) for cell in columns.values())]
        for _, row in rows.iterrows()
    ]
    return pd.DataFrame(table, columns=[*TASK, *headers(swept), *columns])


def format_frame(table: pd.DataFrame, form: str) -> str:
    """One table in one of OUTPUTS, its cells as they are but for what the format itself would read."""
    if form == "csv":
        return csv_text(table).rstrip("\n")
    if form == "json":
        return table.to_json(orient="records", double_precision=15, indent=1) or "[]"
    if form == "latex":
        return table.to_latex(index=False, escape=True).rstrip("\n")
    text = [[str(name) for name in table.columns], *table.astype(str).to_numpy().tolist()]
    left = sum(not pd.api.types.is_numeric_dtype(kind) for kind in table.dtypes[:1])
    if form == "table":
        return aligned(text, left)
    text = [[re.sub(r"[\\|<]", r"\\\g<0>", " ".join(cell.split())) for cell in row] for row in text]
    return "\n".join("| " + " | ".join(row) + " |" for row in [text[0], ["---"] * len(text[0]), *text[1:]])


def csv_text(table: pd.DataFrame) -> str:
    """A table as CSV.

    Names come from configurations and files of others: an apostrophe stands before what a spreadsheet would compute.
    Numbers, also those held as text, stay what they are.
    """
    holding = table.select_dtypes(exclude=["number", "bool", "boolean"])
    texts = {name: holding[name].astype(object).map(_inert) for name in holding.columns}
    return table.assign(**texts).rename(columns=_inert).to_csv(index=False)


def _inert(cell: Any) -> Any:
    if not isinstance(cell, str):
        return cell
    cell = cell.replace("\r", "\n")  # which is quoted; a carriage return would begin another row
    try:
        float(cell)
    except ValueError:
        return FORMULA.sub(r"\1'\2", cell)
    return cell


def aligned(rows: Sequence[Sequence[str]], left: int) -> str:
    """Rows as lines of columns: the first `left` flush left, the others flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = list(zip(row, widths, strict=True))
        names = [cell.ljust(width) for cell, width in cells[:left]]
        lines.append("  ".join([*names, *(cell.rjust(width) for cell, width in cells[left:])]))
    return "\n".join(lines)


def swept_of(table: pd.DataFrame) -> list[str]:
    """Swept variables that have a value somewhere in the table."""
    return [name for name in task_columns(table)[len(TASK) :] if table[name].notna().any()]


def headers(swept: Sequence[str]) -> list[str]:
    """Swept variables as column heads: without the group of the key; of missions the last part alone."""
    short = (name.removeprefix("scenario.").removeprefix("model.").removeprefix("vehicle.") for name in swept)
    return [name.split(".")[-1] if name.startswith(("mission.", "plant.")) else name for name in short]


def cells(row: pd.Series, swept: Sequence[str]) -> list[str]:
    """The values of the swept variables in a row; whole numbers that pandas holds as floats without a point."""
    values = (row[name] for name in swept)
    return ["-" if pd.isna(value) else f"{value:g}" if isinstance(value, float) else str(value) for value in values]
