"""Lines on what takes long: where somebody watches, or in a program's own log; nowhere else."""

import io
import logging
import os
import pty
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from torchgco.base import notices
from torchgco.native import compiler
from torchgco.native.compiler import Unit, find_compiler

ROOT = Path(__file__).resolve().parents[2]
COMPILE = "from torchgco.native.compiler import build; build('int tgco_one(void) { return 1; }')"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def shown(monkeypatch) -> io.StringIO:
    """What a terminal shows."""
    terminal = Terminal()
    monkeypatch.setattr(notices, "sys", SimpleNamespace(stderr=terminal))
    return terminal


def test_a_log_gets_the_line_and_no_bar(capsys) -> None:
    """Whoever waits for a script in the background sees there why."""
    notices.notice("working")
    assert capsys.readouterr().err == "torchgco: working\n" and not notices.watched()


def test_a_terminal_shows_the_line_in_place_of_a_bar(shown) -> None:
    notices.notice("working")
    assert shown.getvalue() == f"{notices.CLEAR_LINE}torchgco: working\n"


def test_something_brief_is_shown_to_those_who_watch(shown, capsys, monkeypatch) -> None:
    notices.notice("working", brief=True)
    assert "working" in shown.getvalue()
    monkeypatch.undo()
    notices.notice("working", brief=True)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("lines", "flags", "said"),
    [
        (100, (), None),
        (8000, (), None),
        (11_000, (), "about 3 s"),
        (11_000, ("-O3", "-O1"), None),
        (50_000, ("-O3",), "about 13 s"),
        (50_000, ("-O1", "-g"), "about 7 s"),
        (10**6, (), "about 23 minutes"),
    ],
)
def test_a_log_says_how_long_the_compiler_takes_where_that_is_long(lines, flags, said, capsys, monkeypatch) -> None:
    monkeypatch.setattr(compiler, "_begun", {})
    compiler._announce([Unit("\n" * lines, own=True)], flags)
    text = capsys.readouterr().err
    assert (text == "") if said is None else f"compiling native kernels (once for this form of problem, {said})" in text


def test_units_are_compiled_side_by_side(monkeypatch) -> None:
    """As many as there are cores at a time, and the longest one as long as it takes."""
    monkeypatch.setattr(compiler.os, "cpu_count", lambda: 2)
    solver, model = Unit("\n" * 2000), Unit("\n" * 1000, own=True)
    together = compiler._expected([solver, solver, solver, model], ())
    assert 3.0 < together < 3.4 and compiler._expected([solver, model], ()) == compiler._expected([solver], ()) == 2.0


def test_compilers_at_the_same_time_are_announced_once(capsys, monkeypatch) -> None:
    running = SimpleNamespace(owner=os.getpid(), process=SimpleNamespace(poll=lambda: None))
    monkeypatch.setattr(compiler, "_begun", {"key": running})
    compiler._announce([Unit("\n" * 11_000)], ())
    assert capsys.readouterr().err == ""
    running.process.poll = lambda: 0
    compiler._announce([Unit("\n" * 11_000)], ())
    assert "compiling" in capsys.readouterr().err


def test_a_notebook_shows_the_line(monkeypatch) -> None:
    cell = io.StringIO()
    monkeypatch.setattr(notices, "sys", SimpleNamespace(stderr=cell, ps1="In : "))
    notices.notice("working")
    assert cell.getvalue() == "torchgco: working\n"


def test_workers_are_silent_unless_one_is_asked_to_speak(shown, monkeypatch) -> None:
    monkeypatch.setattr(notices.multiprocessing, "parent_process", lambda: object())
    monkeypatch.setattr(notices, "_speaks", None)
    notices.notice("working")
    notices.speak(False)
    notices.notice("working")
    assert shown.getvalue() == ""
    notices.speak(True)
    notices.notice("working")
    assert "working" in shown.getvalue()


def test_a_configured_log_gets_the_line_instead(shown, caplog, monkeypatch) -> None:
    monkeypatch.setattr(notices.LOG, "disabled", False)  # Hydra disables loggers in a process that has run a study
    with caplog.at_level(logging.INFO, "torchgco"):
        notices.notice("working")
    assert caplog.messages == ["working"] and shown.getvalue() == ""


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_the_first_compilation_is_announced_in_a_terminal(tmp_path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TORCHGCO_CACHE": str(tmp_path)}
    for count in (1, 0):  # the second time the library is there
        reader, writer = pty.openpty()
        subprocess.run([sys.executable, "-c", COMPILE], env=environment, stderr=writer, check=True)
        os.write(writer, b"end")
        text = ""
        while not text.endswith("end"):
            text += os.read(reader, 10_000).decode()
        assert text.count("compiling native kernels") == count
        os.close(reader)
        os.close(writer)
