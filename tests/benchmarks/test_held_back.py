"""Layouts of a release that nobody knows before: a hash first, the secret and what it draws later."""

from hashlib import sha256
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.families import held_back
from benchmarks.lib.families import FAMILIES
from torchgco import Layouts

RELEASE = "9.9.0"


@pytest.fixture
def asked(tmp_path: Path):
    (tmp_path / "board").mkdir()

    def run(what: str, release: str = RELEASE) -> int:
        return held_back.main(
            [what, release, "--board", str(tmp_path / "board"), "--secrets", str(tmp_path / "secrets")]
        )

    return run


def test_a_promise_is_revealed_and_checked(asked, tmp_path: Path, capsys) -> None:
    board = tmp_path / "board"
    assert asked("promise") == 0
    secret = (tmp_path / "secrets" / f"{RELEASE}.txt").read_text()
    published = (board / "promises.csv").read_text()
    assert secret not in published and sha256(secret.encode()).hexdigest() in published
    assert asked("check") == 2 and "isn't revealed yet" in capsys.readouterr().err
    assert asked("promise") == 2, "a second promise would let its author choose"
    assert asked("reveal") == 0 and asked("check") == 0
    assert pd.read_csv(board / "promises.csv").secret.tolist() == [secret]
    layouts = {path.stem: Layouts.load(path) for path in (board / "layouts").iterdir()}
    assert set(layouts) == {f"{name}-{RELEASE}" for name in FAMILIES}
    for name, drawn in layouts.items():
        public = Layouts.load(FAMILIES[name.removesuffix(f"-{RELEASE}")].file())
        assert drawn.count == 32 and drawn.dimension == public.dimension and drawn.stages == public.stages
        assert not np.array_equal(drawn.start, public.start) or not np.array_equal(drawn.centers, public.centers)


def test_what_was_changed_after_the_promise_is_found(asked, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(held_back, "FAMILIES", {"planar_random": FAMILIES["planar_random"]})
    asked("promise")
    path = tmp_path / "secrets" / f"{RELEASE}.txt"
    secret = path.read_text()
    path.write_text(secret[::-1])
    assert asked("reveal") == 2 and "whose hash was published" in capsys.readouterr().err
    assert not (tmp_path / "board" / "layouts").exists()
    path.write_text(secret)
    assert asked("reveal") == 0
    (file,) = (tmp_path / "board" / "layouts").iterdir()
    held_back.draw(RELEASE, "another", file.parent)
    assert asked("check") == 2 and "the layouts of its secret" in capsys.readouterr().err


@pytest.mark.parametrize(("what", "told"), [("reveal", "promises.csv"), ("check", "promises.csv")])
def test_a_release_without_a_promise_is_refused(asked, what: str, told: str, capsys) -> None:
    assert asked(what) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert told in line and RELEASE in line


def test_a_lost_secret_is_told(asked, tmp_path: Path, capsys) -> None:
    asked("promise")
    (tmp_path / "secrets" / f"{RELEASE}.txt").unlink()
    assert asked("reveal") == 2 and "no such file" in capsys.readouterr().err


@pytest.mark.parametrize("release", ["../0.2.0", "", "0.2.0/a", ".", "a b"])
def test_a_name_that_leads_elsewhere_is_refused(release: str, tmp_path: Path, capsys) -> None:
    words = ["promise", release, "--board", str(tmp_path), "--secrets", str(tmp_path / "secrets")]
    assert held_back.main(words) == 2 and "release" in capsys.readouterr().err
    assert list(tmp_path.rglob("*.txt")) == []
