"""Fixtures that run commands in this process and interrupt them."""

import sys

import pytest

from torchgco.experiments import app
from torchgco.experiments.flying import study
from torchgco.experiments.results.folder import StudyFolder


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run torchgco in this process, quicker than in a new one: returns (exit code, stdout, stderr)."""

    def call(*words: str) -> tuple[int, str, str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["torchgco", *words])
        try:
            code = app.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return call


@pytest.fixture
def run_until(run, monkeypatch):
    """Run torchgco in this process and interrupt it when `shards` shards are written."""

    def call(shards: int, *words: str) -> None:
        written = []

        def keep(self, *flown, real=StudyFolder.keep):
            real(self, *flown)
            written.append(flown)
            if len(written) == shards:
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(StudyFolder, "keep", keep)
            assert run(*words)[0] == 130

    return call


@pytest.fixture
def without_report(monkeypatch):
    """Studies write no summary and no figures, which take most of the time of a small study."""
    monkeypatch.setattr(study, "write_report", lambda *arguments: "")
