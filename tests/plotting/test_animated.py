"""Films of solutions: pictures of what moves, files, notebooks, and calls that can't be shown."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.patches import Circle, Polygon
from PIL import Image

import torchgco
from torchgco import Body, ControlBounds, Ellipsoids, FunctionDynamics, Problem, QuadraticCost, Spheres
from torchgco.base.errors import InputError

POINT = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", position=slice(0, 2))
COST = QuadraticCost([0.0] * 4, [0.1] * 2, [100.0] * 4, x_ref=[2.0, 0.0, 0.0, 0.0])
X0 = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]]).double()
MOVING = Spheres([[1.0, -1.0]], [0.2], 0.1, [[0.0, 1.0]])


def problem(*parts: object, N: int = 5) -> Problem:
    return Problem(POINT, COST, [*parts, ControlBounds(-9.0, 9.0)], X0, N)


def changes_in(path: Path) -> list[int]:
    """By how much each picture of a file differs from the one before."""
    pictures = []
    with Image.open(path) as film:
        for i in range(film.n_frames):
            film.seek(i)
            pictures.append(np.asarray(film.convert("RGB")).astype(int))
    return [int(np.abs(a - b).sum()) for a, b in pairwise(pictures)]


@pytest.mark.sampled(0)
@pytest.mark.parametrize("others", [(), (Ellipsoids([[0.5, 1.0]], [[0.1, 0.2]], 0.1, [0.3], [[0.0, -0.5]]),)])
def test_a_film_shows_what_moves(others: tuple[object, ...], tmp_path: Path) -> None:
    stated = problem(MOVING, *others)
    solution = torchgco.solve(stated, verbose=False)
    film = torchgco.animate(stated, solution, [0, 1])
    film.save(tmp_path / "way.gif", writer="pillow", dpi=50)
    changes = changes_in(tmp_path / "way.gif")
    assert len(changes) == 10 and min(changes) > 0


def test_obstacles_and_vehicles_are_where_they_are_then() -> None:
    stated = problem(MOVING)
    solution = torchgco.solve(stated, verbose=False)
    film = torchgco.animate(stated, solution)
    for t in (0.0, 0.25, 0.5):
        drawn = film.at(t)
        corners = [shape.get_path().vertices for shape in drawn if isinstance(shape, Polygon)]
        np.testing.assert_allclose([0.5 * (c.max(0) + c.min(0)) for c in corners], [[1.0, -1.0 + t]], atol=0.02)
        (vehicle,) = [shape for shape in drawn if isinstance(shape, Circle)]
        np.testing.assert_allclose(vehicle.center, then(solution, t, 0.1), atol=1.1e-3)


def then(solution: torchgco.Solution, t: float, dt: float, b: int = 0) -> np.ndarray:
    """Where the point of problem b is at t, s, after its last knot."""
    k = min(int(t / dt + 1e-9), solution.U.shape[1] - 1)
    x, u, h = solution.X[b, k], solution.U[b, k], t - dt * k
    return (x[:2] + h * x[2:] + 0.5 * h**2 * u).numpy()


@pytest.mark.parametrize("free", [False, True])
def test_pictures_follow_the_path_between_the_knots(free: bool) -> None:
    """In half a second the path leaves its chord by 0.3 m, three radii of the vehicle."""
    model = FunctionDynamics(POINT.function, 4, 2, 0.5, "rk4", position=slice(0, 2))
    goal, time = torchgco.Goal(state=[4.0, 0.0, 0.0, 0.0], required=True), torchgco.FreeTime(0.2, 3.0, 1.0)
    limits = [MOVING, ControlBounds(-9.0, 9.0)]
    stated = Problem(model, COST, limits, X0[:1], 6, goal if free else None, time=time if free else None)
    solution = torchgco.solve(stated, verbose=False)
    times = solution.t[0] if free else 0.5 * torch.arange(7).double()
    dt, film = float(times[1]), torchgco.animate(stated, solution)
    for t in np.random.default_rng(0).uniform(0.0, float(times[-1]), 12):
        drawn = film.at(t)
        (vehicle,) = [shape for shape in drawn if isinstance(shape, Circle)]
        np.testing.assert_allclose(vehicle.center, then(solution, t, dt), atol=1.1e-3)
        (ball,) = [shape.get_path().vertices for shape in drawn if isinstance(shape, Polygon)]
        np.testing.assert_allclose(0.5 * (ball.max(0) + ball.min(0)), [1.0, t - 1.0], atol=1e-3)
    scene = torchgco.plot(stated, solution).axes[0]
    (way,) = [np.column_stack(line.get_data()) for line in scene.lines if len(line.get_xdata()) > 20]
    path = np.stack([then(solution, t, dt) for t in np.linspace(0.0, float(times[-1]), 2001)])
    assert np.linalg.norm(path[:, None] - way, axis=-1).min(0).max() < 2e-3


def test_flights_of_other_durations_are_among_the_same_obstacles() -> None:
    """Whose obstacles went from knot to knot in the times of each, which can't be in one picture."""
    model = FunctionDynamics(POINT.function, 4, 2, 0.5, "rk4", position=slice(0, 2))
    goal, time = torchgco.Goal(state=[4.0, 0.0, 0.0, 0.0], required=True), torchgco.FreeTime(0.2, 3.0, 1.0)
    starts = torch.tensor([[0.0, 0.0, 0.0, 0.0], [1.6, 0.5, 0.0, 0.0]]).double()
    stated = Problem(model, COST, [MOVING, ControlBounds(-9.0, 9.0)], starts, 6, goal, time=time)
    solution = torchgco.solve(stated, verbose=False)
    film, ends = torchgco.animate(stated, solution, [0, 1]), solution.t[:, -1]
    assert float((ends[0] - ends[1]).abs()) > 0.1
    for t in np.linspace(0.0, float(ends.max()), 5):
        drawn = film.at(t)
        (ball,) = [shape.get_path().vertices for shape in drawn if isinstance(shape, Polygon)]
        np.testing.assert_allclose(0.5 * (ball.max(0) + ball.min(0)), [1.0, t - 1.0], atol=1e-3)
        for b, shape in enumerate(shape for shape in drawn if isinstance(shape, Circle)):
            due = then(solution, min(t, float(ends[b])), float(solution.t[b, 1]), b)
            np.testing.assert_allclose(shape.center, due, atol=1.1e-3)
    scene, *_ = torchgco.plot(stated, solution).axes
    passed = [text for text in scene.texts if text.get_text().endswith(" s")]
    assert passed  # at the time itself
    for text in passed:
        y, seconds = text.get_position()[1], float(text.get_text().removesuffix(" s"))
        assert abs(y - (seconds - 1.0)) < 0.06


@pytest.mark.slow
def test_a_notebook_plays_it_with_a_body() -> None:
    body = Body.covering([-0.2, -0.1], [0.2, 0.1], [2, 1])
    model = torchgco.Unicycle(dt=0.1)
    cost = QuadraticCost([0.0] * 4, [0.1] * 2, [100.0, 100.0, 0.0, 1.0], x_ref=[1.0, 0.0, 0.0, 0.0])
    boxes = Spheres([[0.5, 0.9]], [0.2], body)
    stated = Problem(model, cost, [boxes], torch.zeros(1, 4, dtype=torch.float64), 5)
    film = torchgco.animate(stated, torchgco.solve(stated, verbose=False))
    assert "<script" in film._repr_html_()


@pytest.mark.parametrize("seed", range(3))
def test_a_body_is_where_it_is_then(seed: int) -> None:
    """Between two knots it stood at the first one, up to a stage behind what moves beside it."""
    random, dt = np.random.default_rng(seed), 0.5
    body, start = Body.covering([-0.2, -0.1], [0.3, 0.1], [2, 1]), torch.tensor([[0.0, 0.0, 0.4, 1.0]]).double()
    cost = QuadraticCost([0.0] * 4, [0.1] * 2, [1.0, 1.0, 0.0, 1.0])
    stated = Problem(torchgco.Unicycle(dt=dt), cost, [Spheres([[9.0, 9.0]], [0.2], body)], start, 4)
    given = torch.tensor(random.uniform(-0.5, 0.5, (1, 4, 2)))
    solution = torchgco.solve(stated, given, solver="hold", verbose=False)
    film, X = torchgco.animate(stated, solution), solution.X[0]
    for t in random.uniform(0.0, 4 * dt, 6):
        k = int(t / dt)
        x, y, heading, _ = torchgco.Unicycle(dt=t - k * dt).step(X[k], solution.U[0, k]).tolist()
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        corners = np.array([[-0.2, -0.1], [-0.2, 0.1], [0.3, -0.1], [0.3, 0.1]]) @ turn.T + [x, y]
        (outline,) = [shape.get_path().vertices[:-1] for shape in film.at(t) if isinstance(shape, Polygon)]
        assert np.linalg.norm(outline[:, None] - corners, axis=-1).min(0).max() < 2e-3


def test_a_film_that_needs_ffmpeg_says_so_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("matplotlib.animation.writers.is_available", lambda name: name == "pillow")
    film = torchgco.animate(problem(), torchgco.solve(problem(), solver="al_ilqr", verbose=False))
    with pytest.raises(
        InputError, match=r"filename: expected a name\.gif, as ffmpeg, .* isn't installed, got .*way\.mp4"
    ):
        film.save(tmp_path / "way.mp4")
    film.save(str(tmp_path / "way.gif"))
    assert [path.name for path in tmp_path.iterdir()] == ["way.gif"]


def test_wrong_calls_are_told() -> None:
    stated = problem(MOVING)
    solution = torchgco.solve(stated, solver="hold", verbose=False)
    with pytest.raises(InputError, match=r"b: expected the place"):
        torchgco.animate(stated, solution, 2)
    apart = Problem(POINT, COST, [Spheres([[[1.0, 1.0]], [[1.0, 2.0]]], [0.2], 0.1)], X0, 5)
    with pytest.raises(InputError, match="same obstacles"):
        torchgco.animate(apart, torchgco.solve(apart, solver="hold", verbose=False), [0, 1])
    still = FunctionDynamics(lambda x, u: u, 2, 2, 0.1)
    nowhere = Problem(still, QuadraticCost([1.0] * 2, [1.0] * 2, [1.0] * 2), [], X0[:, :2], 5)
    with pytest.raises(InputError, match="position"):
        torchgco.animate(nowhere, torchgco.solve(nowhere, solver="hold", verbose=False))
