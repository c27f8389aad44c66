"""Studies that benchmarks fly, each in a folder of its own: one that was stopped resumes where it was."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pandas as pd

from benchmarks.lib import ROOT


def torchgco(*words: str) -> None:
    """Run the command; raises CalledProcessError where it fails."""
    subprocess.run([sys.executable, "-m", "torchgco", *words], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def flown(folder: Path, *words: str) -> pd.DataFrame:
    """The trials of a study, flown now or read."""
    torchgco(*words, f"hydra.run.dir={folder}")
    return pd.read_parquet(folder / "trials.parquet")


def named(name: str) -> str:
    """A file's name: letters and digits, all else as hyphens."""
    return "".join(letter if letter.isalnum() else "-" for letter in name)
