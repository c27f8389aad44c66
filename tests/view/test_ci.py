"""`.ci/run` installs a Chromium where it may, or says in one line why not. Nothing is downloaded here."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from benchmarks.picture import BROWSERS

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ("bash", "env", "grep", "sh", "tail", "timeout")
NO_MIRROR = "#!/bin/sh\necho 'E: Unable to fetch some archives' >&2\nexit 100\n"


def installed(folder: Path, user: int, apt: str | None) -> tuple[str, str]:
    """What `.ci/browser` prints as this user with this apt-get, and the words that apt-get was called with."""
    for name in TOOLS:
        (folder / name).symlink_to(str(shutil.which(name)))
    for name, text in {"id": f"#!/bin/sh\necho {user}\n", "apt-get": apt}.items():
        if text is not None:
            (folder / name).write_text(text.format(folder=folder))
            (folder / name).chmod(0o755)
    call = [str(ROOT / ".ci" / "browser")]
    done = subprocess.run(call, env={"PATH": str(folder)}, capture_output=True, text=True, check=True, timeout=60)
    assert not done.stderr
    return done.stdout, (folder / "log").read_text() if (folder / "log").exists() else ""


INSTALLS = """#!/bin/sh
echo "$@" >> {folder}/log
case "$1" in install) echo '#!/bin/sh' > {folder}/chromium; {chmod} +x {folder}/chromium;; esac
""".replace("{chmod}", str(shutil.which("chmod")))
REASONS = {
    "no root": (1000, INSTALLS, "only root can install one"),
    "no apt": (0, None, "there is no apt-get"),
    "no mirror": (0, NO_MIRROR, "E: Unable to fetch some archives"),
}


@pytest.mark.parametrize("case", REASONS)
def test_one_line_says_why_there_is_no_browser(case: str, tmp_path: Path) -> None:
    user, apt, reason = REASONS[case]
    told, called = installed(tmp_path, user, apt)
    assert told == f".ci/browser: no Chromium, so the tests of the page are skipped: {reason}\n" and not called


def test_root_installs_one(tmp_path: Path) -> None:
    told, called = installed(tmp_path, 0, INSTALLS)
    assert not told and called.splitlines() == ["update -qq", "install -y -qq --no-install-recommends chromium"]


def test_the_script_and_the_tests_know_the_same_names() -> None:
    assert f"for name in {' '.join(BROWSERS)}; do" in (ROOT / ".ci" / "browser").read_text()
    assert os.access(ROOT / ".ci" / "browser", os.X_OK)
    assert "\n.ci/browser\n" in (ROOT / ".ci" / "run").read_text()
