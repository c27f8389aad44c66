"""A study's number for sweepers, and how many layouts tell two rates apart."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import pytest
from hydra.core.utils import JobReturn
from scipy.stats import binom, binomtest

from tests.experiments.commands import HOLD
from tests.trials import flights, missions, trials
from torchgco import InputError
from torchgco.experiments.flying.jobs import Jobs, Report, Scored
from torchgco.experiments.reports.report import main
from torchgco.experiments.results.kinds import OF_MISSIONS, OF_TRAJECTORIES, objective_of, parts_of
from torchgco.experiments.statistics.power import layouts_needed, power

WORDS = ["scenario=forest", *HOLD[1:], "solver=hold", "study.figures=false"]


@pytest.fixture
def returned(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What jobs return: a sweeper takes it from there."""
    values: list[Any] = []

    def on_job_end(self: Jobs, config: Any, job_return: JobReturn, real: Any = Jobs.on_job_end, **more: Any) -> None:
        real(self, config, job_return=job_return, **more)
        values.append(job_return.return_value)

    monkeypatch.setattr(Jobs, "on_job_end", on_job_end)
    return values


def test_every_name_is_a_column_of_the_summary() -> None:
    (single,) = parts_of(trials(*flights("gco", [True, False])))
    assert set(OF_TRAJECTORIES) <= set(single.summary.columns)
    (flown,) = parts_of(trials(*missions("gco", "RRC")))
    assert set(OF_MISSIONS) <= set(flown.summary.columns)
    table = trials(*flights("gco", [True, True, False, True]), *flights("hold", [False] * 4))
    assert objective_of(table, "reached_rate", "gco") == 0.75 and objective_of(table, "reached_rate", "hold") == 0.0


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_sweeper_gets_a_number_for_each_job(returned: list[Any], run, tmp_path: Path) -> None:
    code, out, err = run("-m", *WORDS, "scenario.num_obstacles=2,3", "study.objective=violation_median")
    assert code == 0, err
    assert len(returned) == 2 and all(isinstance(number, float) and number >= 0 for number in returned)
    assert out.count("violation_median of hold: ") == 2
    folders = {number.report.folder for number in returned}
    assert len(folders) == 2 and all(Path(folder).parent == tmp_path / "outputs" for folder in folders)
    assert not list((tmp_path / "outputs").glob(".jobs-*"))
    code, _, err = run("-m", *WORDS, "scenario.num_obstacles=2,3")
    assert code == 0 and all(isinstance(report, Report) for report in returned[2:]), "without an objective as before"


@pytest.mark.sampled(1)
@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["study.objective=reach_rate"], "study.objective: expected a number of the summary, such as reached_rate"),
        (["study.objective=flight_time"], "study.objective: expected a number of the summary"),
        (["study.objective=success_rate"], "a number that these trials define, got success_rate, which is undefined"),
        (["study.objective=reached_rate", "study.jobs=2", "study.job=0"], "null where jobs share a study"),
    ],
)
def test_what_is_no_number_of_the_study_is_one_line(words: list[str], told: str, run, tmp_path: Path) -> None:
    for sweep in ([], ["-m"]):
        code, _, err = run(*sweep, *WORDS, *words)
        assert code == 2 and told in err and len([line for line in err.splitlines() if "expected" in line]) == 1, err


def test_the_number_travels_with_its_report() -> None:
    """Launchers send it from other processes."""
    again = pickle.loads(pickle.dumps(Scored(0.5, Report("folder", ["a=1"], True))))
    assert again == 0.5 and again.report == Report("folder", ["a=1"], True) and float(again) * 2 == 1.0


def by_hand(n: int, first: float, second: float) -> float:
    """Every outcome of n layouts with its probability, and the test of the library."""
    total = 0.0
    for d in range(n + 1):
        for k in range(d + 1):
            if d and binomtest(k, d).pvalue <= 0.05:
                total += binom.pmf(d, n, first + second) * binom.pmf(k, d, first / (first + second))
    return total


@pytest.mark.sampled(7)
@pytest.mark.parametrize("n", [1, 5, 6, 13, 30])
@pytest.mark.parametrize(("first", "second"), [(0.4, 0.1), (0.2, 0.0), (0.7, 0.3), (0.05, 0.05)])
def test_power_is_that_of_the_test_in_reports(n: int, first: float, second: float) -> None:
    assert power(n, first, second) == pytest.approx(by_hand(n, first, second), abs=1e-12)


def test_layouts_that_tell_two_rates_apart() -> None:
    for a, b in ((0.9, 0.8), (1.0, 0.5), (0.3, 0.35)):
        least, most = (layouts_needed(a, b, nested) for nested in (True, False))
        assert 6 <= least <= most and layouts_needed(b, a, True) == least
        shares = abs(a - b), 0.0
        assert power(least, *shares) >= 0.8 > power(least - 1, *shares)
    assert layouts_needed(1.0, 0.0, True) == layouts_needed(1.0, 0.0, False) == 6, "2 / 2^6 is the first below 5 %"


def test_power_from_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--power", "0.9", "0.8"]) == 0
    out = capsys.readouterr().out
    assert f"{layouts_needed(0.9, 0.8, True)} layouts, if the worse" in out
    for words in (["0.9", "0.9"], ["1.1", "0.5"], ["nan", "0.5"], ["a", "b"], ["0.5"], ["0.5", "0.501"]):
        assert main(["--power", *words]) == 2
        assert "expected" in capsys.readouterr().err
    with pytest.raises(InputError, match="differ by at least"):
        layouts_needed(0.5, 0.5, False)
