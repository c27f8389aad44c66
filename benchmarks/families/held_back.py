"""python -m benchmarks.families.held_back promise|reveal|check RELEASE: layouts that nobody knows before a release.

`promise` draws a secret and publishes its SHA-256 in `promises.csv` of the leaderboard, before entries are made; the
secret itself stays in `outputs/held_back`, which isn't published. `reveal` publishes the secret when the entries are
in, and draws each family of the leaderboard anew from it. `check` draws the layouts again and compares: anyone can.
"""

from __future__ import annotations

import re
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from secrets import token_hex
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from benchmarks.lib import ROOT
from benchmarks.lib.families import FAMILIES
from torchgco import InputError, compose

BOARD, SECRETS = ROOT / "benchmarks" / "board", ROOT / "outputs" / "held_back"
NAME = re.compile(r"[0-9A-Za-z][0-9A-Za-z.+-]*")
LAYOUTS = 32  # of each family, as many as are public
MOST_SEED = 10**18  # what a study takes as its seed


def promise(release: str, board: Path, secrets: Path) -> None:
    """Draw a secret for a release and publish its hash."""
    promises = _promises(board)
    if not NAME.fullmatch(release):  # it ends the name of the secret's file, which must not lie elsewhere
        raise InputError("release", "a version, as 0.2.0", release)
    if release in promises.index:
        raise InputError("release", "one that has no promise yet", release)
    secret = token_hex(32)
    secrets.mkdir(parents=True, exist_ok=True)
    with (secrets / f"{release}.txt").open("x") as file:  # a secret is never written over
        file.write(secret)
    promises.loc[release] = {"sha256": _digest(secret), "secret": ""}
    promises.to_csv(board / "promises.csv")


def reveal(release: str, board: Path, secrets: Path) -> None:
    """Publish the secret of a release and the layouts that are drawn from it."""
    promises, path = _promised(release, board), secrets / f"{release}.txt"
    if not path.is_file():
        raise InputError("release", f"its secret in {path}", "no such file")
    secret = path.read_text()
    if _digest(secret) != promises.loc[release, "sha256"]:
        raise InputError("release", f"in {path} the secret whose hash was published", "another one")
    draw(release, secret, board / "layouts")
    promises.loc[release, "secret"] = secret
    promises.to_csv(board / "promises.csv")


def check(release: str, board: Path) -> None:
    """Compare the published secret with its hash, and the published layouts with those that it leads to."""
    digest, secret = _promised(release, board).loc[release, ["sha256", "secret"]]
    if not secret:
        raise InputError("release", "one whose secret is published", f"{release}, which isn't revealed yet")
    if _digest(secret) != digest:
        raise InputError("release", "the secret whose hash was published", "another one")
    with TemporaryDirectory() as folder:
        for path in draw(release, secret, Path(folder)):
            published = board / "layouts" / path.name
            if not published.is_file() or not _equal(path, published):
                raise InputError("release", f"in {published} the layouts of its secret", "others")


def draw(release: str, secret: str, folder: Path) -> list[Path]:
    """Draw each family from a seed of its own that follows from the secret; returns the files."""
    paths = [folder / f"{name}-{release}.npz" for name in FAMILIES]
    folder.mkdir(parents=True, exist_ok=True)
    for path, family in zip(paths, FAMILIES.values(), strict=True):
        seed = int(_digest(f"{secret} {family.name}"), 16) % MOST_SEED
        compose([*family.overrides(LAYOUTS, seed)]).layouts().save(path)
    return paths


def _promises(board: Path) -> pd.DataFrame:
    path = board / "promises.csv"
    if not path.is_file():
        return pd.DataFrame({"sha256": [], "secret": []}, index=pd.Index([], name="release"), dtype=str)
    return pd.read_csv(path, dtype=str, keep_default_na=False).set_index("release")


def _promised(release: str, board: Path) -> pd.DataFrame:
    promises = _promises(board)
    if release not in promises.index:
        raise InputError("release", f"one in {board / 'promises.csv'}", release)
    return promises


def _digest(text: str) -> str:
    return sha256(text.encode()).hexdigest()


def _equal(path: Path, other: Path) -> bool:
    with np.load(path) as drawn, np.load(other) as published:
        return drawn.files == published.files and all(
            drawn[name].tobytes() == published[name].tobytes()
            for name in drawn  # NaN where there are fewer obstacles
        )


def main(words: Sequence[str] | None = None) -> int:
    parser = ArgumentParser(prog="python -m benchmarks.families.held_back", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", choices=("promise", "reveal", "check"))
    parser.add_argument("release", help="its version, which ends the names of its layouts")
    parser.add_argument("--board", type=Path, default=BOARD)
    parser.add_argument("--secrets", type=Path, default=SECRETS)
    asked = parser.parse_args(words)
    try:
        if asked.what == "promise":
            promise(asked.release, asked.board, asked.secrets)
        elif asked.what == "reveal":
            reveal(asked.release, asked.board, asked.secrets)
        else:
            check(asked.release, asked.board)
    except InputError as error:
        print(f"held_back: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
