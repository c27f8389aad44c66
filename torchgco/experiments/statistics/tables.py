"""Summaries and comparisons as text: for a terminal, a paper or another program."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import pandas as pd

from torchgco.experiments.statistics.statistics import OUTCOMES, STATUS, TASK, task_columns

OUTPUTS = ("table", "csv", "markdown", "latex", "json")
# Where a spreadsheet finds a formula: where a cell begins, and where it would begin with another separator than the
# comma, which is read where the comma is that of decimals. The wide signs count in some languages.
FORMULA = re.compile(r"(^|[;\n\t])([^\S\n\t]*[=+\-@＝＋－＠])")
RATES_TEXT = "rates: attained of defined, share, [95 % Wilson interval]; -: undefined"
EFFORTS = "effort: median (90 % quantile); costs: where the goal was reached, everywhere, over the best known one"


def format_table(summary: pd.DataFrame, paired: pd.DataFrame) -> str:
    """The report for a terminal, some 120 columns wide: rates, effort, statuses and comparisons of each task.

    Args:
        summary, paired: as `summarise` and `compare` return them; `paired` may have no rows.

    A rate reads "30/32 94 % [80, 98]". Two lines at the end tell what the numbers in brackets and parentheses are.
    """
    blocks = per_task(summary, paired, "", (_rates, _effort, _statuses))
    return "\n\n".join([*blocks, f"{RATES_TEXT}\n{EFFORTS}"])


def per_task(
    summary: pd.DataFrame, paired: pd.DataFrame, what: str, tables: Sequence[Callable[..., str]], costs: bool = True
) -> list[str]:
    """The blocks of text of all tasks: `what` and the task, its tables, and comparisons where there are any.

    Args:
        tables: functions of the task's summary and its swept variables.
        costs: as of `paired_lines`.
    """
    blocks = []
    for (scenario, model), task in summary.groupby(TASK, sort=False, dropna=False):
        seeds, swept = ", ".join(dict.fromkeys(seed for held in task["seed"] for seed in held.split())), swept_of(task)
        blocks += [f"{what}{scenario} ({model}), seed {seeds}", *(table(task, swept) for table in tables)]
        rows = paired[(paired["scenario"] == scenario) & (paired["model"] == model)]
        if (rows["n"] > 0).any():
            blocks.append(paired_lines(rows, swept, costs))
    return blocks


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
    texts = {name: table[name].astype(object).map(_inert) for name in table.columns if _holds_text(table[name])}
    return table.assign(**texts).rename(columns=_inert).to_csv(index=False)


def _holds_text(column: pd.Series) -> bool:
    return not (pd.api.types.is_numeric_dtype(column) or pd.api.types.is_bool_dtype(column))


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
    short = (name.removeprefix("scenario.").removeprefix("model.vehicle.") for name in swept)
    return [name.split(".")[-1] if name.startswith(("mission.", "plant.")) else name for name in short]


def cells(row: pd.Series, swept: Sequence[str]) -> list[str]:
    """The values of the swept variables in a row; whole numbers that pandas holds as floats without a point."""
    values = (row[name] for name in swept)
    return ["-" if pd.isna(value) else f"{value:g}" if isinstance(value, float) else str(value) for value in values]


def per_solver(
    task: pd.DataFrame, swept: Sequence[str], heads: Iterable[str], values: Callable[[pd.Series], Sequence[str]]
) -> str:
    """A line for each row of a task's summary: swept variables, solver, and its values under their heads."""
    rows = [[*cells(row, swept), row["solver"], *values(row)] for _, row in task.iterrows()]
    return aligned([[*headers(swept), "solver", *heads], *rows], len(swept) + 1)


def _rates(task: pd.DataFrame, swept: Sequence[str]) -> str:
    return per_solver(task, swept, OUTCOMES, lambda row: [rate(row, name) for name in OUTCOMES])


def rate(row: pd.Series, name: str) -> str:
    """Attained of defined, and the share with its interval in percent."""
    if not row[f"{name}_n"]:
        return "-"
    share, low, high = (100 * row[f"{name}_{part}"] for part in ("rate", "low", "high"))
    return f"{row[f'{name}_count']}/{row[f'{name}_n']} {share:.0f} % [{low:.0f}, {high:.0f}]"


# Header in the terminal, column of the summary, column in parentheses, and how the numbers are written.
EFFORT_COLUMNS = (
    ("n", "n", None, "d"),
    ("invalid", "invalid", None, "d"),
    ("viol. ok", "violation_ok", None, ".0%"),
    ("violation", "violation_median", None, ".2g"),
    ("cost reached", "cost_median_reached", None, ".1f"),
    ("cost all", "cost_median", None, ".1f"),
    ("cost ratio", "cost_ratio_median", "cost_ratio_p90", ".3f"),
    ("iter.", "iterations_median", "iterations_p90", ".0f"),
    ("outer", "outer_iterations_median", "outer_iterations_p90", ".3g"),
    ("guided", "guided_median", "guided_p90", ".3g"),
    ("seconds", "seconds_median", "seconds_p90", ".2g"),
)
PAPER_COLUMNS = ("n", "cost ratio", "iter.", "seconds")  # of them, in a paper's table


def _measured(row: pd.Series, _: str, median: str, p90: str | None, form: str) -> str:
    """A cell of one of EFFORT_COLUMNS."""
    cells = ["-" if pd.isna(row[name]) else f"{row[name]:{form}}" for name in (median, p90) if name is not None]
    return cells[0] if len(cells) == 1 or cells[0] == "-" else f"{cells[0]} ({cells[1]})"


def _effort(task: pd.DataFrame, swept: Sequence[str]) -> str:
    heads = [header for header, *_ in EFFORT_COLUMNS]
    return per_solver(task, swept, heads, lambda row: [_measured(row, *how) for how in EFFORT_COLUMNS])


def _statuses(task: pd.DataFrame, swept: Sequence[str]) -> str:
    """How many trials ended with each status that occurs."""
    names = [name for name in task.columns if str(name).startswith(STATUS) and task[name].sum() > 0]
    heads = [name.removeprefix(STATUS) for name in names]
    return per_solver(task, swept, heads, lambda row: [str(row[name]) for name in names])


COUNTS = {"n": "n", "both": "both", "only_a": "first", "only_b": "second", "neither": "neither"}
PAIRED = ("paired", "outcome", *COUNTS.values(), "difference", "McNemar p", "left out", "cost ratio")


def paired_lines(rows: pd.DataFrame, swept: Sequence[str], costs: bool = True) -> str:
    """Comparisons for a terminal, with the swept variables `swept`; none without a trial that counts.

    Args:
        costs: False: without the ratio of costs.
    """
    width = len(PAIRED) if costs else len(PAIRED) - 1
    lines = [[*headers(swept), *PAIRED[:width]]]
    for _, row in rows[rows["n"] > 0].iterrows():
        lines.append([*cells(row, swept), *_pair(row)[:width]])
    return aligned(lines, len(swept) + 1)


def _pair(row: pd.Series) -> list[str]:
    difference = f"{100 * row['difference']:+.0f} points" if row["n"] else "-"
    p_value = f"{row['p_value']:.2g}" if row["n"] else "-"
    ratio = "-"
    if row["outcome"] == "reached" and row["cost_n"]:  # the same for every outcome
        ends = "" if pd.isna(row["cost_low"]) else f" [{row['cost_low']:.3f}, {row['cost_high']:.3f}]"
        ratio = f"{row['cost_ratio']:.3f}{ends}"
    pair, left_out = f"{row['solver_a']} - {row['solver_b']}", row["undefined"] + row["unmatched"]
    counts = [str(row[name]) for name in COUNTS]
    return [pair, row["outcome"], *counts, difference, p_value, str(left_out), ratio]


def printed(summary: pd.DataFrame, paired: pd.DataFrame) -> list[pd.DataFrame]:
    """The tables that a paper prints: rates and effort, and comparisons where there are any."""
    columns = [how for how in EFFORT_COLUMNS if how[0] in PAPER_COLUMNS]
    heads = [*OUTCOMES, *(header for header, *_ in columns)]
    rates = printed_rows(
        summary, heads,
        lambda row: [*(rate(row, name) for name in OUTCOMES), *(_measured(row, *how) for how in columns)],
    )  # fmt: skip
    return [rates, *([printed_pairs(paired)] if (paired["n"] > 0).any() else [])]


def printed_rows(summary: pd.DataFrame, heads: Sequence[str], values: Callable[[pd.Series], list[Any]]) -> pd.DataFrame:
    """A row for each row of a summary: its task, swept variables and solver, and values under their heads."""
    swept = swept_of(summary)
    rows = [
        [row["scenario"], row["model"], *cells(row, swept), row["solver"], *values(row)]
        for _, row in summary.iterrows()
    ]
    return pd.DataFrame(rows, columns=[*TASK, *headers(swept), "solver", *heads])


def printed_pairs(paired: pd.DataFrame) -> pd.DataFrame:
    """The comparisons that a paper prints: those with a trial that both flew and that defines the outcome."""
    paired = paired[paired["n"] > 0]
    swept = swept_of(paired)
    rows = [[row["scenario"], row["model"], *cells(row, swept), *_pair(row)] for _, row in paired.iterrows()]
    return pd.DataFrame(rows, columns=[*TASK, *headers(swept), *PAIRED])
