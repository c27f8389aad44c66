"""A report on trajectories and missions as text: for a terminal, a paper or another program."""

from __future__ import annotations

import json
from collections.abc import Sequence

import pandas as pd

from torchgco.experiments.results.kinds import MISSION, Part, joined
from torchgco.experiments.statistics.mission_tables import format_missions, printed_missions
from torchgco.experiments.statistics.tables import format_frame, format_table, printed


def format_report(parts: Sequence[Part], form: str) -> str:
    """The statistics of all kinds of trials, in one of `tables.FORMATS`.

    csv             the summary with all its columns
    json            all columns of both tables, under "summary" and "paired"; null where a number is undefined
    markdown, latex the columns that a paper prints, of both tables, for each kind
    table           as `format_table` and `format_missions`
    """
    if form == "table":
        return "\n\n".join(_text(part) for part in parts)
    if form in ("csv", "json"):
        tables = joined(parts)
        if form == "csv":
            return format_frame(tables["summary"], form)
        return json.dumps({name: json.loads(format_frame(table, form)) for name, table in tables.items()}, indent=1)
    return "\n\n".join(format_frame(table, form) for part in parts for table in _printed(part))


def _text(part: Part) -> str:
    return (format_missions if part.kind == MISSION else format_table)(part.summary, part.paired)


def _printed(part: Part) -> list[pd.DataFrame]:
    return (printed_missions if part.kind == MISSION else printed)(part.summary, part.paired)
