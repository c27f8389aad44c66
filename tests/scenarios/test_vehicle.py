"""A vehicle and layouts make planning problems; values missing in the layouts come from the vehicle."""

from pathlib import Path

import numpy as np
import pytest
from torch import inf

from torchgco import InputError
from torchgco.dynamics import Planar, Unicycle
from torchgco.experiments.config.build import compose
from torchgco.scenarios import Layouts, PlanarTrap, Yard
from torchgco.scenarios.vehicle import BUILT_IN, fitting

ROOT = Path(__file__).resolve().parents[2]


def vehicle(name: str):
    own = {"quadrotor": "forest", "rotors": "race", "unicycle": "yard", "car": "parking", "disc": "fleet_door"}
    return compose([f"model={name}", f"scenario={own.get(name, 'planar_trap')}"]).vehicle


def test_public_layouts_make_the_published_problem() -> None:
    """The problem has the numbers of the file."""
    layouts = Layouts.load(ROOT / "benchmarks" / "data" / "forest30.npz")
    task = vehicle("quadrotor").task(layouts)
    problem = task.problem
    assert (problem.B, problem.N, problem.dynamics.dt, task.goal_radius) == (32, 100, 0.05, 2.0)
    spheres, bounds = problem.constraints
    np.testing.assert_array_equal(spheres.centers, layouts.centers)
    np.testing.assert_allclose(spheres.inflated_radii, 0.96)
    np.testing.assert_array_equal(bounds.upper[0], layouts.control_upper)
    np.testing.assert_array_equal(problem.x0[0], layouts.start[0])
    assert task.goal[0].tolist() == [20, 1, 0.2] and task.U0[3, 7].tolist() == [0, 0, 0, 9.81]


def test_values_missing_in_the_file_come_from_the_vehicle() -> None:
    bare = Layouts(centers=[[[0.0, 0.0]]], radii=[[0.1]])
    task = vehicle("planar").task(bare)
    assert (task.problem.N, task.goal_radius) == (200, 0.3)
    assert task.problem.x0[0, :2].tolist() == [-1, 0] and task.goal[0].tolist() == [1, 0.4]
    assert float(task.problem.constraints[0].inflated_radii) == pytest.approx(0.16)
    assert task.problem.constraints[1].lower[0].tolist() == [-10, -10]


def test_the_layouts_time_step_rules() -> None:
    layouts = PlanarTrap(dt=0.02, stages=30).draw([0], 0)
    problem = vehicle("planar").task(layouts).problem
    assert problem.dynamics == Planar(dt=0.02) and problem.N == 30


@pytest.mark.parametrize(("name", "other"), [("planar", "forest30"), ("quadrotor", "planar_trap")])
def test_a_mismatch_names_the_model_to_give(name: str, other: str) -> None:
    layouts = Layouts.load(ROOT / "benchmarks" / "data" / f"{other}.npz")
    wanted = "quadrotor" if name == "planar" else "planar"
    with pytest.raises(InputError, match=f"model: expected model={wanted}"):
        vehicle(name).task(layouts)


@pytest.mark.slow
def test_the_built_in_models_are_those_of_the_configurations() -> None:
    assert set(BUILT_IN) == {path.stem for path in (ROOT / "conf" / "model").glob("*.yaml")}
    for name, form in BUILT_IN.items():
        assert form == (vehicle(name).dimension, vehicle(name).dynamics.n)
        alike = [f"model={other}" for other, space in BUILT_IN.items() if space == form]
        assert fitting(*form) == " or ".join(alike) and (len(alike) == 1 or form == (2, 4))
    assert fitting(2, None) == "model=planar or model=unicycle or model=car or model=disc" == fitting(2, 7)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            "model=planar scenario=yard",
            "expected model=unicycle or model=disc, as yard is 2-D with 4 states, got model=planar",
        ),
        ("model=unicycle scenario=planar_trap", "model=planar, as planar_trap is 2-D with 6 states, got model=un"),
        (
            "model=quadrotor scenario=yard",
            "expected model=unicycle or model=disc, as yard is 2-D with 4 states, or scenario=crossing or cylinders or "
            "forest or forest_moving or gates or mazes or rooms or swarm or trefoils or walls or woods, got model=quad",
        ),
        ("model=unicycle scenario=forest", "expected model=quadrotor, as forest is 3-D with 14 states"),
    ],
)
def test_of_two_models_in_the_plane_the_one_that_fits_is_named(words: str, line: str) -> None:
    with pytest.raises(InputError) as caught:
        compose(words.split())
    assert caught.value.field == "model" and line in str(caught.value)


@pytest.mark.slow
def test_layouts_without_states_fit_both_models_in_the_plane(tmp_path) -> None:
    Layouts(centers=[[[0.0, 0.0]]], radii=[[0.1]]).save(tmp_path / "bare.npz")
    words = ["scenario=layouts", f"scenario.path={tmp_path / 'bare.npz'}"]
    for name in ("planar", "unicycle", "car"):
        setup = compose([*words, f"model={name}"])
        assert setup.task().problem.n == BUILT_IN[name][1]
    with pytest.raises(
        InputError,
        match="expected model=planar or model=unicycle or model=car or model=disc, as bare is 2-D, or scenario=",
    ):
        compose([*words, "model=quadrotor"])


@pytest.mark.parametrize(("name", "positions"), [("quadrotor", [[1.0, 1, 0], [2, 1, 0]]), ("unicycle", [-4.0, 1])])
def test_a_file_may_give_positions_alone(name: str, positions: list, tmp_path) -> None:
    """As scenario.start does: the vehicle rests there."""
    d, n = BUILT_IN[name]
    np.savez(tmp_path / "some.npz", centers=np.zeros((2, 1, d)), radii=np.full((2, 1), 0.1), start=positions)
    setup = compose(["scenario=layouts", f"scenario.path={tmp_path / 'some.npz'}", f"model={name}"])
    x0 = setup.task().problem.x0
    assert x0.shape == (2, n) and (x0[:, :d].numpy() == positions).all()
    assert x0[:, d:].tolist() == [list(setup.vehicle.start)[d:]] * 2
    assert setup.layouts().start.shape == (2, n)  # what a study writes and compares
    goal = np.array(setup.vehicle.goal)
    mixed = Layouts(setup.layouts().centers, setup.layouts().radii, start=positions, goal=goal)
    assert (setup.vehicle.task(mixed).problem.x0 == x0).all()
    with pytest.raises(InputError, match=rf"^layouts\.start: expected {n} states of model={name}, or {d} coordinates"):
        setup.vehicle.task(Layouts(mixed.centers, mixed.radii, start=np.zeros(d + 1)))


def test_a_yard_makes_the_unicycles_problem() -> None:
    task = vehicle("unicycle").task(Yard().draw(range(3), 0))
    spheres, bounds, boxes, speed = task.problem.constraints
    assert task.problem.dynamics == Unicycle(dt=0.1) and task.problem.N == 150
    assert spheres.centers.shape == (3, 8, 2) and boxes.centers.shape == (3, 6, 2)
    assert bounds.upper[0].tolist() == [2, 1.5]
    assert speed.upper[0].tolist() == [inf] * 3 + [1] and speed.lower[0].tolist() == [-inf] * 3 + [-1]
    assert task.problem.x0.tolist() == [[-5, 0, 0, 0]] * 3 and task.goal.tolist() == [[5, 0]] * 3


def test_states_of_another_length_are_named() -> None:
    layouts = Layouts(centers=[[[0.0, 0.0]]], radii=[[0.1]], start=[[0.0, 0.0, 0.0]])
    with pytest.raises(InputError, match=r"layouts\.start: expected 6 states"):
        vehicle("planar").task(layouts)


def test_a_bound_that_is_left_out_is_the_dynamics_own() -> None:
    """A heavier quadrotor is planned with the accelerations that its rotors give, not with those of the lighter one."""
    heavy = ["model=quadrotor", "scenario=forest", "vehicle.mass=2.4"]
    task = compose(heavy).vehicle.task(Layouts(centers=[[[9.0, 9.0, 9.0]]], radii=[[0.1]]))
    bounds = task.problem.constraints[1]
    assert bounds.upper[0].tolist() == [5, 5, 5, 10.0] and bounds.lower[0, 3] == pytest.approx(4 * 0.1046 / 2.4)
    with pytest.raises(InputError, match=r"vehicle.control_upper\[1\]: expected a number"):
        compose(["model=planar", "scenario=planar_trap", "model.vehicle.control_upper=[1,null]"])
