"""`torchgco new FOLDER`: a folder for an experiment of your own, to begin with; see docs/paper.md."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from torchgco.base.errors import InputError
from torchgco.experiments.ending import say

TEMPLATE = Path(__file__).parent / "template"
LEFT_OUT = ("__init__.py", "__pycache__")


def make(folder: Path) -> list[Path]:
    """Write the files of an experiment into a new or empty folder; returns their paths in it.

    Raises:
        InputError: the folder isn't empty, or the system refuses to write there.
    """
    whole = Path(os.path.abspath(folder))
    try:
        whole.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".torchgco-", dir=whole.parent) as around:
            made = Path(around) / "new"
            shutil.copytree(TEMPLATE, made, ignore=shutil.ignore_patterns(*LEFT_OUT), copy_function=shutil.copyfile)
            files = sorted(path.relative_to(made) for path in made.rglob("*") if path.is_file())
            if whole.is_dir() and not any(whole.iterdir()):  # kept, as it may be the current one
                for child in sorted(made.iterdir()):
                    child.rename(whole / child.name)
            else:
                made.rename(whole)
    except OSError as error:
        got = f"{folder} ({error.strerror or error})"
        raise InputError("torchgco new", "a new folder, or an empty one", got) from None
    return files


def main(words: Sequence[str]) -> int:
    """The command; returns 0."""
    if len(words) != 1 or not words[0] or words[0].startswith("-"):
        raise InputError("torchgco new", "the name of a folder to be made", " ".join(words) or "nothing")
    files = make(Path(words[0]))
    say("\n".join(str(Path(words[0]) / path) for path in files))
    say(f"\nNext: cd '{words[0]}', and the lines of README.md")
    return 0
