"""Studies on a device with a number, and on several: CPUs count as devices where a test says so."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch

from tests.experiments.commands import TINY, problem_line
from tests.experiments.test_resume import HOW
from torchgco import InputError
from torchgco.base.shapes import check_device
from torchgco.experiments.config import build
from torchgco.experiments.config.build import compose, compose_config
from torchgco.experiments.config.checks import hydra_words
from torchgco.experiments.flying import flight
from torchgco.experiments.flying.flight import SolveBatch, Tasks, plan_of
from torchgco.experiments.flying.progress import NoBar
from torchgco.experiments.flying.workers import run_all
from torchgco.experiments.results.identity import Manifest, decisive

CPUS = torch.device("cpu", 0), torch.device("cpu", 1)  # PyTorch computes on one CPU, whatever its number is
PATIENCE = 120.0  # s, until two processes have started


@pytest.fixture
def two_devices(monkeypatch) -> None:
    """PyTorch says that there are two, and refuses none of them."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(build, "check_device", torch.device)


@pytest.mark.parametrize(
    ("word", "words"),
    [
        ("device=cuda:1", ["device=cuda", "device.name=cuda:1"]),
        ("device=cuda:0,cuda:1", ["device=cuda", "device.name=cuda:0,cuda:1"]),
        ("device=cuda\\:1", ["device=cuda", "device.name=cuda:1"]),
        ("device=cuda", ["device=cuda"]),
        ("device.name=cuda:1", ["device.name=cuda:1"]),
    ],
)
def test_a_device_may_have_a_number(word: str, words: list[str]) -> None:
    assert hydra_words([word]) == words


@pytest.mark.parametrize(
    ("count", "told"), [(0, "no CUDA device"), (1, "cuda:0, 1 in all"), (2, "cuda:0 to cuda:1, 2 in all")]
)
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_an_absent_device_is_refused_with_how_many_there_are(count: int, told: str, monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
    for call in (lambda: compose(["device=cuda:7"]), lambda: check_device("cuda:7")):
        with pytest.raises(InputError) as caught:
            call()
        assert str(caught.value) == f"device: expected a device that is there, such as cpu ({told}), got cuda:7"


def test_a_command_with_an_absent_or_misspelt_device_ends_in_a_line(run) -> None:
    for word, told in (("device=cuda:99", "got cuda:99"), ("device.name=cuda1", "cpu, cuda, or one of several")):
        code, _, err = run(word, "study.layouts=1")
        assert code == 2 and told in problem_line(err)


def test_a_study_has_all_devices_or_one(two_devices) -> None:
    every, second, cpu = (compose([f"device={name}", "study.layouts=1"]) for name in ("cuda", "cuda:1", "cpu"))
    assert [str(device) for device in every.devices] == ["cuda:0", "cuda:1"] and str(every.device) == "cuda:0"
    assert [str(device) for device in second.devices] == ["cuda:1"] and cpu.devices == (torch.device("cpu"),)
    assert plan_of(every).workers == 2 and plan_of(second).workers == 1
    assert [str(replace(every, turn=turn).device) for turn in range(3)] == ["cuda:0", "cuda:1", "cuda:0"]


def test_the_number_of_a_device_is_no_part_of_a_study() -> None:
    nodes = [compose_config([f"device={name}"]) for name in ("cuda", "cuda:1")]
    assert nodes[1]["device"]["name"] == "cuda:1" and decisive(nodes[0], {}) == decisive(nodes[1], {})
    rows = [Manifest({"version": "0", **node}, {}, {}).constants for node in nodes]
    assert rows[0] == rows[1] and rows[0]["device"] == "cuda"


def test_a_worker_computes_on_the_device_of_its_turn(monkeypatch) -> None:
    threads, found = torch.get_num_threads(), []
    setup = replace(compose(["solver=hold", "study.layouts=2", "scenario.stages=5"]), devices=CPUS)
    for turn in range(3):
        monkeypatch.setattr(flight, "_turn", 0)
        flight.prepare(turn, threads, True)
        batch = SolveBatch(Tasks(setup, setup.layouts()), [0, 1], "hold", setup.solver, NoBar())
        _, (_, U) = flight.fly(batch)
        found.append((batch.setup.device, U.tolist()))
    assert [device for device, _ in found] == [CPUS[0], CPUS[1], CPUS[0]] and found[0][1] == found[1][1]


_number = -1


def note(number: int) -> None:
    global _number
    _number = number


def meet(job: tuple[Path, int]) -> int:
    """The number of the process that takes a job, once another one has been taken, too."""
    folder, place = job
    (folder / str(place)).touch()
    began = time.monotonic()
    while len(list(folder.iterdir())) < 2 and time.monotonic() - began < PATIENCE:
        time.sleep(0.01)
    return _number


@pytest.mark.slow
def test_processes_are_numbered(tmp_path) -> None:
    kept: list[int] = []
    run_all(meet, [(tmp_path, 0), (tmp_path, 1)], 2, note, (), kept.append, print, lambda done: None)
    assert sorted(kept) == [0, 1]


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_study_on_two_devices_has_the_results_of_one(run, tmp_path, monkeypatch) -> None:
    words = [*TINY[:5], "study.baselines=[]", "study.shard_size=1"]
    words.remove("study.shard_size=2")
    assert run(*words, "study.workers=1", "hydra.run.dir=one")[0] == 0
    monkeypatch.setattr(build, "_devices", lambda node: (CPUS, torch.float64))
    assert run(*words, "study.workers=2", "hydra.run.dir=two")[0] == 0
    one, two = (pd.read_parquet(tmp_path / name / "trials.parquet") for name in ("one", "two"))
    pd.testing.assert_frame_equal(one.drop(columns=HOW), two.drop(columns=HOW), check_exact=True)
    told = [json.loads((tmp_path / name / "run.json").read_text())[-1]["devices"] for name in ("one", "two")]
    assert told == [["cpu"], ["cpu:0", "cpu:1"]] and set(two["device"]) == {"cpu"}
    controls = [(tmp_path / name / "solutions.npz").read_bytes() for name in ("one", "two")]
    assert controls[0] == controls[1]
