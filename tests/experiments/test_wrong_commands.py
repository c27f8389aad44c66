"""Wrong words, layout files and tables: one clear line, exit code 2, and nothing written."""

from __future__ import annotations

import errno
import pickle
import re
import zipfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.experiments import commands
from tests.experiments.commands import HOLD, problem_line
from tests.trials import flights, trials
from torchgco.base.errors import InputError
from torchgco.experiments.config.build import build, compose, compose_config
from torchgco.experiments.config.checks import hydra_words
from torchgco.experiments.flying.flight import plan_of
from torchgco.experiments.reports.report import main as report
from torchgco.experiments.results import files
from torchgco.maps import read
from torchgco.scenarios import LayoutFile, Walls

MISSION = ["mission=default", "plant=rotors"]
FILE = ["scenario=layouts", "scenario.path=some.npz", "model=planar", *HOLD[:2], HOLD[-1]]
NAME = "expected at most 64 letters, digits, '_', '-' and '.'"
# The words, and the start of the line.
WRONG = {
    "baselines": (["study.baselines=3"], "study.baselines: expected a list of solver names, such as [al_ilqr], got 3"),
    "a dict of baselines": (["study.baselines={a:1}"], "study.baselines: "),
    "an unknown baseline": (["study.baselines=[nope]"], "study.baselines: expected one of al_ilqr, fatrop"),
    "a solver of a fixed time": (["scenario=gates"], "solver: expected interior_point, gco, gco_exact, ipopt or"),
    "a baseline of a fixed time": (
        ["scenario=gates", "solver=interior_point", "study.baselines=[al_ilqr]"],
        "study.baselines: expected interior_point, gco, gco_exact, ipopt or fatrop",
    ),
    "its own name": (["solver.name=mine", "study.baselines=[mine]"], "study.baselines: expected one of al_ilqr"),
    "threads": (["device.threads=100000"], "device.threads: expected a whole number between 1 and 1024, or null"),
    "layouts": (["study.layouts=abc"], "study.layouts: expected a whole number of at least 1, got 'abc'"),
    "many layouts": (["study.layouts=99999999999"], "study.layouts: expected layouts that fit into the free memory"),
    "many stages": (["scenario.stages=1000000000"], "scenario.stages: expected a problem that fits into the free mem"),
    "solver key": (["solver.polish=5"], "solver.polish: expected a key that the configuration has, got polish (docs"),
    "new solver key": (["+solver.foo=1"], "solver.foo: expected an option that Hold has, got foo"),
    "new mission key": ([*MISSION, "+mission.foo=1"], "mission.foo: expected an option that SensorMission has"),
    "new planner key": ([*MISSION, "+mission.planner.foo=1"], "mission.planner.foo: expected an option that Planner"),
    "new key": (["+foo=1"], "foo: expected one of the keys seed, study, model"),
    "no experiment": (["experiment=nope"], "experiment: expected one of feasibility, fleet, mission"),
    "plant alone": (["plant=rotors"], "plant: expected a mission"),
    "null plant": (["mission=default", "plant=null"], "plant: expected the vehicle that flies the mission"),
    "twice": (["seed=1", "seed=2"], "seed: expected one value, got seed=1 and seed=2"),
    "a group twice": (["model=planar", "model=unicycle"], "model: expected one value, got model=planar and model=unic"),
    "a part's key": (
        [*MISSION, "mission.planer.margin=0"],
        "mission.planer: expected a key that the configuration has, such as planner, got planer",
    ),
    "a group's key": (["scenario.obstacles=3"], "scenario.obstacles: expected a key that the configuration has"),
    "no mission": (["mission.duration=3"], "mission: expected experiment=mission, as its keys are given"),
    "mission in the plane": ([*MISSION, "scenario=yard"], "scenario: expected one in space for a mission: crossing"),
    "short mission": ([*MISSION, "mission.duration=1e-9"], "mission.duration: expected at least one control period"),
    "null solver": (["solver=null"], "solver: expected one of al_ilqr, fatrop"),
    "a dict's key": (["hydra.run.dir=null"], "hydra.run.dir: expected a value of the kind that the configuration has"),
    "--resolve": (["--resolve"], "command line: expected words that Hydra accepts, got The --resolve flag"),
    "a flag": (["--bogus"], "command line: expected KEY=VALUE, GROUP=OPTION and the flags of --hydra-help, got unrec"),
    "no key": (["=3"], "command line: expected words that Hydra accepts"),
    "half a list": (["seed=["], "seed: expected a value, quoted where it has other letters than names: \"seed='...'\""),
    "a word": (["list"], "command line: expected KEY=VALUE or GROUP=OPTION (--help lists them), got list"),
    "an own class": (
        ["model.vehicle.dynamics._target_=own.Cart"],
        "model.vehicle.dynamics._target_: expected a class that Python can import (PYTHONPATH=. for a module of this "
        "folder), got own.Cart (ModuleNotFoundError: No module named 'own')",
    ),
    "interpolation": (["seed=${nope}"], "seed: expected a value that the configuration knows"),
    "folder in /proc": (["hydra.run.dir=/proc/nope"], "hydra.run.dir: expected a folder that can be made"),
    "folder that is a file": (["hydra.run.dir=/etc/passwd"], "hydra.run.dir: expected a folder that can be made"),
    "folder without a name": (["hydra.run.dir="], "hydra.run.dir: expected the name of a folder, got an empty one"),
    "refused in a folder": (["hydra.run.dir=a/b", "study.layouts=0"], "study.layouts: expected a whole number"),
    "a name as a path": (["solver.name=a/b"], f"solver.name: {NAME}"),
}  # fmt: skip


NAMES = ["a b", "a[1]", "[a]", "a(1)", "{a}", "a'b", 'a"b', "a=b", "grün", "a#&;b", "12", "a\\", "\\'a", "null.d"]


@pytest.mark.parametrize("name", NAMES)
def test_a_path_may_have_any_name(name: str, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for key in ("scenario.path", "+scenario.path"):
        (word,) = hydra_words([f"{key}=~/{name}/f.npz"])
        assert hydra_words([word]) == [word]  # jobs read it again
        override = OverridesParser.create().parse_override(word)
        assert override.value() == f"{tmp_path}/{name}/f.npz" and not override.is_sweep_override()
    assert hydra_words(["scenario.path=~/a.npz,~/b.npz"]) == [f"scenario.path={tmp_path}/a.npz,{tmp_path}/b.npz"]


def test_a_layout_file_and_a_map_are_found_at_home(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    Walls().draw(range(1), seed=0).save(tmp_path / "w.npz")
    assert LayoutFile("~/w.npz").path == tmp_path / "w.npz"
    np.save(tmp_path / "m.npy", np.zeros((5, 5), bool))
    assert read("~/m.npy", resolution=1.0).occupied.shape == (5, 5)


@pytest.mark.sampled(7)
@pytest.mark.parametrize("case", WRONG)
def test_wrong_words_get_one_line_and_write_nothing(case: str, run, tmp_path) -> None:
    words, line = WRONG[case]
    code, out, err = run(*commands.changed(HOLD, *words))
    assert code == 2 and problem_line(err).startswith(f"torchgco: {line}"), err
    assert not out and not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def composed() -> dict[str, Any]:
    """The configuration of HOLD; `changed` makes a wrong one of it."""
    return compose_config(HOLD)


def changed(config: dict[str, Any], key: str, value: object) -> dict[str, Any]:
    held = deepcopy(config)
    *path, last = key.split(".")
    node: Any = held
    for name in path:
        node = node[name]
    if value is ABSENT:
        del node[last]
    else:
        node[last] = value
    return held


ABSENT = object()
FORMS = ["abc", None, 1.5, [1], {"a": 1}, -1, float("nan"), True]
# A key, its wrong values, and the rest of the line.
SETTINGS = {
    "seed": ([*FORMS, 2**63, 10**23], "expected a whole number of at least 0 and at most 1e[+]18"),
    "study": (["abc", None, 3, [1]], "expected a group of keys"),
    "study.baselines": ([3, "abc", ["al_ilqr", 3], [None], {"a": 1}], r"expected a list of solver names"),
    "study.layouts": (["abc", 1.5, [1], {"a": 1}, -1, 0, True], "expected a whole number of at least 1"),
    "study.batch_size": (FORMS, "expected a whole number of at least 1 or auto"),
    "study.shard_size": (FORMS, "expected a whole number of at least 1"),
    "study.workers": (
        [form for form in FORMS if form is not None] + [10**5],
        "expected a whole number between 1 and 1024, or null",
    ),
    "study.repair": ([form for form in FORMS if form is not True] + [1], "expected true or false"),
    "study.foo": ([1], "expected one of the keys layouts, baselines"),
    "device": (["abc", None, 3], "expected a group of keys"),
    "device.foo": ([1], "expected one of the keys name, dtype"),
    "device.threads": ([ABSENT], "expected this key in the configuration, got none"),
    "model": (["abc", None], "expected a group of keys"),
    "model.vehicle": (["abc", None, ABSENT], "expected (a group of keys|this key)"),
    "model.foo": ([1], "expected one of the keys dimension, vehicle, got foo"),
    "model.vehicle.foo": ([1], "expected an option that Vehicle has, got foo"),
    "model.vehicle.name": (["a/b", 3, None], NAME),
    "solver": (["abc", None, ABSENT], "expected (a group of keys|this key)"),
    "solver.name": ([None, 3, "a/b", "..", ".", "", "a b", ".hidden", "a" * 65, ABSENT], NAME),
    "scenario": (["abc", None, ABSENT], "expected (a group of keys|this key)"),
    "scenario.name": (["a/b", "..", None, 3], NAME),
    "scenario.stages": (["abc", 1.5, [1], -1, True, "3"], r"expected a whole number between 1 and 1e\+09"),
    "scenario.dt": (["abc", None, [1], -1, 0, True, "3", float("nan")], r"expected a number above 0 s"),
    "scenario.num_obstacles": ([10**9], "expected a whole number between 0 and 100000"),
    "scenario.density": ([1e5], "expected at most 100000 obstacles"),
    "scenario.obstacle_radius": ([1e200, 10**400], "expected a number"),
    "scenario.start": ([[1e200, 0, 0]], r"expected a list of 3 numbers between -1e\+06 and 1e\+06 m"),
}


@pytest.mark.sampled(9)
@pytest.mark.parametrize("key", SETTINGS)
def test_wrong_settings_are_refused_by_name(key: str, composed) -> None:
    values, line = SETTINGS[key]
    for value in values:
        with pytest.raises(InputError, match=rf"^{re.escape(key)}: {line}") as caught:
            setup = build(changed(composed, key, value))
            plan_of(setup)
            setup.layouts()
        assert "\n" not in str(caught.value)


WALLS = {"pitch": ({"pitch": 1e-9}, "grids of at most 100000 spheres"), "holes": ({"holes": 10**9}, "0 and 1000,")}


@pytest.mark.parametrize("field", WALLS)
def test_walls_beyond_memory_are_refused(field: str) -> None:
    with pytest.raises(InputError, match=rf"scenario\.{field}: .*{WALLS[field][1]}"):
        Walls(**WALLS[field][0])


def test_a_group_without_an_option_is_refused_in_python_too() -> None:
    with pytest.raises(InputError, match=r"scenario: expected one of .*forest.*, got null"):
        compose(["scenario=null"])


@pytest.mark.parametrize("word", ["--config-dir", "--config-dir=mine", "-cd=mine", "--multirun"])
def test_python_is_told_what_stands_for_a_flag(word: str) -> None:
    with pytest.raises(InputError, match=r"^overrides: expected KEY=VALUE or GROUP=OPTION") as caught:
        compose([word, "mine"])
    assert ("hydra.searchpath=[file://FOLDER]" in str(caught.value)) == ("config" in word)


MISSIONS = [["model=unicycle"], ["model=unicycle", "scenario=planar_random"], ["model=car", "scenario=yard"]]


@pytest.mark.parametrize("words", MISSIONS)
def test_missions_of_other_models_name_what_flies_them(words: list[str]) -> None:
    with pytest.raises(InputError, match=r"torchgco\.MPC controls other models"):
        compose(["mission=default", "plant=rotors", *words])


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_the_largest_seed_and_the_current_folder_are_accepted(run, tmp_path) -> None:
    code, _, err = run(*HOLD, "seed=1000000000000000000", "hydra.run.dir=.")
    assert code == 0, err
    assert (pd.read_parquet(tmp_path / "trials.parquet")["seed"] == 10**18).all()


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_solver_is_compared_with_its_own_former_settings(run, tmp_path) -> None:
    words = ["study.layouts=1", "scenario.stages=5", "scenario.num_obstacles=2", "study.workers=1"]
    words += ["hydra.run.dir=out", "solver.passes.clear.rounds=5", "study.baselines=[gco]"]
    code, _, err = run(*words)
    line = "solver.name: expected another name, as the baseline gco has other settings: solver.name=gco_changed, got"
    assert code == 2 and line in problem_line(err) and "passes.clear.rounds is 4 there, 5 here" in err
    assert run(*words, "solver.name=gco_changed")[0] == 0
    table = pd.read_parquet(tmp_path / "out" / "trials.parquet")
    assert table["solver"].tolist() == ["gco_changed", "gco"] and table["settings_digest"].nunique() == 2


@pytest.mark.usefixtures("without_report")
def test_a_baseline_that_equals_the_solver_flies_once(run, tmp_path) -> None:
    assert run(*commands.changed(HOLD, "study.baselines=[hold]", "hydra.run.dir=out"))[0] == 0
    assert pd.read_parquet(tmp_path / "out" / "trials.parquet")["solver"].tolist() == ["hold"] * 4


@pytest.mark.usefixtures("without_report")
def test_a_baseline_has_the_name_that_its_file_gives(run, tmp_path) -> None:
    (tmp_path / "mine" / "solver").mkdir(parents=True)
    for file, of in (("one", "hold"), ("two", "al_ilqr")):
        (tmp_path / "mine" / "solver" / f"{file}.yaml").write_text(f"defaults: [{of}]\nname: swift\n")
    words = ["--config-dir", "mine", *commands.changed(HOLD, "hydra.run.dir=out", "study.baselines=[one]")]
    code, _, err = run(*words)
    assert code == 0, err
    assert set(pd.read_parquet(tmp_path / "out" / "trials.parquet")["solver"]) == {"hold", "swift"}
    code, _, err = run(*commands.changed(words, "study.baselines=[one,two]", "hydra.run.dir=again"))
    assert code == 2 and "study.baselines: expected solvers with a `name` each, got several swift" in problem_line(err)


def test_a_missing_folder_of_configurations_is_named(run, tmp_path) -> None:
    code, _, err = run("--config-dir", "nowhere", *HOLD)
    line = f"--config-dir: expected a folder of configurations, got {tmp_path / 'nowhere'}, which doesn't exist"
    assert code == 2 and line in problem_line(err)


def arrays(path: Path, **changes) -> None:
    np.savez(path, **({"centers": np.zeros((2, 3, 2)), "radii": np.full((2, 3), 0.1)} | changes))


def bomb(path: Path) -> None:
    """A small file whose array claims to have 8 TB."""
    with zipfile.ZipFile(path, "w") as members, members.open("centers.npy", "w") as member:
        header = {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**3, 10**3)}
        np.lib.format.write_array_header_1_0(member, header)


OBJECTS = np.array([[None, {}, "a"]] * 2, dtype=object)
UNREADABLE = {
    "text": lambda path: path.write_text("centers radii\n"),
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: (arrays(path), path.write_bytes(path.read_bytes()[:-40])),
    "folder": lambda path: path.mkdir(),
    "pickle": lambda path: path.write_bytes(pickle.dumps({"centers": 1})),
    "objects": lambda path: arrays(path, radii=OBJECTS),
    "one array": lambda path: (np.save(path.with_suffix(".npy"), np.zeros(3)), path.with_suffix(".npy").rename(path)),
    "bomb": bomb,
    "missing": lambda path: None,
}
MALFORMED = {
    "text array": ({"radii": np.full((2, 3), "a")}, "layouts.radii: expected an array of real numbers"),
    "complex": ({"centers": np.zeros((2, 3, 2), complex)}, "layouts.centers: expected an array of real numbers"),
    "truth": ({"radii": np.ones((2, 3), bool)}, "layouts.radii: expected an array of real numbers"),
    "no layouts": ({"centers": np.zeros((0, 3, 2)), "radii": np.zeros((0, 3))}, "layouts.centers: expected shape"),
    "unknown": ({"colour": np.zeros(2)}, "layouts.colour: expected only centers"),
    "far": ({"centers": np.full((2, 3, 2), 1e200)}, "layouts.centers: expected values of at most 1e+06 in size"),
    "large": ({"radii": np.full((2, 3), 1e200)}, "layouts.radii: expected values of at most 1e+06 in size"),
    "fast": ({"velocities": np.full((2, 3, 2), 1e9)}, "layouts.velocities: expected values of at most 1e+06 in size"),
    "far start": ({"start": np.full(6, 1e200)}, "layouts.start: expected values of at most 1e+06 in size"),
    "large vehicle": ({"vehicle_radius": 1e200}, "layouts.vehicle_radius: expected a number between 0 and 1e+06 m"),
    "text number": ({"dt": "0.1"}, "layouts.dt: expected a number above 0 s"),
    "more stages": ({"stages": 10**12}, "layouts.stages: expected a whole number between 1 and 1e+09"),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_an_unreadable_layout_file_is_named_in_one_line(case: str, tmp_path) -> None:
    UNREADABLE[case](tmp_path / "some.npz")
    with pytest.raises(InputError, match=r"^scenario\.path: expected .*some\.npz") as caught:
        LayoutFile(tmp_path / "some.npz")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("case", MALFORMED)
def test_a_malformed_layout_file_is_named_in_one_line(case: str, tmp_path) -> None:
    changes, line = MALFORMED[case]
    arrays(tmp_path / "some.npz", **changes)
    with pytest.raises(InputError, match=f"^{re.escape(line)}") as caught:
        LayoutFile(tmp_path / "some.npz")
    assert "\n" not in str(caught.value)


def test_a_wrong_layout_file_writes_nothing(run, tmp_path) -> None:
    arrays(tmp_path / "some.npz", stages=10**9)
    code, _, err = run(*FILE)
    assert code == 2 and "scenario.stages: expected a problem that fits into the free memory" in problem_line(err)
    (tmp_path / "some.npz").write_text("text")
    code, _, err = run(*FILE)
    assert code == 2 and "scenario.path: expected a readable npz file" in problem_line(err)
    assert [path.name for path in tmp_path.iterdir()] == ["some.npz"]


def test_more_obstacles_than_fit_into_memory_are_refused(run, tmp_path, monkeypatch) -> None:
    arrays(tmp_path / "some.npz", stages=100)
    monkeypatch.setattr("torchgco.experiments.config.build.free_memory", lambda: 10_000)
    code, _, err = run(*FILE)
    assert code == 2 and "100 stages with 3 obstacles" in problem_line(err)


@pytest.fixture
def table(tmp_path) -> Path:
    """The folder of a table of trials."""
    (tmp_path / "in").mkdir()
    trials(*flights("gco", [True, False])).to_parquet(tmp_path / "in" / "trials.parquet", index=False)
    return tmp_path / "in"


TABLES = {
    "no rows": (lambda rows: rows.iloc[:0], "at least one"),
    "text": (lambda rows: rows.assign(cost="cheap"), "cost"),
    "text for truth": (lambda rows: rows.assign(reached="yes"), "reached"),
    "no status": (lambda rows: rows.drop(columns="status"), "status"),
    "no solver": (lambda rows: rows.drop(columns="solver"), "solver"),
    "no violation": (lambda rows: rows.drop(columns="violation"), "violation"),
}


@pytest.mark.parametrize("case", TABLES)
def test_a_wrong_table_gets_one_line(case: str, table, capsys) -> None:
    change, word = TABLES[case]
    change(pd.read_parquet(table / "trials.parquet")).to_parquet(table / "trials.parquet", index=False)
    assert report([str(table)]) == 2
    line = problem_line(capsys.readouterr().err)
    assert line.startswith("torchgco-report: trials: expected ") and word in line
    assert [path.name for path in table.iterdir()] == ["trials.parquet"]


def test_wrong_words_of_a_report_get_one_line(table, tmp_path, capsys, monkeypatch) -> None:
    (tmp_path / "file").touch()
    calls = [([str(table), "--output", str(tmp_path / "file")], "--output"), ([str(tmp_path / "file")], "folders")]
    for words, field in [*calls, ([str(tmp_path / "nowhere")], "folders")]:
        assert report(words) == 2
        assert problem_line(capsys.readouterr().err).startswith(f"torchgco-report: {field}: expected ")
    assert report([]) == 2 and problem_line(capsys.readouterr().err).startswith("torchgco-report: DIR: expected ")
    for words in ([str(table), "--nope"], [str(table), "--power", "0.5"], [str(table), "--format", "xml"]):
        assert report(words) == 2
        assert problem_line(capsys.readouterr().err).startswith("torchgco-report: command line: expected DIR")

    def replace(part, place):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "replace", replace)
    assert report([str(table), "--output", str(tmp_path / "full")]) == 2
    assert "full/trials.parquet" in (line := problem_line(capsys.readouterr().err)) and "No space left" in line
    assert not list(tmp_path.rglob("*.part"))
