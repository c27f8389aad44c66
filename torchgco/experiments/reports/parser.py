"""The command line of programs that take the folder of a run."""

from __future__ import annotations

import argparse
from typing import NoReturn

from torchgco.base.errors import InputError


class RunParser(argparse.ArgumentParser):
    """Without the usage before an error: one line for every mistake."""

    def error(self, message: str) -> NoReturn:
        raise InputError("command line", "RUN and the options of --help", message)
