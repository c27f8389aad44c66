"""The command line of a benchmark: its module's docstring begins with the command, a colon and what it does."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

import torch

from benchmarks.lib import page


def parser_of(doc: str | None, goal: str | None = None) -> ArgumentParser:
    """A parser with the name and description of the module.

    Args:
        doc: the module's docstring.
        goal: what `--write` writes; None: there is no such option.
    """
    command, _, what = (doc or "").split("\n")[0].partition(": ")
    parser = ArgumentParser(prog=command, description=what)
    if goal is not None:
        parser.add_argument("--write", action="store_true", help=f"put the table into benchmarks/{goal}")
    return parser


def one_thread() -> None:
    """All times are those of one thread."""
    torch.set_num_threads(1)


def show(asked: Namespace, name: str, text: str, how: str, *notes: str) -> int:
    """Print the result of a benchmark, and with `--write` put it into its page below results; returns 0.

    Args:
        asked: the options, `write` among them.
        name: of the page, and of the marks in it.
        text: the table, in Markdown, and what follows it.
        how, notes: see `page.measured`.
    """
    print(text)
    if asked.write:
        page.put(page.RESULTS / f"{name}.md", name, f"{page.measured(how, *notes)}\n\n{text}")
    return 0
