"""`torchgco.plot`: what it shows is the solution, the obstacles and the bounds."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from torch import Tensor

import torchgco
from tests.problems import planar_batch, quadrotor_batch
from torchgco import Boxes, ControlBounds, Goal, InputError, Problem, Separation, Solution, Spheres, StateBounds
from torchgco.constraints.base import Constraint
from torchgco.obstacles import Obstacles
from torchgco.plotting.problems import LIMIT
from torchgco.plotting.scene import distances, world_of
from torchgco.plotting.style import PALETTE

ROOT = Path(__file__).resolve().parents[2]


def flown(problem: Problem, U0: Tensor | None = None) -> Solution:
    return torchgco.solve(problem, U0, solver="hold")


def axes_of(figure: Figure) -> list[Axes]:
    figure.canvas.draw()
    return figure.axes


def lines_at(ax: Axes, level: float) -> int:
    """How many dashed limits lie at a level."""
    held = [np.asarray(line.get_ydata(), dtype=float) for line in ax.lines if line.get_color() == LIMIT]
    return sum(np.allclose(y[np.isfinite(y)], level) for y in held)


def test_one_scene_serves_problems_with_the_same_obstacles_and_bounds_are_dashed() -> None:
    problem, _ = planar_batch(B=1, N=20, obstacles=3)
    spheres = problem.constraints[0]
    assert isinstance(spheres, Obstacles)
    centers = spheres.centers[0]  # type: ignore[attr-defined]
    constraints = [Spheres(centers, [0.1] * 3, 0.06), ControlBounds([-10, -4], [10, 4])]
    problem = Problem(problem.dynamics, problem.cost, constraints, problem.x0.repeat(3, 1), 20)
    U = torch.zeros(3, 20, 2).double()
    U[:, :, 0], U[:, :, 1] = torch.tensor([9.0, 1.0, -9.0]).double()[:, None], 2.0
    solution = flown(problem, U)
    scene, *histories = axes_of(torchgco.plot(problem, solution))
    assert len(histories) == problem.n + problem.m
    paths = [np.column_stack(line.get_data()) for line in scene.lines if len(line.get_xdata()) == 21]
    assert len(paths) == 3
    for path, X in zip(paths, solution.X, strict=True):
        np.testing.assert_allclose(path, X[:, :2])
    for j, ax in enumerate(histories[: problem.n]):
        np.testing.assert_allclose(ax.lines[0].get_ydata(), solution.X[0, :, j])
        np.testing.assert_allclose(ax.lines[0].get_xdata(), solution.t)
    assert [lines_at(histories[-2], level) for level in (-10, 10)] == [3, 3]
    assert [lines_at(histories[-1], level) for level in (-4, 4)] == [0, 0]  # far from a control that is always 2
    assert len(axes_of(torchgco.plot(problem, solution, [0, 2]))[0].texts) == 0
    assert len(axes_of(torchgco.plot(problem, solution, 1))) == 1 + problem.n + problem.m


def test_each_has_a_scene_where_obstacles_differ() -> None:
    problem, U0 = planar_batch(B=3, N=10, obstacles=3)
    axes = axes_of(torchgco.plot(problem, flown(problem, U0), b=[0, 1]))
    assert len(axes) == 2 + problem.n + problem.m


def test_each_trajectory_has_its_own_ring_where_it_passes_a_moving_disc() -> None:
    """Drawn at one time alone, a disc would seem to be crossed by the others."""
    base, _ = planar_batch(B=1, N=20, obstacles=1)
    start = torch.tensor([[-1.0, 0, 0, 0, 0, 0], [-1.0, 0.3, 0, 0, 0, 0]]).double()
    discs = Spheres([[0.0, 0.9]], [0.1], 0.06, velocities=[[0.0, -0.8]])
    problem = Problem(base.dynamics, base.cost, [discs], start, 20, Goal([1.0, 0.4], 0.1))
    share = torch.linspace(0, 1, 21).double()
    X = start.unsqueeze(1).repeat(1, 21, 1)
    X[0, :, 0], X[1, :, 0] = -1 + 2 * share, -1 + 2 * share.square()  # the second is slower at first
    found = replace(flown(problem), X=X)
    figure = torchgco.plot(problem, found)
    scene, colours = axes_of(figure)[0], PALETTE[:2]
    times = np.asarray(found.t)
    for b, colour in enumerate(colours):
        centers = np.stack((0 * times, 0.9 - 0.8 * times), axis=-1)
        k = int(np.linalg.norm(X[b, :, :2].numpy() - centers, axis=1).argmin())
        rings = [held for held in scene.collections if to_hex(held.get_edgecolor()[0]) == colour.lower()]
        assert len(rings) == 2, "the vehicle, and the disc, as they are then"
        wanted = (X[b, k, :2].numpy(), 0.06), (centers[k], 0.1)
        for ring, (center, radius) in zip(sorted(rings, key=reach), wanted, strict=True):
            (outline,) = ring.get_paths()
            np.testing.assert_allclose(np.linalg.norm(outline.vertices - center, axis=1), radius, atol=1e-9)
        box = np.transpose([scene.get_xlim(), scene.get_ylim()])
        assert (box[0] <= centers[k] - 0.1).all() and (box[1] >= centers[k] + 0.1).all(), "and the disc is all there"
        (place,) = [line for line in scene.lines if line.get_marker() == "o" and line.get_color() == colour]
        np.testing.assert_allclose(np.column_stack(place.get_data()), X[b, k : k + 1, :2].numpy())
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"moving obstacle as the trajectory of its colour passes", "and the vehicle then"} < set(words)


def reach(held: Any) -> float:
    return float(np.ptp(held.get_paths()[0].vertices[:, 0]))


def test_in_space_there_are_two_views_cut_where_it_flies() -> None:
    problem, U0 = quadrotor_batch(B=1, N=10, obstacles=4)
    above, side, *_ = axes_of(torchgco.plot(problem, flown(problem, U0), 0))
    assert (above.get_ylabel(), side.get_ylabel()) == ("y [m]", "z [m]")
    ring = [patch for patch in above.patches if isinstance(patch, Circle)]
    assert ring and ring[0].get_radius() == pytest.approx(float(problem.goal.radius[0]))  # type: ignore[union-attr]


def test_bodies_are_those_of_the_problem() -> None:
    base, _ = planar_batch(B=2, N=10, obstacles=2)
    boxes = Boxes(
        [[0.5, 0.5], [np.nan, np.nan]], [[0.1, 0.2], [np.nan, np.nan]], radii=[0.05, np.nan], vehicle_radius=0.1
    )
    moving = Spheres([[0.0, 0.3]], [0.2], vehicle_radius=0.3, velocities=[[0.1, 0.0]])
    problem = Problem(base.dynamics, base.cost, [boxes, moving], base.x0, 10)
    world = world_of(problem, 1)
    assert [scene.margin for scene in world.scenes] == [0.1, 0.3] and not world.others
    (box,), (ball,) = (scene.bodies[0] for scene in world.scenes)
    assert box.radius == pytest.approx(0.05) and np.allclose(box.center, [0.5, 0.5])
    assert ball.moving and ball.radius == pytest.approx(0.2) and np.allclose(ball.at(2.0), [0.2, 0.3])


@dataclass(frozen=True)
class Shore(Obstacles):
    """Land where y > 0.5, of a kind that plots know nothing of."""

    vehicle_radius: Tensor
    knots: Any = None
    position: Any = None
    dt: float = 0.0
    batched = ("vehicle_radius",)
    margins = property(lambda self: self.vehicle_radius.unsqueeze(-1))
    absent = property(lambda self: torch.zeros_like(self.margins, dtype=torch.bool))

    def bind(self, dims: Any) -> Constraint:
        return replace(self, knots=slice(1, dims.N + 1), position=dims.position, dt=dims.dt)

    def signed_distance(self, p: Tensor, t: Tensor) -> Tensor:
        return (0.5 - self.vehicle_radius).view(-1, 1, 1) - p[..., 1:2]

    def value(self, X: Tensor, U: Tensor) -> Tensor:
        return -self.signed_distance(X[:, self.knots, self.position], X)


def test_obstacles_of_a_users_kind_are_drawn_by_their_distance() -> None:
    base, _ = planar_batch(B=1, N=10, obstacles=1)
    problem = Problem(base.dynamics, base.cost, [Shore(torch.tensor([0.1], dtype=torch.float64))], base.x0, 10)
    (part,) = world_of(problem, 0).others
    _, y, apart = distances(part, np.array([[-1.0, 0.0], [1.0, 1.0]]), (0, 1), 0.0)
    np.testing.assert_allclose(apart, 0.4 - y, atol=1e-12)
    scene = axes_of(torchgco.plot(problem, flown(problem)))[0]
    assert any(len(filled.get_paths()) for filled in scene.collections)


def test_trajectories_end_at_their_own_horizon_and_every_vehicle_is_drawn() -> None:
    base, _ = planar_batch(B=2, N=10, obstacles=1)
    apart = Separation([[0, 1], [3, 4]], 0.1)
    limits = StateBounds([-2.0, *[-torch.inf] * 5], torch.inf)
    problem = Problem(base.dynamics, base.cost, [apart, limits], base.x0, 10, Goal([1, 0.4], 0.1), horizon=[10, 4])
    axes = axes_of(torchgco.plot(problem, flown(problem), 1))
    for line in (axes[1].lines[0], axes[-1].lines[0]):  # the last control is held for a stage
        assert len(line.get_ydata()) == 5 and line.get_xdata()[-1] == 4 * base.dynamics.dt
    assert len([line for line in axes[0].lines if len(line.get_xdata()) == 5]) == 2


def test_without_a_position_there_are_histories_alone_and_without_a_step_knots() -> None:
    class Counter(torchgco.Dynamics):
        n, m = 1, 1

        def step(self, x: Tensor, u: Tensor) -> Tensor:
            return x + u

    cost = torchgco.FunctionCost(lambda x, u: u.square().sum(-1), lambda x: (x[..., 0] - 1.0).square())
    problem = Problem(Counter(), cost, [], torch.zeros(1, 1).double(), 5)
    axes = axes_of(torchgco.plot(problem, flown(problem)))
    assert len(axes) == 2 and axes[0].get_xlabel() == "knot"


@pytest.mark.slow
def test_notebooks_show_the_figure_without_pyplot() -> None:
    """In a process of its own: whoever has loaded pyplot has figures shown by its backend."""
    code = """
import sys, torch, torchgco
from IPython.core.formatters import DisplayFormatter
from tests.problems import planar_batch
problem, U0 = planar_batch(B=1, N=10, obstacles=1)
data, _ = DisplayFormatter().format(torchgco.plot(problem, torchgco.solve(problem, U0, solver="hold")))
print(data["image/png"][:4], "matplotlib.pyplot" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == r"b'\x89PNG' False"


def test_wrong_places_and_solutions_are_refused() -> None:
    problem, U0 = planar_batch(B=2, N=10, obstacles=1)
    solution = flown(problem, U0)
    for b in (2, [], [0, -1], "0", True, 0.5):
        with pytest.raises(InputError, match="b: expected the place"):
            torchgco.plot(problem, solution, b)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"problem: solution\.X"):
        torchgco.plot(planar_batch(B=2, N=11)[0], solution)
    lost = replace(solution, X=torch.full_like(solution.X, torch.nan))
    assert len(axes_of(torchgco.plot(problem, lost, 0))) == 1 + problem.n + problem.m
