"""Tables of sentences; a module of its own, as pandas takes long to load."""

from __future__ import annotations

from textwrap import fill

import pandas as pd

TEXT_WIDTH = 100  # letters of a line


class Sentences(pd.DataFrame):
    """A table whose last column is long: printed whole, below the others of its row, where pandas would cut it."""

    def __repr__(self) -> str:
        lines = []
        for *short, text in self.itertuples():
            lines.append("  ".join(map(str, short)))
            lines.append(fill(str(text), TEXT_WIDTH, initial_indent="    ", subsequent_indent="    "))
        return "\n".join(lines)

    def _repr_html_(self) -> str | None:
        with pd.option_context("display.max_colwidth", None):
            return super()._repr_html_()
