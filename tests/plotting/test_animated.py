"""Films of solutions: pictures of what moves, files, notebooks, and calls that can't be shown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import torchgco
from torchgco import Body, Boxes, ControlBounds, Ellipsoids, FunctionDynamics, Problem, QuadraticCost, Spheres
from torchgco.base.errors import InputError

POINT = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.1, "rk4", position=slice(0, 2))
COST = QuadraticCost([0.0] * 4, [0.1] * 2, [100.0] * 4, x_ref=[2.0, 0.0, 0.0, 0.0])
X0 = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0]]).double()
MOVING = Spheres([[1.0, -1.0]], [0.2], 0.1, [[0.0, 1.0]])


def problem(*parts: object, N: int = 20) -> Problem:
    return Problem(POINT, COST, [*parts, ControlBounds(-9.0, 9.0)], X0, N)


def colours(path: Path) -> list[int]:
    """How many pixels of each picture of a file are dark grey, as an obstacle's are, to the nearest ten."""
    pictures = []
    with Image.open(path) as film:
        for i in range(film.n_frames):
            film.seek(i)
            pictures.append(np.asarray(film.convert("RGB")).astype(int))
    return [int(np.abs(a - b).sum()) for a, b in zip(pictures, pictures[1:], strict=False)]


@pytest.mark.parametrize("others", [(), (Ellipsoids([[0.5, 1.0]], [[0.1, 0.2]], 0.1, [0.3], [[0.0, -0.5]]),)])
def test_a_film_shows_what_moves(others: tuple[object, ...], tmp_path: Path) -> None:
    stated = problem(MOVING, *others)
    solution = torchgco.solve(stated, verbose=False)
    film = torchgco.animate(stated, solution, [0, 1])
    film.save(tmp_path / "way.gif", writer="pillow", dpi=50)
    changes = colours(tmp_path / "way.gif")
    assert len(changes) == 40 and min(changes) > 0
    figure, places = film._fig, []
    for t in (0.0, 1.0, 2.0):
        film._func(t)
        (ball,) = [p for p in figure.axes[0].patches if p.get_zorder() == 1.0]
        places.append(0.5 * (ball.get_path().vertices.max(0) + ball.get_path().vertices.min(0)))
    np.testing.assert_allclose(np.array(places), [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]], atol=0.02)


def test_a_notebook_plays_it_with_a_body() -> None:
    body = Body.covering([-0.2, -0.1], [0.2, 0.1], [2, 1])
    model = torchgco.Unicycle(dt=0.1)
    cost = QuadraticCost([0.0] * 4, [0.1] * 2, [100.0, 100.0, 0.0, 1.0], x_ref=[1.0, 0.0, 0.0, 0.0])
    boxes = Boxes([[0.5, 0.9]], [[0.2, 0.1]], body, angles=[0.3])
    stated = Problem(model, cost, [boxes], torch.zeros(1, 4, dtype=torch.float64), 5)
    film = torchgco.animate(stated, torchgco.solve(stated, verbose=False))
    assert "<script" in film._repr_html_()


def test_wrong_calls_are_told() -> None:
    stated = problem(MOVING)
    solution = torchgco.solve(stated, solver="hold", verbose=False)
    film = torchgco.animate(stated, solution)
    film._draw_was_started = True
    with pytest.raises(InputError, match=r"b: expected the place"):
        torchgco.animate(stated, solution, 2)
    apart = Problem(POINT, COST, [Spheres([[[1.0, 1.0]], [[1.0, 2.0]]], [0.2], 0.1)], X0, 20)
    with pytest.raises(InputError, match="same obstacles"):
        torchgco.animate(apart, torchgco.solve(apart, solver="hold", verbose=False), [0, 1])
    nowhere = Problem(FunctionDynamics(lambda x, u: u, 2, 2, 0.1), QuadraticCost([1.0] * 2, [1.0] * 2, [1.0] * 2), [], X0[:, :2], 5)
    with pytest.raises(InputError, match="position"):
        torchgco.animate(nowhere, torchgco.solve(nowhere, solver="hold", verbose=False))
