"""The benchmark of long studies: what it counts as a difference, as growth and as overhead; and a small run."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from benchmarks.endurance import study as endurance
from benchmarks.endurance.memory import Sampler, draw, group_of, summary

TRIALS = pd.DataFrame({"layout": [0, 1], "cost": [1.5, np.nan], "status": ["CONVERGED", "LIMIT"], "seconds": [1.0, 2]})


def finished(folder: Path, trials: pd.DataFrame = TRIALS, controls: float = 0.0) -> Path:
    """A folder with the files of a finished study."""
    folder.mkdir()
    trials.to_parquet(folder / "trials.parquet")
    np.savez(folder / "solutions.npz", U=np.full((1, 2, 3), controls))
    return folder


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({}, []),
        ({"seconds": [3.0, 4.0]}, []),
        ({"cost": [np.nextafter(1.5, 2.0), np.nan]}, ["cost"]),
        ({"cost": [1.5, 0.0], "status": ["CONVERGED", "CONVERGED"]}, ["cost", "status"]),
        ({"more": [0, 0]}, ["the columns or the number of rows"]),
    ],
)
def test_tables_differ_by_their_bits(tmp_path: Path, change: dict, found: list[str]) -> None:
    folders = finished(tmp_path / "a"), finished(tmp_path / "b", TRIALS.assign(**change))
    assert endurance.differences(*folders) == found


def test_controls_and_left_over_files_count(tmp_path: Path) -> None:
    one, other = finished(tmp_path / "a", controls=0.0), finished(tmp_path / "b", controls=-0.0)
    (other / "tmp.part").touch()
    assert endurance.differences(one, other) == ["solutions.npz", "tmp.part"]


def test_growth_is_that_of_the_flights(tmp_path: Path) -> None:
    """Two processes: one grows by 1 MiB a second while flights last, from 10 s to 50 s; the other lives for a while."""
    seconds = np.arange(60.0)
    memory = pd.DataFrame({7: 100.0 + seconds.clip(10, 50), 8: np.where(seconds < 55, 20.0, np.nan)}, index=seconds)
    held = summary(memory, 10.0, 50.0)
    assert held["slope"] == pytest.approx(60.0) and held["peak"] == 170.0
    assert held["first"] == pytest.approx(120 + 14.5) and held["last"] == pytest.approx(120 + 45.5)
    assert summary(memory, 10.0, 12.0) == {"peak": 170.0}
    draw(memory, 10.0, 50.0, tmp_path / "memory.png")
    assert (tmp_path / "memory.png").stat().st_size > 1000


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="no /proc")
def test_all_processes_of_a_group_are_sampled() -> None:
    script = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'])"
    parent = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, start_new_session=True)
    assert parent.stdin is not None
    with Sampler(parent.pid, period=0.02) as sampler:
        while len(group_of(parent.pid)) < 2 or not len(sampler.samples) > 4:
            time.sleep(0.02)
    parent.stdin.close()
    parent.wait()
    assert not group_of(parent.pid)
    table = sampler.table()
    assert table.shape[1] == 2 and table.max().min() > 1.0  # MiB


def test_the_overhead_is_what_the_study_has_besides_its_flights() -> None:
    """Solves differ by noise and the report is stated separately, so neither counts."""
    study = {"solve": 61.0, "judge": 45.0, "report": 9.0, "write shards": 3.0, "rest": 1.0}
    direct = {"solve": 60.0, "judge": 38.0, "rest": 2.0}
    assert endurance.share({"study": study, "direct": direct}) == pytest.approx(0.02)
    text = endurance.overhead_table({"study": study, "direct": direct})
    assert "| write shards | 3.00 | 0.00 |" in text and "2.0 %" in text and "the report took 9.0 %" in text


@pytest.mark.parametrize(("layouts", "size"), [(10_000, 512), (300, 38), (20, 3), (1, 1)])
def test_there_are_shards_for_both_workers(layouts: int, size: int) -> None:
    assert endurance.shard_size(layouts) == size


@pytest.mark.slow
def test_a_killed_study_ends_with_the_bits_of_an_undisturbed_one(tmp_path: Path, capfd) -> None:
    assert endurance.main(["--layouts", "20", "--outputs", str(tmp_path)]) == 0
    text = capfd.readouterr().out
    assert "bit for bit" in text and "Killed 0 times" not in text and "7 shards" in text
    assert (tmp_path / "endurance.png").is_file()
    assert len(pd.read_parquet(tmp_path / "killed" / "trials.parquet")) == 20
    lines = {line for line in text.splitlines() if line.startswith(("| solve |", "| judge |"))}
    phases = [line.split(" | ") for line in lines]  # of the table, and of what the page shows of it
    assert len(phases) == 2 and all(float(cell.strip(" |")) > 0 for phase in phases for cell in phase[1:])
