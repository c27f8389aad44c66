"""A page in a notebook: `solution.show(problem)`."""

from __future__ import annotations

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.html import HtmlPage
from torchgco.base.shapes import check_shape
from torchgco.constraints.base import Constraint
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem, check_problem
from torchgco.solution import Solution
from torchgco.view.document import Document
from torchgco.view.flights import Rows, flights_of
from torchgco.view.page import page
from torchgco.view.searches import search_of
from torchgco.view.vehicles import look_of


def show(problem: Problem, solution: Solution, name: str = "solution") -> HtmlPage:
    """The page of a batch of problems, a layout each, with their trajectories, and the search where it was recorded.

    Raises:
        InputError: a problem of another form, an empty one, or dynamics without a position in the plane or in space.
    """
    check_problem(problem)
    check_shape(solution.X, (problem.B, problem.N + 1, problem.n), "problem: solution.X")
    check_shape(solution.U, (problem.B, problem.N, problem.m), "problem: solution.U")
    dimension = problem.position.stop - problem.position.start
    if dimension not in (2, 3):
        raise InputError("dynamics.position", "a position in the plane or in space", f"{dimension} states")
    if problem.B == 0:
        raise InputError("problem", "at least one problem to show", "an empty batch")
    look, rows, results, touching = look_of(problem.dynamics), *_told(problem, solution)
    flights = flights_of(problem, look, solution.X, solution.U, name, results, rows, ADMITTED, touching)
    radius = max((float(part.vehicle_radius.max()) for part in problem.obstacles), default=0.0)
    document = Document(
        title="torchgco", about=f"{problem.B} problems, {problem.N} stages" if problem.B > 1 else f"{problem.N} stages",
        dimension=dimension, dt=float(problem.dynamics.dt), look=look, radius=radius, solvers=[name],
        constraints=[constraint_name(part) for part in problem.constraints],
    )  # fmt: skip
    for b, flight in enumerate(flights):
        document.add(f"problem {b}", problem, b, [flight], search_of(solution, problem, b))
    return HtmlPage(page(document), "Trajectories among obstacles")


def _told(problem: Problem, solution: Solution) -> tuple[list[Rows], list[str], np.ndarray]:
    """What the table says of each problem, its result, and where contact is looked for."""
    try:
        frame = solution.to_frame(problem)
    except InputError:  # obstacles of a kind that can't be judged
        frame = solution.to_frame()
    worst = solution.worst_rows(problem)
    rows, results = [], []
    for b, row in enumerate(frame.to_dict("records")):
        held: Rows = [("status", str(row["status"])), ("cost", f"{row['cost']:.6g}")]
        held += [("clearance", f"{row['clearance']:.3f} m")] if np.isfinite(row.get("clearance", np.nan)) else []
        held += [("violation", f"{row['violation']:.2g}"), ("iterations", str(row["iterations"]))]
        at = worst.loc[b]
        held += [("worst", f"{at['name']}, knot {at['knot']}: {at['violation']:.2g}")] if at["constraint"] >= 0 else []
        rows.append(held)
        good = bool(row["violation"] <= ADMITTED)
        results.append("reached" if good and row.get("reached", False) else "feasible" if good else "failed")
    clearance = frame["clearance"].to_numpy() if "clearance" in frame else np.full(problem.B, -np.inf)
    return rows, results, ~(clearance >= 0)


def constraint_name(part: Constraint) -> str:
    """The user's name of a constraint, else its kind, as `worst_rows` has it."""
    given = getattr(part, "name", None)
    return given if isinstance(given, str) and given != "constraint" else type(part).__name__.removeprefix("Bound")
