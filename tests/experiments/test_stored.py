"""Files of a study, which may come from anybody, make torchgco's own classes and nothing else."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from tests.experiments.commands import HOLD, problem_line
from torchgco import InputError
from torchgco.experiments.config.build import check_stored, compose_config, mission_from, solver_from, vehicle_of
from torchgco.experiments.config.groups import _tree
from torchgco.experiments.reports import report, view
from torchgco.experiments.results.identity import digest
from torchgco.presets import PRESETS
from torchgco.solvers import ILQR

RAN: list[object] = []  # what `Own` was made with
CONFIGURATION = compose_config(["experiment=mission_unknown"])
WRITES = {"_target_": "pathlib.Path.write_text", "_args_": [{"_target_": "pathlib.Path", "_args_": ["ran"]}, "x"]}
FOREIGN = {
    "a function of ours": {"_target_": "torchgco.native.compiler.build", "source": "int tgco_x;"},
    "a module of ours": {"_target_": "torchgco.api.solve"},
    "a class of another group": {"_target_": "torchgco.scenarios.files.LayoutFile", "path": "x.npz"},
    "through a module of ours": {"_target_": "torchgco.native.compiler.os.system", "command": "touch ran"},
    "a pickle": {"_target_": "pandas.read_pickle", "filepath_or_buffer": "evil.pkl"},
    "a method": WRITES,
    "a class of the user": {"_target_": f"{__name__}.own", "value": 0.36},
    "an interpolation": "${oc.env:HOME}",
    "in a list": [0.1, {"_target_": "joblib.load", "filename": "evil.pkl"}],
    "no text": {"_target_": ["torchgco.dynamics.Planar"]},
    "positional": {"_target_": "torchgco.dynamics.Planar", "_args_": [1.0]},
    "a partial": {"_target_": "torchgco.dynamics.Planar", "_partial_": True},
    "free": {"output_file": "ran"},
}


def own(value: float) -> float:
    RAN.append(value)
    return value


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_made_from_its_file(name: str) -> None:
    for dimension in (2, 3):
        check_stored(_tree(PRESETS[name](dimension)), "solver", "solver")


def test_the_parts_of_a_study_are_made_as_they_were() -> None:
    held = json.loads(json.dumps(CONFIGURATION))
    vehicle = vehicle_of(held)
    assert vehicle.dynamics.n == 14 and vehicle_of(held, trust=True) == vehicle
    settings = {"_target_": "torchgco.solvers.ILQR", "max_iterations": 3}  # by another of its paths
    assert solver_from(settings) == ILQR(max_iterations=3)
    mission = mission_from(held, ILQR())
    assert mission.planner.solver == ILQR() and type(mission.plant).__name__ == "RotorPlant"


@pytest.mark.sampled(5)
@pytest.mark.parametrize("case", FOREIGN)
def test_all_else_is_one_line_and_runs_nothing(case: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    RAN.clear()
    makers: dict[str, Any] = {
        "model.vehicle": vehicle_of, "mission": lambda held: mission_from(held, None),
        "plant": lambda held: mission_from(held, None), "solver": lambda held: solver_from(held["solver"]),
    }  # fmt: skip
    for place, make in makers.items():
        for deep in (True, False):
            held = copy.deepcopy(CONFIGURATION)
            *above, last = place.split(".")
            parent: Any = held
            for key in above:
                parent = parent[key]
            if deep:
                parent[last]["radius"] = FOREIGN[case]
            else:
                parent[last] = FOREIGN[case]
            if place == "mission" and case == "a partial":
                continue  # partial as its own planner is; its class is another group's
            with pytest.raises(InputError) as error:
                make(held)
            assert error.value.field.startswith(place) and "--trust" in str(error.value)
    assert RAN == [] and list(tmp_path.iterdir()) == []


def test_options_of_other_libraries_are_refused() -> None:
    solver = {"_target_": "torchgco.baselines.casadi.CasADiSolver", "plugin": "ipopt"}
    assert solver_from({**solver, "options": None}).plugin == "ipopt"
    with pytest.raises(InputError, match=r"solver.options: .*--trust"):
        solver_from({**solver, "options": {"output_file": "written"}})  # IPOPT would write that file


@pytest.mark.slow
def test_the_commands_refuse_a_crafted_run_and_make_own_classes_when_told(run, tmp_path, capsys) -> None:
    words = ["scenario=yard", *HOLD, "study.figures=false", "hydra.run.dir=flown"]
    assert run(*words)[0] == 0
    path = tmp_path / "flown" / "study.json"
    held = json.loads(path.read_text())
    del held["checksum"]
    vehicle = held["configuration"]["model"]["vehicle"]
    vehicle["radius"] = {"_target_": f"{__name__}.own", "value": vehicle["radius"]}
    path.write_text(json.dumps({**held, "checksum": digest(held)}))
    RAN.clear()
    commands = (view.main, ["flown"]), (report.main, ["flown", "--verify"])
    for main, words in commands:
        assert main(words) == 2
        line = problem_line(capsys.readouterr().err)
        assert "model.vehicle.radius._target_: expected a class" in line and f"got {__name__}.own" in line
    assert RAN == []
    for main, words in commands:
        code = main([*words, "--trust"])
        assert code == 0 or "digest" in capsys.readouterr().out  # the layouts' digests name the vehicle
    assert RAN == [0.3, 0.3]


@pytest.mark.slow
def test_a_study_writes_the_page_of_its_own_classes(run, tmp_path) -> None:
    held = f"{{_target_: {__name__}.own, value: 0.3}}"
    code, _, err = run("scenario=yard", *HOLD, "study.figures=false", "study.view=true", f"model.vehicle.radius={held}")
    assert code == 0, err
    assert list(tmp_path.glob("outputs/*/view.html"))


DAMAGED = {
    "no vehicle": lambda held: held["configuration"]["model"].pop("vehicle"),
    "a list": lambda held: held["configuration"].update(model=[1]),
    "no solvers": lambda held: held["solvers"].clear(),
    "no device": lambda held: held["configuration"].pop("device"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_study_file_without_a_group_is_damaged(damage: str, tmp_path: Path, capsys) -> None:
    held = {"configuration": {**CONFIGURATION, "version": "0"}, "solvers": {"a": {}}, "layouts": {"0": "x"}}
    held = json.loads(json.dumps({**held, "settings": {}}))
    DAMAGED[damage](held)
    (tmp_path / "study.json").write_text(json.dumps({**held, "checksum": digest(held)}))
    (tmp_path / "done").write_text("{}")
    assert view.main([str(tmp_path)]) == 2
    assert "study.json, which is damaged" in problem_line(capsys.readouterr().err)
