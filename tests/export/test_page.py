"""The manual's C and its node of ROS 2 compile and run; the command writes what `export_c` does."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import torchgco
from tests.export.exported import STRICT, exported, needs, needs_compiler, said
from tests.export.kinds import car
from torchgco import Problem, Spheres, load_c
from torchgco.experiments.reports import export

pytestmark = needs_compiler
PAGE = Path(__file__).parents[2] / "docs" / "microcontroller.md"
STUBS = Path(__file__).parent / "ros2"


def block(language: str) -> str:
    """The only block of a language on the page."""
    (found,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    problem = car(Spheres([[12.0, 1.2]], [0.8], 0.5))
    return exported(problem, tmp_path_factory.mktemp("car"), "x_ref", "centers")


@needs("gcc")
def test_the_firmware_of_the_page_compiles(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "firmware.c").write_text(block("c"))
    said("gcc", *STRICT, f"-I{folder}", "-c", tmp_path / "firmware.c", "-o", tmp_path / "firmware.o", folder=folder)


@pytest.mark.slow
@needs("gcc", "g++")
def test_the_node_of_the_page_steers(folder: Path, tmp_path: Path) -> None:
    """With stubs of rclcpp: nothing is published before anything came in, and the car stops without odometry."""
    text = block("cpp")
    assert len(text.splitlines()) <= 100
    (tmp_path / "node.cpp").write_text(text)
    said("gcc", *STRICT, "-O2", "-c", "car.c", "-o", tmp_path / "car.o", folder=folder)
    flags = "-std=c++17", "-Wall", "-Wextra", f"-I{STUBS}", f"-I{folder}"
    said("g++", *flags, tmp_path / "node.cpp", tmp_path / "car.o", "-lm", "-o", tmp_path / "node", folder=folder)
    printed = said(tmp_path / "node", folder=folder).splitlines()
    lines = [line for line in printed if line.startswith("published")]
    assert len(lines) == 10 and all(re.fullmatch(r"published (\d\.\d{3} ){2}-?0\.\d{3}", line) for line in lines)
    speeds = [float(line.split()[1]) for line in lines]
    assert (
        all(2.5 < speed < 3.5 for speed in speeds[:8])
        and lines[8:] == [re.sub(r"d .* ", "d 0.000 3.000 ", lines[9])] * 2
    )


WORDS = "model=planar", "scenario=planar_random", "study.layouts=2", "seed=3"


def planned(layout: int) -> Problem:
    setup = torchgco.compose(WORDS)
    return setup.vehicle.task(setup.layouts().take(np.array([layout]))).problem


@pytest.mark.slow
def test_the_command_writes_the_controller_of_a_configuration(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    target = tmp_path / "boat"
    words = [*WORDS, "--c", "boat", "--output", str(target), "--layout", "1", "--changes", "centers"]
    assert export.main(words) == 0 and "boat.c" in capsys.readouterr().out
    c, problem = load_c(target), planned(1)
    assert set(c.numbers) == {"centers"}
    u, v = c.step(problem.x0[0]), torchgco.compile(problem, "interior_point")(x0=problem.x0).u[0]
    assert torch.equal(u, v)


def test_the_command_writes_a_library_for_arduino(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    target = tmp_path / "boat"
    assert export.main([*WORDS, "--c", "boat", "--output", str(target), "--build", "arduino", "--single"]) == 0
    files = [path for path in target.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files) / 1e6
    assert "float u[boat_NU]" in (target / "src" / "boat.h").read_text()
    assert target / "src" / "boat.c" in files and f"boat.c, {size:.2f} MB" in capsys.readouterr().out


@pytest.mark.slow
def test_the_command_writes_layouts_as_elements(tmp_path: Path) -> None:
    assert export.main([*WORDS, "--c", "boat", "--output", str(tmp_path / "boat"), "--layout", "1", "0"]) == 0
    for element, layout in enumerate((1, 0)):
        c, problem = load_c(tmp_path / "boat", element=element), planned(layout)
        u = torchgco.compile(problem, "interior_point")(x0=problem.x0).u[0]
        assert c.elements == 2 and torch.equal(c.step(problem.x0[0]), u)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((*WORDS, "--c", "2"), "word of C"),
        ((*WORDS, "--c", "boat", "--layout", "0", "-1"), "layout"),
        ((*WORDS, "--c", "boat", "--rate", "10"), "--rate"),
        ((*WORDS, "--c", "boat", "--changes", "wind"), "wind"),
        (("nowhere", "--c", "boat"), "RUN"),
        (("nowhere", "--build", "zephyr"), "--build"),
        (("nowhere", "--single"), "--single"),
        (("one", "two"), "RUN"),
    ],
)
def test_a_wrong_command_gets_one_line(words: tuple[str, ...], told: str, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert export.main([*words]) != 0
    assert told in capsys.readouterr().err and not list(tmp_path.iterdir())
