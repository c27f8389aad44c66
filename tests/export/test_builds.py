"""Folders for Arduino, PlatformIO and Zephyr: the same controller, whose sketches and samples run with stubs."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
import torch
import yaml

import torchgco
from tests.export.exported import SAME, exported, needs, needs_compiler, said
from tests.export.kinds import START, car
from torchgco import InputError, Problem, Spheres, load_c

pytestmark = needs_compiler
HERE = Path(__file__).parent
NATIVE = "-march=native"  # with fused products, as in Python


def problem() -> Problem:
    return car(Spheres([[2.5, 0.6]], [0.3], 0.2))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("car")
    builds = {"cmake": exported(problem(), folder / "cmake")}
    for build in ("arduino", "zephyr"):
        builds[build] = torchgco.export_c(problem(), folder / build, name="car", build=build)
    return builds


@pytest.mark.parametrize("build", ["arduino", "zephyr"])
def test_the_controller_is_the_same(folders: dict[str, Path], build: str) -> None:
    for file in ("car.h", "car.c"):
        assert (folders[build] / "src" / file).read_text() == (folders["cmake"] / file).read_text()
    assert torch.equal(load_c(folders[build]).step(START), load_c(folders["cmake"]).step(START))


def test_two_builds_of_one_controller_in_a_folder_are_refused(tmp_path: Path) -> None:
    """One of them may be older."""
    for build in ("cmake", "arduino"):
        torchgco.export_c(problem(), tmp_path, name="car", build=build)
    for name in (None, "car"):
        with pytest.raises(InputError, match="got car, car in"):
            load_c(tmp_path, name)


@pytest.mark.parametrize("build", ["arduino", "zephyr"])
def test_the_page_names_all_files(folders: dict[str, Path], build: str) -> None:
    text = (folders[build] / "README.md").read_text()
    rows = re.findall(r"^\| ([\w/., ]+) \|", text.split("| file |")[1].split("```")[0], re.MULTILINE)
    named = [name for row in rows for name in row.split(", ")]
    for path in filter(Path.is_file, folders[build].rglob("*")):
        name = path.relative_to(folders[build]).as_posix()
        assert name == "README.md" or any(name.startswith(prefix) for prefix in named), name
        assert path.suffix == ".c" or not re.search(r"\bNAME(?=_|\b)|@[A-Z]", path.read_text()), name


def test_libraries_have_what_arduino_and_platformio_ask_for(folders: dict[str, Path]) -> None:
    folder = folders["arduino"]
    lines = (folder / "library.properties").read_text().splitlines()
    properties = dict(line.split("=", 1) for line in lines)
    asked = "name version author maintainer sentence paragraph category url architectures includes"
    assert set(properties) == set(asked.split()) and properties["name"] == "car" and properties["includes"] == "car.h"
    library = json.loads((folder / "library.json").read_text())
    assert library["name"] == "car" and library["version"] == properties["version"]
    assert library["build"]["flags"] == ["-ffp-contract=off", "-fno-math-errno"]
    for example in library["examples"]:
        assert {path.name for path in (folder / example["base"]).iterdir()} == set(example["files"])


def ran(folder: Path, sketch: str, loops: int, tmp_path: Path) -> str:
    """What a sketch prints, compiled as Arduino does, without the options of the other builds."""
    board = "-DARDUINO=10819", "-O2", NATIVE, f"-I{folder / 'src'}"
    said("gcc", "-std=gnu11", *board, "-c", folder / "src" / "car.c", "-o", tmp_path / "car.o", folder=folder)
    text = f'#include "Arduino.h"\n#include "{folder}/examples/{sketch}/{sketch}.ino"\n'
    text += f"int main() {{ setup(); for (int i = 0; i < {loops}; i++) {{ loop(); now_ms += 50; }} }}\n"
    (tmp_path / "sketch.cpp").write_text(text)
    strict = "-std=gnu++17", "-Wall", "-Wextra", "-Werror"
    words = *strict, f"-I{HERE / 'arduino'}", *board, tmp_path / "sketch.cpp", tmp_path / "car.o"
    said("g++", *words, "-o", tmp_path / "run", folder=folder)
    return said(tmp_path / "run", folder=folder)


@pytest.mark.slow
@needs("gcc", "g++")
def test_a_sketch_steps_once_a_period(folders: dict[str, Path], tmp_path: Path) -> None:
    lines = ran(folders["arduino"], "car", 40, tmp_path).splitlines()
    assert len(lines) == 20 and all(re.fullmatch(r"status 1( -?\d\.\d{6}){2}", line) for line in lines)


@pytest.mark.slow
@needs("gcc", "g++")
def test_a_sketch_finds_the_bits_of_python(folders: dict[str, Path], tmp_path: Path) -> None:
    assert ran(folders["arduino"], "car_test", 1, tmp_path).splitlines() == [SAME, "the same bits"]


@pytest.mark.sampled(0)
@needs("cmake", "gcc")
@pytest.mark.parametrize("program", ["main", "test"])
def test_a_sample_of_zephyr_runs(folders: dict[str, Path], program: str, tmp_path: Path) -> None:
    sample, build = folders["zephyr"] / "samples" / "car", tmp_path / "build"
    flags = f"-DCMAKE_C_FLAGS=-O1 {NATIVE}", f"-DPROGRAM={program}", f"-DZephyr_DIR={HERE / 'zephyr'}"
    said("cmake", "-S", sample, "-B", build, *flags, folder=sample)
    said("cmake", "--build", build, folder=sample)
    printed = said(build / "app", folder=sample)
    assert printed.startswith(SAME) if program == "test" else printed.count("status 1") == 20


def test_a_module_has_the_option_that_its_sample_sets(folders: dict[str, Path]) -> None:
    folder = folders["zephyr"]
    module = yaml.safe_load((folder / "zephyr" / "module.yml").read_text())
    assert module["name"] == "car" and (folder / module["build"]["cmake"] / "CMakeLists.txt").is_file()
    (symbol,) = re.findall(r"^config (\w+)$", (folder / module["build"]["kconfig"]).read_text(), re.MULTILINE)
    settings = dict(re.findall(r"(\w+)=(\w+)", (folder / "samples" / "car" / "prj.conf").read_text()))
    assert settings[f"CONFIG_{symbol}"] == "y" and f"if(CONFIG_{symbol})" in (folder / "CMakeLists.txt").read_text()
    stack = int(re.search(r"stack of a step \| ([\d,]+)", (folder / "README.md").read_text())[1].replace(",", ""))
    assert int(settings["CONFIG_MAIN_STACK_SIZE"]) > stack
    assert yaml.safe_load((folder / "samples" / "car" / "sample.yaml").read_text())["tests"]


@needs("gcc")
def test_doubles_of_4_bytes_are_refused(folders: dict[str, Path], tmp_path: Path) -> None:
    """As those of an 8-bit AVR, whose double is a float."""
    code = folders["arduino"] / "src" / "car.c"
    words = "gcc", "-Ddouble=float", "-w", f"-I{code.parent}", "-c", str(code), "-o", os.devnull
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert done.returncode != 0 and "needs_doubles_of_8_bytes" in done.stderr


def test_an_unknown_build_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="build"):
        torchgco.export_c(problem(), tmp_path / "folder", build="make")  # type: ignore[arg-type]
    assert not (tmp_path / "folder").exists()
