"""`make study` installs a C compiler where the machine has none, and says so. Nothing is downloaded here."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ("sh", "touch", "echo")
# In place of the environment's Python: notes what pip is asked for; the extra can be installed, or not; runs all else.
PYTHON = """#!/bin/sh
if [ "$2" = pip ]; then echo "$@" >> {log}; case "$*" in *native*) exit {code};; *) exit 0;; esac; fi
exec {python} "$@"
"""
CC = "#!/bin/sh\necho cc 1.0\n"

pytestmark = pytest.mark.skipif(
    shutil.which("make") is None or find_spec("ziglang") is not None, reason="no make, or zig is a compiler everywhere"
)


def script(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


def make_study(folder: Path, compiler: bool = False, code: int = 0, **environment: str) -> tuple[str, list[str]]:
    """What `make study` prints, and its calls of pip, which ends with this code for the extra."""
    log = folder / "log"
    log.touch()
    script(folder / "venv" / "bin" / "python", PYTHON.format(log=log, code=code, python=sys.executable))
    script(folder / "venv" / "bin" / "torchgco", "#!/bin/sh\necho flown\n")
    (folder / "bin").mkdir()
    for name in TOOLS:
        (folder / "bin" / name).symlink_to(str(shutil.which(name)))
    if compiler:
        script(folder / "bin" / "cc", CC)
    kept = {name: value for name, value in os.environ.items() if name not in ("CC", "TORCHGCO_CC", "MAKEFLAGS")}
    done = subprocess.run(
        [str(shutil.which("make")), "study", f"VENV={folder / 'venv'}"], cwd=ROOT, capture_output=True, text=True,
        env={**kept, "PATH": str(folder / "bin"), "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **environment},
    )  # fmt: skip
    assert done.returncode == 0 and "flown" in done.stdout, done.stderr
    return done.stdout, log.read_text().splitlines()


@pytest.mark.slow
def test_a_machine_without_a_compiler_gets_one(tmp_path: Path) -> None:
    said, calls = make_study(tmp_path)
    assert "No C compiler found: installing the extra native, which brings one." in said
    assert [call.split()[-1] for call in calls] == [".", ".[native]"]


@pytest.mark.slow
def test_a_machine_with_a_compiler_gets_none(tmp_path: Path) -> None:
    said, calls = make_study(tmp_path, compiler=True)
    assert "No C compiler" not in said and [call.split()[-1] for call in calls] == ["."]


def test_who_names_a_compiler_or_wants_none_gets_none(tmp_path: Path) -> None:
    _, calls = make_study(tmp_path, TORCHGCO_CC="none")
    assert [call.split()[-1] for call in calls] == ["."]


@pytest.mark.slow
def test_an_extra_that_cannot_be_installed_does_not_stop_the_study(tmp_path: Path) -> None:
    said, calls = make_study(tmp_path, code=1)
    assert "It can't be installed here" in said and len(calls) == 2
