"""Vehicles with a body on the page: the box or the balls, turned as the body is, and obstacles that aren't grown."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchgco
from tests.view.browser import Tab
from torchgco import Body, Boxes, Goal, Problem, QuadraticCost, QuadrotorPlanning, Spheres, Unicycle
from torchgco.plotting.vehicle_body import VehicleBody
from torchgco.view.shapes import shapes_of
from torchgco.view.vehicles import shape_of, turned


def drive(body: Body) -> Problem:
    """Two unicycles that pass a box."""
    cost = QuadraticCost(Q=[0.1, 0.1, 0, 0.1], R=[0.1, 0.1], Qf=[100, 100, 0, 10], x_ref=[4.0, 1, 0, 0])
    x0 = torch.tensor([[0.0, -0.8, 0.4, 0.0], [0.0, 0.8, -1.9, 0.0]], dtype=torch.float64)
    walls = Boxes([[2.0, 4.0]], [[0.4, 3.0]], body)
    return Problem(Unicycle(dt=0.1), cost, [walls], x0, 12, Goal([4.0, 1], 0.3))


def test_the_box_is_the_one_that_is_covered() -> None:
    problem = drive(Body.covering([-0.9, -0.3], [0.5, 0.3], [4, 2]))
    shape = shape_of(problem)
    assert shape is not None and shape.packed()["box"] == [[-0.9, -0.3], [0.5, 0.3]]
    assert len(shape.balls) == 8 and not shape.balls[:, 2].any()
    assert np.hypot(0.9, 0.3) < shape.reach < 1.2 * np.hypot(0.9, 0.3)
    assert shape_of(drive(0.2)) is None  # type: ignore[arg-type]


def test_a_body_turns_the_vehicle() -> None:
    X = np.array([[0.0, 0.0, 2.5, 0.0], [1.0, 0.0, -0.4, 0.0]])
    by_function = Body([[0.2, 0.0], [0.0, 0.1]], 0.1, lambda x: quarter(x[..., 2]))
    for body, more in ((Body([[0.2, 0.0], [0.0, 0.1]], 0.1), 0.0), (by_function, np.pi / 2)):
        held = VehicleBody.of(drive(body))
        assert held is not None
        q = Rotation.from_quat(turned(held, X)[:, [1, 2, 3, 0]])
        np.testing.assert_allclose(q.apply([1.0, 0, 0])[:, 0], np.cos(X[:, 2] + more), atol=1e-12)
        np.testing.assert_allclose(q.apply([1.0, 0, 0])[:, 1], np.sin(X[:, 2] + more), atol=1e-12)
    flat = VehicleBody.of(drive(Body([[0.2, 0.0], [0.0, 0.1]], 0.1)))
    assert flat is not None and turned(flat, np.zeros((2, 4))).tolist() == [[1, 0, 0, 0]] * 2


def quarter(angle: torch.Tensor) -> torch.Tensor:
    """Turned by a quarter more."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack((torch.stack((-sin, -cos), dim=-1), torch.stack((cos, -sin), dim=-1)), dim=-2)


def test_a_quaternion_turns_a_body_in_space() -> None:
    body = Body([[0.2, 0.0, 0.0], [-0.1, 0.2, 0.05]], 0.1, "quaternion")
    cost, x0 = QuadraticCost([1.0] * 14, [1.0] * 4, [1.0] * 14), torch.zeros(1, 14, dtype=torch.float64)
    x0[:, 6] = 1.0
    problem = Problem(QuadrotorPlanning(), cost, [Spheres([[9.0, 0, 0]], [1.0], body)], x0, 4)
    X = np.zeros((3, 14))
    X[:, 6:10] = np.random.default_rng(0).normal(size=(3, 4))
    held = VehicleBody.of(problem)
    assert held is not None
    turns = Rotation.from_quat(turned(held, X)[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(turns, Rotation.from_quat(X[:, [7, 8, 9, 6]]).as_matrix(), atol=1e-12)


def test_obstacles_keep_their_size() -> None:
    problem = drive(Body.covering([-0.9, -0.3], [0.5, 0.3], [4, 2]))
    shapes = shapes_of(problem.obstacles[0].inscribed, 0, 1.0)
    assert shapes is not None and shapes.half.tolist() == [[0.4, 3.0]]
    np.testing.assert_allclose(shapes.radius, 0.0, atol=1e-12)


@pytest.mark.slow
def test_the_page_draws_a_body(chromium, tmp_path) -> None:
    problem = drive(Body.covering([-0.9, -0.3], [0.5, 0.3], [4, 2]))
    path = tmp_path / "body.html"
    torchgco.show(problem, torchgco.solve(problem, solver="hold", verbose=False)).save(path)
    tab: Tab = chromium()
    tab.open(path)
    box = tab.evaluate("""(() => { const { geometry, position } = torchgcoView.flights.all[0].body.children[0];
        const { width, height } = geometry.parameters; return [width, height, position.x, position.y]; })()""")
    np.testing.assert_allclose(box, [1.4, 0.6, -0.2, 0.0], atol=1e-6)
    assert tab.evaluate("document.getElementById('grown').closest('label').hidden") is True
    assert not tab.errors
