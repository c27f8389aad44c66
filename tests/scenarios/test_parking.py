"""Parking: how slots are drawn and kept, the problem of a car with a body that they make, and its pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.collections import PolyCollection

from tests.plotting.straight import layout_grid
from tests.trials import flights, trials
from torchgco import Bicycle, InputError, compose
from torchgco.obstacles.body import BoundBody
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.problem.goal import GoalState
from torchgco.scenarios import Layouts, Parking, concatenate
from torchgco.search.poses import clear_at


def test_slots_follow_their_rule() -> None:
    scenario = Parking(gap=1.5, length=5.0, kerb=0.4)
    drawn = scenario.draw(range(50), 1)
    assert drawn == concatenate([scenario.draw([i], 1) for i in range(50)])
    off = np.abs(drawn.start - [3.25, 2.7, 0, 0, 0])
    assert (off <= [1.75, 0.3, 0.15, 0, 0]).all() and (off.max(0) > [1.6, 0.27, 0.13, -1, -1]).all()
    (left, right, kerb), half = drawn.box_centers[0], drawn.box_half_sizes[0]
    assert right[0] - half[1, 0] - left[0] - half[0, 0] == pytest.approx(1.5 * 5.0)
    assert left[1] - half[0, 1] - kerb[1] - half[2, 1] == pytest.approx(0.4)
    np.testing.assert_array_equal(drawn.goal, np.tile([-1.3, 0, 0, 0, 0], (50, 1)))


def test_files_say_that_the_goal_binds(tmp_path: Path) -> None:
    drawn = Parking().draw([4], 0)
    drawn.save(tmp_path / "parking.npz")
    held = Layouts.load(tmp_path / "parking.npz")
    assert held.goal_required is True and replace(held, name="parking", ids=drawn.ids) == drawn
    with pytest.raises(InputError, match=r"layouts\.goal_required: expected true or false"):
        replace(drawn, goal_required=1.5)
    with pytest.raises(InputError, match=r"layouts\.goal_required: expected the same in all parts"):
        concatenate([drawn, replace(drawn, goal_required=None)])


def test_the_problem_is_a_car_whose_body_parks() -> None:
    setup = compose(["scenario=parking", "seed=2"])
    problem = setup.task(setup.layouts(3)).problem
    spheres, boxes = problem.obstacles
    assert isinstance(problem.dynamics, Bicycle) and isinstance(boxes, BoundBody) and len(boxes.balls) == 32
    assert problem.goal.required and isinstance(problem.constraints[-1], GoalState)
    end = torch.tensor([[-1.3, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(3, -1)
    assert not bool(problem.constraints[-1].value(end.unsqueeze(1).expand(-1, 121, -1), problem.x0).any())
    # The car just fits: aside by the kerb's distance it touches.
    alone = problem.take([0])
    clear = clear_at(alone, 2)
    poses = np.array([[-1.3, 0.0, 0.0], [-1.3, -0.25, 0.0], [-0.6, 0.0, 0.0], [-0.7, 0.0, 0.0], [-1.3, 0.0, -0.5]])
    assert clear(poses).tolist() == [True, False, False, True, False]
    assert spheres.margins.shape[1] == 0


def test_a_footprint_takes_the_place_of_the_radius() -> None:
    corners, cells = "model.vehicle.footprint", "+model.vehicle.cells=[5,2]"
    words = ["scenario=yard", f"+{corners}=[[-0.5,-0.2],[0.5,0.2]]"]
    setup = compose([*words, cells])
    discs, boxes = setup.task(setup.layouts(2)).problem.obstacles
    assert isinstance(discs, BoundBody) and boxes.box == ((-0.5, -0.2), (0.5, 0.2))
    for more, told in [
        ([], r"vehicle\.cells: expected numbers for a footprint"),
        (["+model.vehicle.cells=[5]"], r"vehicle\.cells: expected 2 whole numbers"),
        (
            ["+model.vehicle.cells=[5,2]", "model.vehicle.footprint=[[0,0],[1,0]]"],
            r"vehicle\.footprint: expected a corner",
        ),
        (
            ["+model.vehicle.cells=[5,2]", "model.vehicle.footprint=[[0,0]]"],
            r"vehicle\.footprint: expected two corners",
        ),
    ]:
        with pytest.raises(InputError, match=told):
            compose([*words, *more])


def test_pictures_show_the_rectangle() -> None:
    """In the pose of the car, and contacts are those of its body."""
    setup = compose(["scenario=parking"])
    layouts = setup.layouts(1)
    body = VehicleBody.of(setup.task(layouts).problem)
    X = np.zeros((1, 5, 5))
    X[0] = np.linspace(layouts.start[0], [-1.3, -0.6, 0.3, 0, 0], 5)
    rows = trials(*flights("gco", [False])).assign(scenario="parking", model="car")
    figure = layout_grid(layouts.arrays(), {"gco": X}, rows, body=body)
    (ax,) = figure.axes
    drawn = next(held for held in ax.collections if isinstance(held, PolyCollection) and len(held.get_paths()) == 5)
    x, y, heading = X[0, 2, :3]
    turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
    corners = np.array([[-0.7, -0.9], [3.3, -0.9], [3.3, 0.9], [-0.7, 0.9]]) @ turn.T + [x, y]
    seen = drawn.get_paths()[2].vertices
    assert all(np.linalg.norm(seen - corner, axis=1).min() < 1e-12 for corner in corners)
    touched = [line for line in ax.lines if line.get_marker() == "X"]
    assert len(touched) == 1 and touched[0].get_xydata()[-1, 1] < 0.5
    assert "the body of gco, at some times" in [text.get_text() for text in figure.legends[0].get_texts()]
    ball = layout_grid(layouts.arrays(), {"gco": X}, rows)
    assert not any(len(held.get_paths()) == 5 for held in ball.axes[0].collections)
