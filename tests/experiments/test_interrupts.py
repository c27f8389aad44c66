"""Ctrl-C and SIGTERM at any moment of a command, and readers that read only the beginning."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pandas as pd
import pytest

from tests.experiments.commands import ENVIRONMENT, begin, changed, problem_line
from tests.experiments.test_workers import arguments, wait_for
from tests.trials import flights, trials
from torchgco.experiments.ending import Terminated, raised

SIGNALS = [signal.SIGINT, signal.SIGTERM]
MOMENTS = [0.0, 0.3, 0.6, 1.0, 2.0]  # s after the command began: while modules are loaded, or while the study runs
REPORT = "import sys; from torchgco.experiments.reports.report import main; {}sys.exit(main())"
BEGINNING = "print('begins', flush=True); "


@pytest.fixture
def table(tmp_path) -> Path:
    """The folder of a table of trials."""
    (tmp_path / "in").mkdir()
    trials(*flights("gco", [True, False])).to_parquet(tmp_path / "in" / "trials.parquet", index=False)
    return tmp_path / "in"


@pytest.mark.parametrize("number", SIGNALS)
def test_signals_raise_within_the_block_only(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt) as caught, raised():
        signal.raise_signal(number)
    assert isinstance(caught.value, Terminated) == (number == signal.SIGTERM)
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_whose_exception_got_lost_is_raised_late(number: signal.Signals) -> None:
    with pytest.raises(KeyboardInterrupt), raised() as noted:
        with suppress(KeyboardInterrupt):  # as a module does that is being loaded
            signal.raise_signal(number)
        noted.raise_late()


@pytest.mark.parametrize("number", SIGNALS)
def test_an_ignored_signal_stays_ignored(number: signal.Signals) -> None:
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with raised():
            signal.raise_signal(number)
            assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


@pytest.mark.slow
def test_another_program_keeps_its_signals() -> None:
    code = "import signal, torchgco; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("seconds", MOMENTS)
@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("workers", [1, 2])
def test_a_signal_at_any_moment_gets_one_line_and_the_study_resumes(workers, number, seconds, run, tmp_path) -> None:
    words = changed(arguments(tmp_path, "Slow"), f"study.workers={workers}")
    process = begin(*words, cwd=tmp_path)
    wait_for(lambda: (tmp_path / "out").exists() or process.poll() is not None)
    time.sleep(seconds)
    end(process, number)
    (tmp_path / "spared").touch()
    assert run(*changed(words, "study.workers=1"))[0] == 0
    assert pd.read_parquet(tmp_path / "out" / "trials.parquet")["layout"].tolist() == [0, 1, 2, 3]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_sigterm_of_a_study_with_a_shard_leaves_no_process(workers: int, tmp_path) -> None:
    process = begin(*changed(arguments(tmp_path, "Slow"), f"study.workers={workers}"), cwd=tmp_path)
    wait_for(lambda: list((tmp_path / "out" / "shards").glob("*.npz")) or process.poll() is not None)
    end(process, signal.SIGTERM)


def end(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """Send a signal to a study, as a terminal or a scheduler does, and check how the study ends."""
    if number == signal.SIGINT:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    _, err = process.communicate(timeout=120)
    word = "interrupted" if number == signal.SIGINT else "terminated"
    assert process.returncode == 128 + number, err
    assert problem_line(err) == f"torchgco: {word}; the same command resumes from here"
    wait_for(lambda: not group_of(process.pid))


def group_of(leader: int) -> list[str]:
    """The processes of a process group that still run."""
    found = []
    for place in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, group = place.read_text().rsplit(")", 1)[1].split()[:3]
        except OSError:  # gone meanwhile
            continue
        if int(group) == leader and state != "Z":
            found.append(place.parent.name)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("seconds", MOMENTS)
def test_a_report_is_interrupted_with_one_line(seconds: float, table) -> None:
    line = [sys.executable, "-c", REPORT.format(BEGINNING), str(table)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(line, env=ENVIRONMENT, text=True, **pipes)
    assert process.stdout is not None and process.stdout.readline() == "begins\n"
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    if process.returncode == 130:
        assert problem_line(err).startswith("torchgco-report: interrupted")
    else:  # done already, or just leaving
        assert process.returncode in (0, -signal.SIGINT) and (table / "report" / "summary.csv").is_file()


@pytest.mark.slow
def test_a_reader_that_has_read_enough_is_no_error(table) -> None:
    line = [sys.executable, "-c", REPORT.format(""), str(table)]
    process = subprocess.Popen(line, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    err = process.stderr.read().decode()
    assert process.wait(60) == 0 and problem_line(f"{err}\nno other line") == "no other line"  # but for the bar
    process.stderr.close()
    assert (table / "report" / "summary.csv").is_file()


@pytest.mark.slow
def test_a_full_standard_output_gets_one_line(table) -> None:
    with open("/dev/full", "w") as full:
        line = [sys.executable, "-c", REPORT.format(""), str(table)]
        done = subprocess.run(line, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2 and "standard output: expected room to write" in problem_line(done.stderr)
