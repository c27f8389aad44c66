"""The command line of programs that take the folder of a run."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import NoReturn

from torchgco.base.errors import InputError
from torchgco.experiments.ending import ended

TRUST = "admit any size in a run's files, and any class, such as a model of yours: its code runs"


class RunParser(argparse.ArgumentParser):
    """Takes `--trust` where files are read, and shows no usage before an error: one line for every mistake."""

    def __init__(self, prog: str, description: str, takes: str = "RUN", trusts: bool = True) -> None:
        super().__init__(prog=prog, description=description)
        self.takes = takes
        if trusts:
            self.add_argument("--trust", action="store_true", help=TRUST)

    def error(self, message: str) -> NoReturn:
        raise InputError("command line", f"{self.takes} and the options of --help", message)

    def run(self, arguments: Sequence[str] | None, work: Callable[[argparse.Namespace], int]) -> int:
        """Do the work of the program with its options; returns the exit code, see `ended`."""
        return ended(self.prog, lambda: work(self.parse_intermixed_args(arguments)))
