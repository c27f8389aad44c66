"""A page in a notebook: `torchgco.show(problem, solution)`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchgco.base.errors import InputError
from torchgco.base.html import HtmlPage
from torchgco.base.shapes import check_shape
from torchgco.judging.worst import kind_of
from torchgco.obstacles.base import ADMITTED
from torchgco.problem.problem import Problem, current_problem
from torchgco.problem.times import times
from torchgco.solution import Solution
from torchgco.view.document import Document, Rows, ShownFlight, ShownPhase, flights_of, radius_of
from torchgco.view.page import page
from torchgco.view.searches import search_of
from torchgco.view.vehicles import look_of, shape_of


def show(problem: Problem, solution: Solution, name: str = "solution") -> HtmlPage:
    """The page of a batch of problems, a layout each, with their trajectories, and the search where it was recorded.

    Raises:
        InputError: a problem of another form, an empty one, or dynamics without a position in the plane or in space.
    """
    problem = current_problem(problem)
    flights, look = _flights(problem, solution, name), look_of(problem.dynamics)
    t_of, dt = _times(problem, solution)
    N = problem.N
    about = f"{problem.B} problems, {N} stages" if problem.B > 1 else f"{N} stages"
    document = Document.of(problem, title="torchgco", about=about, dt=dt, look=look, solvers=[name])
    for b, flight in enumerate(flights):
        last = N if solution.horizon is None else int(solution.horizon[b])
        t = None if t_of is None else t_of[b, : last + 1]
        document.add(f"problem {b}", problem, b, [flight.until(last)], search_of(solution, problem, b), t)
    return HtmlPage(page(document), "Trajectories among obstacles")


def _flights(problem: Problem, solution: Solution, name: str) -> list[ShownFlight]:
    check_shape(solution.X, (problem.B, problem.N + 1, problem.n), "problem: solution.X")
    check_shape(solution.U, (problem.B, problem.N, problem.m), "problem: solution.U")
    dimension = problem.position.stop - problem.position.start
    if dimension not in (2, 3):
        raise InputError("dynamics.position", "a position in the plane or in space", f"{dimension} states")
    if problem.B == 0:
        raise InputError("problem", "at least one problem to show", "an empty batch")
    look, (rows, results, touching) = look_of(problem.dynamics), _told(problem, solution)
    told = name, results, rows, ADMITTED, touching, solution.times
    flights = flights_of(problem, look, solution.X, solution.U, *told)
    return [replace(flight, times=None) for flight in flights]  # they are the layout's


def show_phases(members: Sequence[Problem], solutions: Sequence[Solution], begins: np.ndarray) -> HtmlPage:
    """The page of phases, one after the other, each in a colour of its own, with its vehicle and obstacles.

    Args:
        members, solutions: of each phase.
        begins: when each begins, (B, P+1), s.

    Raises:
        InputError: as `show`, of each phase; positions of other dimensions.
    """
    first, names = members[0], [f"phase {i + 1}" for i in range(len(members))]
    flights, t, constraints, knots = [], [], list[str](), 0
    for i, (one, found, name) in enumerate(zip(members, solutions, names, strict=True)):
        shown, before = _flights(one, found, name), len(constraints)
        if (sizes := [p.position.stop - p.position.start for p in (first, one)])[0] != sizes[1]:
            raise InputError("problem", f"a position in {sizes[0]}-D of all phases", f"{sizes[1]}-D of {name}")
        phase = ShownPhase(one, knots)
        flights.append([replace(f, phase=phase, worst=np.where(f.worst < 0, -1, f.worst + before)) for f in shown])
        constraints += [f"{kind_of(part)} of {name}" for part in one.constraints]
        own, dt = _times(one, found)
        own = dt * np.arange(one.N + 1) if own is None else own
        t.append(np.broadcast_to(own, (one.B, one.N + 1)) + begins[:, i : i + 1])
        knots += one.N + 1
    about = f"{first.B} problems of {len(members)} phases" if first.B > 1 else f"{len(members)} phases"
    look, shapes = look_of(first.dynamics), [shape for one in members if (shape := shape_of(one)) is not None]
    document = Document(
        "torchgco", about, first.position.stop - first.position.start, float(_times(first, solutions[0])[1]), look,
        max(radius_of(one) for one in members), names, constraints, shape=shapes[0] if shapes else None,
    )  # fmt: skip
    for b in range(first.B):
        times_of_all = np.concatenate([part[b] for part in t])
        document.add(f"problem {b}", first, b, [each[b] for each in flights], times=times_of_all, phases=members)
    return HtmlPage(page(document), "Phases one after the other")


def show_fleet(members: Sequence[Problem], solutions: Sequence[Solution]) -> HtmlPage:
    """The page of fleets, each with a colour for every vehicle, among the obstacles of the first one.

    Args:
        members: a problem per vehicle, of B fleets, all with a radius where they have obstacles.
    """
    document = fleet_document(members, "torchgco", f"{members[0].B} fleets of {len(members)} vehicles")
    add_fleets(document, members, solutions, [f"fleet {b}" for b in range(members[0].B)])
    return HtmlPage(page(document), "Fleets among obstacles")


def fleet_document(members: Sequence[Problem], title: str, about: str) -> Document:
    """The page of fleets in the making, with a colour for each vehicle."""
    first, names = members[0], [f"vehicle {v}" for v in range(len(members))]
    dt, look = float(first.dynamics.dt), look_of(first.dynamics)
    return Document.of(first, title=title, about=f"{about}, {first.N} stages", dt=dt, look=look, solvers=names)


def add_fleets(
    document: Document, members: Sequence[Problem], solutions: Sequence[Solution], labels: Sequence[str]
) -> None:
    """Add fleets to their page, under these names."""
    flights = []
    for name, one, found in zip(document.solvers, members, solutions, strict=True):
        rows, results, touching = _told(one, found)
        flights.append(
            flights_of(one, look_of(one.dynamics), found.X, found.U, name, results, rows, ADMITTED, touching)
        )
    for b, label in enumerate(labels):
        document.add(label, members[0], b, [each[b] for each in flights])


def _times(problem: Problem, solution: Solution) -> tuple[np.ndarray | None, float]:
    """The times of the knots (B, N+1), s, and the length of a stage; None where all stages are of this length.

    Of dynamics without a time step, stages count as 1 s.
    """
    dt = getattr(problem.dynamics, "dt", None) or 1.0
    try:
        t = solution.t
    except InputError:  # the solution doesn't know its problem, which then isn't one of free time
        try:
            t = times(problem)
        except InputError:
            return None, dt
    moments = t.detach().cpu().double().numpy()
    moments = np.broadcast_to(moments, (problem.B, problem.N + 1))
    even = np.minimum(np.arange(problem.N + 1), np.reshape(problem.stages.cpu().numpy(), (-1, 1))) * dt
    return (None, dt) if np.allclose(moments, even, rtol=0, atol=1e-9 * dt) else (moments, dt)


def _told(problem: Problem, solution: Solution) -> tuple[list[Rows], list[str], np.ndarray]:
    """What the table says of each problem, its result, and where contact is looked for."""
    try:
        frame = solution.to_frame(problem)
    except InputError:  # obstacles of a kind that can't be judged
        frame = solution.to_frame()
    rows, results = [], []
    for row in frame.to_dict("records"):
        entries: Rows = [("status", str(row["status"])), ("cost", f"{row['cost']:.6g}")]
        entries += [("clearance", f"{row['clearance']:.3f} m")] if np.isfinite(row.get("clearance", np.nan)) else []
        entries += [("violation", f"{row['violation']:.2g}"), ("iterations", str(row["iterations"]))]
        rows.append(entries)
        good = bool(row["violation"] <= ADMITTED and not row.get("clearance", 0.0) < 0)
        results.append("reached" if good and row.get("reached", False) else "feasible" if good else "failed")
    clearance = frame["clearance"].to_numpy() if "clearance" in frame else np.full(problem.B, -np.inf)
    return rows, results, ~(clearance >= 0)
