"""plot, animate and show: pictures of solutions, whose libraries are loaded when one is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from torchgco.base.errors import InputError
from torchgco.fleets import Fleet, FleetSolution
from torchgco.phases import Phases, PhasesSolution
from torchgco.problem.problem import Problem, current_problem
from torchgco.solution import Solution

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure

    from torchgco.base.html import HtmlPage


def plot(
    problem: Problem | Fleet | Phases,
    solution: Solution | FleetSolution | PhasesSolution,
    b: int | Sequence[int] | None = None,
) -> Figure:
    """The scene with the trajectories, then states and controls over time, with their bounds dashed.

    Of a fleet a colour for each vehicle, with squares where they start and stars at their goals, then how far each is
    from the nearest other one. Of phases all of them one after the other: in one scene, where they have positions of
    the same dimension, and over time; components of the same name share a panel, and dotted lines mark the jumps.

    In space obstacles are cut at the height, in the side view at the y, that the first trajectory has there; crosses
    mark contact, between the knots too. Bounds far from all values are left out. A notebook shows the figure;
    `figure.savefig("name.pdf")` writes it.

    Args:
        problem, solution: as solved.
        b: the place of a problem in the batch, or several; None: the first six. Those with the same obstacles and goal
            share a scene. Of a fleet one place; None: the first.

    Raises:
        InputError: a place that isn't there, or a solution of other problems.
    """
    if isinstance(problem, Fleet) or isinstance(solution, FleetSolution):
        return _of_fleet("fleet_figure", problem, solution, b)
    if isinstance(problem, Phases) or isinstance(solution, PhasesSolution):
        return _phases_figure(problem, solution, b)
    problem = current_problem(problem)
    from torchgco.plotting.problems import solution_figure  # matplotlib takes a second to load

    return solution_figure(problem, solution.detach(), b)


def _phases_figure(phases: Any, solution: Any, b: Any) -> Figure:
    from torchgco.plotting.problems import figure_of, legs_of  # matplotlib takes a second to load

    return figure_of(legs_of(*_phases_of(phases, solution), b))


def _phases_of(phases: Any, solution: Any) -> tuple[Sequence[Problem], Sequence[Solution], np.ndarray, np.ndarray]:
    """Problems and solutions of phases, when each begins, (B, P+1), s, and the costs of all, (B,)."""
    if not isinstance(phases, Phases) or not isinstance(solution, PhasesSolution) or len(solution) != len(phases):
        raise InputError("solution", "phases and their solution", type(solution).__name__)
    solution = solution.detach()
    try:
        begins = solution.begins
    except InputError:  # models without a time step: knots are counted
        counts = torch.tensor([0, *(one.N for one in solution.problems)]).cumsum(0)
        begins = counts.expand(phases.B, -1)
    return solution.problems, solution.parts, begins.cpu().numpy(), solution.cost.cpu().numpy()


def _of_fleet(picture: str, fleet: Any, solution: Any, b: Any) -> Any:
    from torchgco.plotting import fleets  # matplotlib takes a second to load

    _fleet_of(fleet, solution)
    members, X, U, distances = solution.arrays()
    return getattr(fleets, picture)(members, X, U, distances, b)


def _fleet_of(fleet: Any, solution: Any) -> tuple[Sequence[Problem], Sequence[Solution]]:
    if not isinstance(fleet, Fleet) or not isinstance(solution, FleetSolution) or len(solution) != fleet.V:
        raise InputError("solution", "a fleet and its solution", type(solution).__name__)
    return fleet.members, solution.vehicles


def animate(
    problem: Problem | Fleet | Phases,
    solution: Solution | FleetSolution | PhasesSolution,
    b: int | Sequence[int] = 0,
) -> FuncAnimation:
    """A film of trajectories among obstacles, also those that move, at 20 pictures a second in real time.

    A notebook plays it; `.save("way.gif")` writes it, and where ffmpeg is installed `.save("way.mp4")`. In space from
    above and from the side. Flights of over 12 s are shown faster. Of phases all of them one after the other, each with
    its own body, among its own obstacles; a jump is an instant. Of a fleet all vehicles, as discs half as wide as what
    they keep from each other.

    Args:
        problem, solution: as solved.
        b: the place of a problem or a fleet in the batch, or of several problems among the same obstacles.

    Raises:
        InputError: a place that isn't there, a solution of other problems, other obstacles, or dynamics without a
            position in 2-D or 3-D, the same in all phases.
    """
    from torchgco.plotting.animated import film_of, solution_film  # matplotlib takes a second to load
    from torchgco.plotting.problems import legs_of

    if isinstance(problem, Fleet) or isinstance(solution, FleetSolution):
        return _of_fleet("fleet_film", problem, solution, b)
    if isinstance(problem, Phases) or isinstance(solution, PhasesSolution):
        return film_of(legs_of(*_phases_of(problem, solution), b), b)
    return solution_film(current_problem(problem), solution.detach(), b)


def show(problem: Problem | Fleet | Phases, solution: Solution | FleetSolution | PhasesSolution) -> HtmlPage:
    """A page of the trajectories that one turns around, in a notebook or, with `.save(path)`, as an HTML file.

    Of fleets with a colour for each vehicle. Of phases with a colour for each, one after the other in time; each one's
    vehicle and obstacles are there while it lasts.

    Raises:
        InputError: a problem of another form, an empty one, or dynamics without a position in 2-D or 3-D.
    """
    from torchgco.view import notebook  # slow to load

    if isinstance(problem, Fleet) or isinstance(solution, FleetSolution):
        return notebook.show_fleet(*_fleet_of(problem, solution))
    if isinstance(problem, Phases) or isinstance(solution, PhasesSolution):
        return notebook.show_phases(*_phases_of(problem, solution)[:3])
    problem = current_problem(problem)
    return notebook.show(problem, solution.detach())
