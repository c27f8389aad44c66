"""Presets, groups and a user's own files compose: every experiment with all that can serve it, or one line says what to
choose."""

from __future__ import annotations

import os
import re
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path

import pytest

from tests.experiments.commands import HOLD, ROOT, problem_line
from tests.slow import mostly
from torchgco import Airframe, InputError, compose, presets
from torchgco.experiments.config.build import Setup, build, compose_config, config_dir
from torchgco.experiments.config.groups import FAMILIES, options_of
from torchgco.experiments.flying.flight import plan_of
from torchgco.experiments.flying.study import check_mission
from torchgco.exploration import SensorMission
from torchgco.missions import Planner, RotorPlant
from torchgco.scenarios import Vehicle

DATA = ROOT / "benchmarks" / "data"
WALLS = f"scenario.path={DATA / 'walls.npz'}"
EXPERIMENTS = options_of("experiment")
MISSIONS = ("mission", "mission_study", "mission_unknown")
NOT_FLOWN = ("gates", "race")  # by missions that pass no gates
SHARED = (
    "conveyor",
    "floors",
    "revolving",
    "sliding",
    "traffic",
    "walkers",
)  # positions alone: any model
FLEETS = ("fleet_circle", "fleet_door", "fleet_forest")  # as well
OF_MODEL = {
    "planar": ("planar_random", "planar_trap", "planar_trap_paper"), "unicycle": (*SHARED, "yard"),
    "car": ("parking",), "disc": FLEETS,
    "quadrotor": (
        "crossing", "cylinders", "forest", "forest_mission", "forest_moving", "gates", "mazes", "rooms", "swarm",
        "trefoils", "walls", "woods",
    ),
    "rotors": ("race",),
}  # fmt: skip
MODEL = {scenario: model for model, scenarios in OF_MODEL.items() for scenario in scenarios}
FILES = {"forest30": "quadrotor", "planar_trap": "planar"}


def checked(*words: str) -> Setup:
    """All that a study checks before it flies."""
    setup = compose(words)
    plan_of(setup)
    layouts = setup.layouts(1)
    if layouts.vehicles is not None:
        assert layouts.vehicles == setup.fleet(layouts).V
        return setup
    task = setup.task(layouts)
    if setup.mission is not None:
        check_mission(setup.mission, task)
    return setup


def refused(*words: str) -> str:
    with pytest.raises(InputError) as caught:
        checked(*words)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def scenes() -> dict[str, tuple[str, list[str]]]:
    """The model that flies a scenario or file, and its words, by name."""
    drawn = {name: (model, [f"scenario={name}"]) for name, model in MODEL.items()}
    files = {f"{name}.npz": (model, [f"scenario.path={DATA / name}.npz"]) for name, model in FILES.items()}
    return drawn | {
        name: (model, ["scenario=layouts", *words, f"model={model}"]) for name, (model, words) in files.items()
    }


def test_every_scenario_has_a_model_that_the_matrix_names() -> None:
    assert set(MODEL) | {"layouts", "map"} == set(options_of("scenario")) and set(OF_MODEL) == set(options_of("model"))


@pytest.mark.slow
@pytest.mark.parametrize("experiment", mostly(EXPERIMENTS, *EXPERIMENTS[1:]))
def test_every_experiment_composes_with_every_scenario_model_and_solver(experiment: str) -> None:
    """As it is, and on every scenario and file; models are named or left to the scenario, solvers take turns."""
    setup = checked(f"experiment={experiment}")
    assert setup.layouts().count == (setup.configuration["study"]["layouts"] or 64)
    turns, named = iter(options_of("solver")[3 * EXPERIMENTS.index(experiment) % 12 :]), cycle((True, False))
    for name, (model, words) in scenes().items():
        solver = next(turns) if name in ("forest", *FILES) else "hold"  # whose configuration is quick to compose
        given = [f"experiment={experiment}", *words, f"solver={solver}"]
        given += [f"model={model}"] if next(named) and f"model={model}" not in words else []
        if experiment == "race" and name != "race":
            assert refused(*given).startswith(("scenario: expected", "model: expected rotors"))
        elif experiment in MISSIONS and (model != "quadrotor" or name in NOT_FLOWN):
            assert "scenario: expected one in space for a mission: crossing, cylinders, forest" in refused(*given)
        else:
            setup = checked(*given)
            assert setup.vehicle.name == model and (setup.mission is not None) == (experiment in (*MISSIONS, "race"))


@pytest.mark.slow
@pytest.mark.parametrize("experiment", mostly(MISSIONS, *MISSIONS[1:]))
def test_every_loop_and_plant_composes_and_a_mission_can_be_left_out(experiment: str) -> None:
    for mission in options_of("mission"):
        words = f"experiment={experiment}", f"mission={mission}", "solver=al_ilqr"
        if mission == "race":
            assert refused(*words, "scenario=walls").startswith("scenario: expected race, or a layout file with gates")
        setup = checked(*words, "scenario=race" if mission == "race" else "scenario=walls")
        assert setup.mission is not None and setup.mission.planner.solver == presets.al_ilqr(3)
    for plant in ("drone_models", "mujoco", "rotorpy", "crazyflow"):
        refuses = plant == "crazyflow" and os.environ.get("SCIPY_ARRAY_API") != "1"
        if find_spec(plant) is None or refuses:
            assert "plant: " in refused(f"experiment={experiment}", f"plant={plant}", "solver=al_ilqr")
        else:
            assert checked(f"experiment={experiment}", f"plant={plant}", "solver=al_ilqr").mission is not None
    for scenario in ("planar_random", "woods"):
        words = [f"experiment={experiment}", "mission=null", "plant=null", f"scenario={scenario}", "solver=hold"]
        assert checked(*words).mission is None


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scenario", mostly(MODEL, *set(MODEL) - set(tuple(MODEL)[::3])))
def test_a_model_that_cannot_fly_a_scenario_is_refused_with_one_that_can(scenario: str) -> None:
    fitting = (
        ("planar", "unicycle", "car", "disc") if scenario in (*SHARED, *FLEETS) else (MODEL[scenario],)
    )  # each rests there
    fitting = ("unicycle", "disc") if scenario == "yard" else fitting  # which have as many states
    wanted = " or ".join(f"model={model}" for model in fitting)
    for other in options_of("model"):
        if other not in fitting:
            line = refused(f"scenario={scenario}", f"model={other}", "solver=hold")
            assert line.startswith(f"model: expected {wanted}, as") and line.endswith(f"got model={other}")


@pytest.mark.sampled(9)
@pytest.mark.parametrize("family", FAMILIES)
def test_a_registered_scenario_is_its_class(family: type) -> None:
    assert compose([f"scenario={family().name}", "solver=hold"]).scenario == family()


def test_one_key_says_what_models_plants_and_states_at_rest_weigh() -> None:
    for plant in ("rotors", *(["drone_models"] if find_spec("drone_models") else [])):
        setup = checked("experiment=mission", "vehicle.gravity=1.62", "vehicle.mass=1.2", f"plant={plant}")
        task = setup.task(setup.layouts(1))
        assert setup.mission is not None and isinstance(setup.mission.plant, RotorPlant)
        assert setup.mission.plant.airframe == setup.vehicle.dynamics.airframe == Airframe(mass=1.2, gravity=1.62)
        assert task.U0[..., 3].unique().item() == task.problem.x0[0, 13].item() == 1.62
        assert task.problem.cost.u_ref[..., 3].unique().item() == task.problem.cost.xf_ref[..., 13].unique().item()


def test_a_vehicle_is_chosen_by_its_name_and_gives_all_parts_its_size(tmp_path: Path) -> None:
    """Also one of a folder of one's own, which says what differs."""
    mine = tmp_path / "vehicle"
    mine.mkdir()
    (mine / "mine.yaml").write_text("defaults: [paper, _self_]\nmass: 0.8\nthrust_max: 9.0\nradius: 0.2\n")
    own = build(compose_config(["vehicle=mine", "scenario=walls"], [f"file://{tmp_path}"]))
    small = compose(["vehicle=crazyflie", "experiment=mission_unknown"])
    for setup, mass, radius in ((own, 0.8, 0.2), (small, 0.0319, 0.07)):
        frame = setup.vehicle.dynamics.airframe  # type: ignore[attr-defined]
        assert (frame.mass, frame.radius, setup.vehicle.radius) == (mass, radius, radius)
        assert setup.layouts(1).vehicle_radius == radius  # which obstacles are grown by, unless a command says another
    assert compose(["vehicle=crazyflie", "scenario.vehicle_radius=0.3"]).layouts(1).vehicle_radius == 0.3
    assert compose(["vehicle=paper"]).vehicle == Vehicle.quadrotor(Airframe())


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["vehicle=nano"], "vehicle: expected one of crazyflie, paper, racer, got nano"),
        (["vehicle.masse=1"], "vehicle.masse: expected a key that the configuration has, such as mass, got masse"),
        (["vehicle.mass=-1"], "vehicle.mass: expected a number above 0 kg, got -1"),
        (["vehicle.thrust_min=7"], "vehicle.thrust_min: expected less than thrust_max 6.0, got 7"),
        (["scenario=planar_trap", "vehicle.mass=1"], "vehicle: expected model=quadrotor, whose airframe this is"),
        (["model.vehicle.dynamics.airframe.mass=1"], "expected vehicle.mass, as airframes have a group of their own"),
        (["+plant.airframe={_target_: torchgco.Airframe, mass: 1}", "experiment=mission"], "plant.airframe: expected"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_vehicle_gets_one_line(words: list[str], line: str) -> None:
    with pytest.raises(InputError, match=re.escape(line)):
        compose(words)


def test_a_registered_mission_is_its_class() -> None:
    assert compose(["experiment=mission"]).mission == SensorMission(
        Planner(presets.gco(3)), plant=RotorPlant(Airframe())
    )


def test_a_preset_flies_all_layouts_of_a_file() -> None:
    words = ["experiment=mission_study", "scenario=layouts", WALLS, "solver=hold"]
    assert compose(words).configuration["study"]["layouts"] is None and compose(words).layouts().count == 32
    assert compose([*words, "study.layouts=3"]).layouts().count == 3
    walls = compose(["experiment=mission_study", "scenario=walls", "solver=hold"])
    assert walls.configuration["study"]["layouts"] == 32


def test_null_leaves_a_group_out() -> None:
    plain_setup, words = compose([]), ["mission=null", "plant=null", "experiment=null"]
    assert compose(words).configuration == plain_setup.configuration
    without = compose(["experiment=mission", "mission=null", "plant=null"])
    assert without.mission is None and compose(["experiment=mission"]).mission is not None


@pytest.fixture
def own(tmp_path: Path) -> list[str]:
    """A user's folder of configurations that extend those of the package by name, and the words that add it."""
    texts = {
        "scenario/sparse": "defaults: [forest]\nname: sparse\nnum_obstacles: 3\n",
        "solver/patient": "defaults: [gco]\nname: patient\nattempts: 9\n",
        "experiment/mine": "# @package _global_\ndefaults: [override /scenario: sparse, override /solver: patient]\n",
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.yaml").parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.yaml").write_text(text)
    return ["--config-dir", str(tmp_path)]


@pytest.mark.usefixtures("without_report")
def test_files_of_a_user_extend_what_is_registered(run, own: list[str]) -> None:
    _, out, _ = run(*own, "--help")
    assert "sparse" in out and "patient" in out and "mine" in out
    code, out, err = run(*own, "--cfg", "job", "experiment=mine")
    assert (
        code == 0
        and "num_obstacles: 3" in out
        and "attempts: 9" in out
        and "vehicle_radius: ${torchgco.radius:0.36}" in out
    ), err
    code, _, err = run(*own, "scenario=sparse", *HOLD, "hydra.run.dir=out")
    assert code == 0, err


def test_a_mission_of_a_user_without_the_default_ones_keys_is_refused(run, tmp_path: Path) -> None:
    (tmp_path / "mission").mkdir()
    (tmp_path / "mission" / "mine.yaml").write_text("duration: 3.0\n")
    code, _, err = run("--config-dir", str(tmp_path), "experiment=mission", "mission=mine", "hydra.run.dir=out")
    assert code == 2 and "mission: expected keys that extend those of mission=default" in problem_line(err)


def test_the_wheel_and_the_checkout_find_their_configs() -> None:
    assert (config_dir() / "config.yaml").is_file() and config_dir().is_absolute()
