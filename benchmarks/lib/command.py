"""The command line of a benchmark: its options, its table, and the page that the table goes into."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from typing import Any

import torch

from benchmarks.lib import RESULTS, page


def parser_of(doc: str | None, goal: str | None = None) -> ArgumentParser:
    """A parser with the name and description of a module, whose docstring begins with "COMMAND: what it does".

    Args:
        doc: the docstring.
        goal: what `--write` writes, below benchmarks; None: there is no such option.
    """
    command, _, what = (doc or "").split("\n")[0].partition(": ")
    parser = ArgumentParser(prog=command, description=what)
    if goal is not None:
        parser.add_argument("--write", action="store_true", help=f"put the result into benchmarks/{goal}")
    return parser


class Command:
    """A benchmark with a page of its own: `main = Command(...)`.

    Args:
        doc: the docstring of its module, see `parser_of`.
        name: of its page below results.
        text: the table in Markdown, and what follows it; called with the options by name.
        how: as of `page.measured`; the names of options in braces give their values.
        notes: further parts of the line above the table; "CasADi" gets its version.
        mark: name of the marks there, with options as in `how`; None: that of the page.
        options: default and help of each, and `choices` as a third; a sequence takes several values.
    """

    def __init__(
        self,
        doc: str | None,
        name: str,
        text: Callable[..., str],
        how: str,
        *notes: str,
        mark: str | None = None,
        **options: tuple[Any, ...],
    ) -> None:
        self.name, self.text, self.how, self.notes, self.mark = name, text, how, notes, mark or name
        self.parser = parser_of(doc, f"results/{name}.md")
        for option, (default, words, *choices) in options.items():
            several = isinstance(default, (list, tuple))
            kind = int if default is None else type(default[0] if several else default)
            self.parser.add_argument(
                f"--{option}", default=default, type=kind, nargs="+" if several else None, help=words,
                choices=choices[0] if choices else None, metavar="NAME" if choices else None,
            )  # fmt: skip

    def __call__(self, words: Sequence[str] | None = None) -> int:
        """Measure in one thread, print, and with `--write` put the text into the page; returns 0."""
        asked = vars(self.parser.parse_args(words))
        write = asked.pop("write")
        torch.set_num_threads(1)
        text = self.text(**asked)
        print(text)
        if write:
            said = {key: ", ".join(map(str, v)) if isinstance(v, (list, tuple)) else v for key, v in asked.items()}
            head = page.measured(self.how.format(**said), *self.notes)
            page.put(RESULTS / f"{self.name}.md", self.mark.format(**said), f"{head}\n\n{text}")
        return 0
