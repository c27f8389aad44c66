"""A study is written by one process at a time, its shares by several; dead holders don't count."""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os
import platform
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.experiments.commands import HOLD, begin
from torchgco import InputError
from torchgco.experiments.results import lock
from torchgco.experiments.results.lock import held

ME = f"process {os.getpid()} on {platform.node()} (since 2"
WHOLE, SHARES = (None, None), ((0, 2), (1, 2))


@pytest.fixture
def impatient(monkeypatch) -> None:
    monkeypatch.setattr(lock, "PATIENCE", 0.05)
    monkeypatch.setattr(lock, "POLL", 0.01)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("first", "second"), [(WHOLE, WHOLE), (WHOLE, SHARES[0]), (SHARES[0], WHOLE), (SHARES[1], SHARES[1])]
)
def test_who_comes_second_is_refused_in_a_line_that_names_the_first(first, second, tmp_path, capsys) -> None:
    with held(tmp_path, *first):
        with pytest.raises(InputError) as refused, held(tmp_path, *second):
            pass
        assert f"hydra.run.dir: expected a study that no other process flies, got {tmp_path}" in str(refused.value)
        (line,) = capsys.readouterr().err.splitlines()
        for text in (str(refused.value), line):
            assert ME in text
    with held(tmp_path, *second):  # and is welcome afterwards
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("impatient")
def test_shares_are_flown_side_by_side_and_the_whole_after_them(tmp_path) -> None:
    with ExitStack() as all_of_them:
        for share in SHARES:
            all_of_them.enter_context(held(tmp_path, *share))
        with pytest.raises(InputError, match=r"flies it"), held(tmp_path):
            pass
        with pytest.raises(InputError, match=r"flies it"), held(tmp_path, *SHARES[0]):
            pass
        with held(tmp_path, 2, 3):
            pass
    with held(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [WHOLE, SHARES[0]])
def test_the_second_waits_for_the_first(share, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(lock, "POLL", 0.01)
    taken, order = threading.Event(), []

    def first() -> None:
        with held(tmp_path):
            taken.set()
            time.sleep(0.1)
            order.append("first")

    thread = threading.Thread(target=first)
    thread.start()
    taken.wait()
    with held(tmp_path, *share):
        order.append("second")
    thread.join()
    assert order == ["first", "second"] and list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err.count("waiting 120 s for it at most") == 1


def without_locks(number: int) -> Callable[..., None]:
    def flock(*words: object) -> None:
        raise OSError(number, "no locks")

    return flock


def hold(folder: Path, number: int | None, taken) -> None:
    if number is not None:
        fcntl.flock = without_locks(number)
    warnings.simplefilter("ignore")
    with held(folder):
        taken.set()
        time.sleep(60)


@pytest.mark.usefixtures("impatient")
@pytest.mark.filterwarnings("ignore:flock not supported")
@pytest.mark.parametrize("number", [None, errno.ENOSYS, errno.ENOLCK])
def test_a_killed_holder_is_none(number: int | None, tmp_path, monkeypatch) -> None:
    """Also where a file system has no locks, and a file marks the holder."""
    context = multiprocessing.get_context("fork")
    taken = context.Event()
    process = context.Process(target=hold, args=(tmp_path, number, taken))
    process.start()
    assert taken.wait(60)
    if number is not None:
        monkeypatch.setattr(fcntl, "flock", without_locks(number))
    with pytest.raises(InputError, match=rf"process {process.pid} on .* remove {tmp_path}/.lock"), held(tmp_path):
        pass
    process.kill()
    process.join()
    assert list(tmp_path.glob(".lock*"))
    with held(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("impatient", "without_report")
def test_a_study_is_held_until_its_command_ends(run, tmp_path) -> None:
    words = [*HOLD, "hydra.run.dir=out"]
    with held(tmp_path / "out", 0, 2):
        code, _, err = run(*words)
        assert code == 2 and "flies this study" in err
        assert run(*words, "study.jobs=2", "study.job=1")[0] == 0
    code, out, err = run(*words)
    assert code == 0 and "2 of 4 trials were flown before" in out, err
    assert not list((tmp_path / "out").glob(".lock*"))


@pytest.mark.usefixtures("without_report")
def test_each_share_has_a_record_of_its_own(run, tmp_path) -> None:
    """Shares 0 of 2 and 0 of 3 are flown side by side, and would change the same file."""
    words = [*HOLD, "hydra.run.dir=out"]
    with held(tmp_path / "out", 0, 3):
        assert run(*words, "study.jobs=2", "study.job=0")[0] == 0
    names = {path.name for path in (tmp_path / "out").glob("run*.json")}
    assert names == {"run-0-of-2.json"}


@pytest.mark.slow
def test_the_same_command_thrice_at_once_makes_one_whole_study(run, tmp_path) -> None:
    words = [*HOLD, "hydra.run.dir=out"]
    processes = [begin(*words, cwd=tmp_path) for _ in range(3)]
    said = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], said
    assert sum("nothing was flown again" in out for out, _ in said) == 2
    code, out, err = run(*words)
    assert code == 0 and "nothing was flown again" in out, err
