"""The table of a solver: which rows it takes, that every field of every row is read, and how it shows them."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.problems import planar_batch
from tests.search.gates import LOCAL, PASSES, PATHS, SAMPLING, SHORT, gates
from tests.search.rows import closer, restarts, thorough, varied
from tests.search.test_chords import corners
from tests.search.test_finish import brachistochrone, parking
from tests.slow import mostly
from torchgco import (
    AugmentedLagrangian,
    Field,
    InputError,
    PathProposals,
    Problem,
    Restarts,
    Solution,
    Spheres,
    presets,
)
from torchgco.maps import OccupancyGrid
from torchgco.roadmap.roadmap import Roadmap
from torchgco.search import (
    ClearChords,
    Converge,
    Direct,
    FirstSolve,
    Follow,
    FromProposal,
    FromSamples,
    IntoGoal,
    Join,
    Paths,
    Refine,
    Row,
    Samples,
    Solve,
    Starts,
    Tighten,
    Tube,
)
from torchgco.search.restarts import TABLE_COLUMNS
from torchgco.solvers.interior import InteriorPoint

pytestmark = pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
KINDS = (
    Solve, PathProposals, FromProposal, IntoGoal, FromSamples, Converge, ClearChords, Starts, Tube, Direct, Join,
    FirstSolve, Paths, Samples, Tighten,
)  # fmt: skip
DRAWN = FromSamples("caught", redraws=1)
COSTLY = replace(PATHS, when="costly", num_paths=2, refine=Refine(top=2, needed=True), max_gap=1e-3)


def at_gates(*passes: Row, weight: float = 6.0) -> Solution:
    """Four problems that need different attempts, by a table; samples are those of the local solver's guidance."""
    return Restarts(replace(LOCAL, guidance=SAMPLING), passes).solve(*gates(weight), seed=3)


def among_moving(*passes: Row) -> Solution:
    """Problems among moving obstacles, where no path can be sought."""
    problem, U0 = planar_batch(B=4, N=40, obstacles=8, seed=4)
    moving = Spheres([[0.1, 0.1], [0.1, 0.3]], [0.2, 0.2], 0.06, velocities=torch.zeros(2, 2, dtype=torch.float64))
    problem = replace(problem, constraints=[moving, problem.constraints[1]])
    return Restarts(replace(LOCAL, guidance=SAMPLING), passes).solve(problem, U0, seed=3)


def around_one(*passes: Row) -> Solution:
    """A sphere that a trajectory touches alone."""
    problem, U0 = planar_batch(B=1, N=60, obstacles=1, seed=1)
    problem = replace(problem, constraints=[Spheres([[[0.0, 0.2]]], [[0.2]], 0.1), problem.constraints[1]])
    return Restarts(replace(LOCAL, guidance=SAMPLING), passes).solve(problem, U0)


def unfinished(*passes: Row, problem: Problem | None = None, limit: int = 20) -> Solution:
    """The fastest slide to a point, which the local solver's limits cut off; or another problem."""
    problem = brachistochrone() if problem is None else problem
    local = replace(presets.gco(problem).local, guidance=None, max_outer_iterations=limit)
    return Restarts(local, passes).solve(problem, problem.x0.new_zeros(problem.B, problem.N, problem.m))


def parked(*passes: Row) -> Solution:
    """A car at rest that should stand next to its place, where only other controls help."""
    return unfinished(*passes, problem=parking())


def parked_once(*passes: Row) -> Solution:
    """The same, with one outer iteration."""
    return unfinished(*passes, problem=parking(), limit=1)


def around_corners(*passes: Row) -> Solution:
    """Boxes whose corners are cut between two knots."""
    problem = corners()
    local = presets.gco(problem).local
    return Restarts(local, passes).solve(problem, problem.x0.new_zeros(problem.B, problem.N, problem.m))


AGAIN, FIRST = Starts(2, "all"), (Converge("free"), Solve())
ALONG = (Solve(), PATHS, FromProposal())


@dataclass(frozen=True)
class Case:
    """A field of a row, problems on which it matters, another value for it, and the rows around it in the table."""

    field: str
    solved: Callable[..., Solution]
    row: Row
    value: Any
    before: tuple[Row, ...] = ()
    after: tuple[Row, ...] = ()

    def __str__(self) -> str:
        return f"{type(self.row).__name__}.{self.field}"


HELD = (Solve(),)
ALONE = (Solve(single_contact_after=1),)
CASES = [
    Case("until", at_gates, Solve(), "end", after=(DRAWN,)),
    Case("among", at_gates, Solve(), "pathless", before=(Solve("end"),), after=(DRAWN,)),
    Case("single_contact_after", around_one, Solve(), 1, after=(DRAWN,)),
    Case("when", at_gates, PATHS, "far", before=ALONG, after=(FromProposal(),)),
    Case("max_gap", at_gates, COSTLY, 1e9, before=(Solve(), PATHS), after=(FromProposal(),)),
    Case("when", at_gates, FromSamples("unproposed", redraws=1), "caught", before=ALONG),
    Case("among", at_gates, IntoGoal(), "pathless", before=ALONG),
    Case("redraws", at_gates, DRAWN, 2, before=HELD),
    Case("count", parked, AGAIN, 3, before=FIRST),
    Case("when", unfinished, AGAIN, "unsolved", before=FIRST),
    Case("bend", unfinished, AGAIN, 0.3, before=FIRST),
    Case("change", parked, AGAIN, 0.2, before=FIRST),
    Case("among", unfinished, Converge(), "free", before=HELD),
    Case("gap", around_one, Direct(), 1e9, before=ALONE, after=(DRAWN,)),
    Case("most", around_one, Direct(), 0, before=ALONE, after=(DRAWN, Join())),
    Case("among", at_gates, Tube(num_paths=2), "maps", before=HELD),
    Case("num_paths", at_gates, Tube(num_paths=1), 3, before=HELD),
    Case("single_contact_after", around_one, FirstSolve(), 1, after=(DRAWN,)),
    Case("redraws", at_gates, Samples(1), 2, before=HELD),
    Case("starts", parked_once, Tighten(1), 3, before=FIRST),
    Case("rounds", around_corners, ClearChords(), 1, before=(Solve("end"),)),
]


# Another value of every field of `Paths`, and what it changes among the fields of its steps.
PATHS_FIELDS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "num_paths": (9, ("num_paths", "relax_top", "refine")), "roadmap": (Roadmap(num_halton=99), ("roadmaps",)),
    "follow": (Follow(iterations=3), ("follow",)), "relax_iterations": (7, ("relax_iterations",)),
    "relax_top": (2, ("relax_top",)), "refined": (5, ("refine",)),
    "max_penetration": (0.3, ("max_penetration",)), "max_gap": (0.4, ("max_gap",)),
}  # fmt: skip


@pytest.mark.parametrize("name", PATHS_FIELDS)
def test_every_option_of_paths_is_handed_on(name: str) -> None:
    row = Paths(max_gap=0.2)
    value, changes = PATHS_FIELDS[name]
    other = replace(row, **{name: value})
    both = (pair for pair in zip(row.steps, other.steps, strict=False) if type(pair[0]) is type(pair[1]))
    pairs = [pair for pair in both if pair[0] != pair[1]]
    assert pairs
    for old, new in pairs:
        differs = {field.name for field in fields(old) if getattr(old, field.name) != getattr(new, field.name)}
        assert isinstance(old, PathProposals) and differs <= set(changes)
    assert set(PATHS_FIELDS) == {field.name for field in fields(Paths)}


def test_the_steps_of_paths_follow_from_its_options() -> None:
    first, more, again, attempt, into, far, last = Paths(max_gap=0.2).steps
    assert (first.when, more.when, again.when, far.when) == ("unarrived", "costly", "unproposed", "far")
    assert far.num_paths == far.refine.top == 12 and far.follow[0].iterations == 3 * first.follow[0].iterations
    assert last == attempt
    assert more.num_paths == 2 * first.num_paths and [r.num_halton for r in more.roadmaps] == [64, 128]
    assert again.roadmaps == () and [way.obstacles == 0 for way in again.follow] == [False, True]
    assert (attempt, into) == (FromProposal(), IntoGoal())
    assert [type(step) for step in Paths(refined=4).steps] == [PathProposals, FromProposal, IntoGoal]
    assert Paths(refined=4).steps[0].refine == Refine(top=4) != Paths().steps[0].refine


def differ(one: Solution, other: Solution) -> bool:
    return not (torch.equal(one.U, other.U) and torch.equal(one.iterations, other.iterations))


@pytest.mark.slow
def test_rows_solve_by_the_interior_point_of_their_table() -> None:
    problem = brachistochrone()
    solver = Restarts(replace(presets.gco(problem).local, guidance=None), (Converge("free"), Solve(), Starts(2, "all")))
    U0 = problem.x0.new_zeros(1, problem.N, problem.m)
    other = replace(solver, interior=InteriorPoint(tolerance=1e-2))
    assert differ(solver.solve(problem, U0), other.solve(problem, U0))


@pytest.mark.sampled(7)
@pytest.mark.parametrize("case", mostly(CASES, CASES[-1]), ids=str)
def test_every_field_is_read(case: Case) -> None:
    assert getattr(case.row, case.field) != case.value
    other = replace(case.row, **{case.field: case.value})  # type: ignore[type-var]
    assert differ(*(case.solved(*case.before, row, *case.after) for row in (case.row, other)))


def test_a_first_solve_runs_to_its_end_where_no_path_can_be_sought_alone() -> None:
    """Rows for that case change nothing where paths can be sought."""
    first = Solve("end", "pathless")
    assert not differ(at_gates(first, Solve(), DRAWN), at_gates(Solve(), DRAWN))
    assert differ(among_moving(first, Solve(), DRAWN), among_moving(Solve(), DRAWN))


def test_no_field_is_forgotten_above() -> None:
    """Those of paths and how they are followed are read in test_paths."""
    there = {field.name for field in fields(PathProposals)} - {"when", "max_gap"}
    every = {(kind, field.name) for kind in KINDS for field in fields(kind)}
    handed_on = {(Paths, field.name) for field in fields(Paths)}  # to its steps; see below
    assert {(type(case.row), case.field) for case in CASES} == every - {
        (PathProposals, name) for name in there
    } - handed_on


@pytest.mark.parametrize(
    ("passes", "field", "expected"),
    [
        ((), "solver.passes", "a Solve first"), ((PATHS,), "solver.passes", "a Solve first"),
        ((Solve("end", "pathless"),), "solver.passes", "a Solve first"),
        ((Solve("end", "pathless"), PATHS, Solve()), "solver.passes", "a Solve first"),
        ((Solve(), 5), "solver.passes[1]", "a pass"), ((Solve,), "solver.passes[0]", "a pass"),
        ((Solve(), AugmentedLagrangian()), "solver.passes[1]", "a pass"), (Solve(), "solver.passes", "a list"),
        (None, "solver.passes", "a list"), ("all", "solver.passes", "a list"),
        ((Solve(), closer(PATHS)), "solver.passes[1].when", "path proposals before"),
        ((*ALONG, IntoGoal(), COSTLY), "solver.passes[4].when", "path proposals before"),
    ],
)  # fmt: skip
def test_a_table_that_cannot_work_is_refused(passes: Any, field: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        Restarts(passes=passes)
    assert caught.value.field == field and len(str(caught.value).splitlines()) == 1
    assert f"expected {expected}" in str(caught.value)


def test_a_list_of_rows_is_a_table() -> None:
    rows = [Solve("end", "pathless"), Solve(), ClearChords()]
    assert Restarts(passes=rows) == Restarts(passes=tuple(rows)) and hash(Restarts(passes=rows))


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: Solve(until="late"), "solve.until"), (lambda: Solve(among="far"), "solve.among"),
        (lambda: Solve(single_contact_after=1.5), "solve.single_contact_after"),
        (lambda: FromSamples(when="far"), "samples.when"), (lambda: FromSamples(redraws=-1), "samples.redraws"),
        (lambda: IntoGoal("free"), "into_goal.among"),
        (lambda: Tube(among="all"), "tube.among"), (lambda: Tube(num_paths=0), "tube.num_paths"),
        (lambda: Direct(gap=-1.0), "direct.gap"), (lambda: FirstSolve(0), "guess.single_contact_after"),
        (lambda: Paths(refined=0), "paths.refined"), (lambda: Samples(-1), "samples.redraws"),
        (lambda: Tighten(-1), "tighten.starts"), (lambda: Converge("first"), "converge.among"),
        (lambda: ClearChords(rounds=0), "chords.rounds"), (lambda: Starts(count=0), "starts.count"),
        (lambda: Starts(when="solved"), "starts.when"), (lambda: Starts(bend=0.0), "starts.bend"),
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(make: Any, field: str) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert caught.value.field == field


@pytest.mark.parametrize("name", ["gco", "gco_fast", "gco_max"])
@pytest.mark.parametrize("space", [2, 3])
def test_the_table_shows_every_pass(name: str, space: int) -> None:
    solver = presets.PRESETS[name](space)
    assert isinstance(solver, Restarts)
    table = solver.table()
    assert table["pass"].tolist() == [type(one).__name__ for one in solver.passes]
    assert table["name"].tolist() == list(solver.passes.names)
    assert table.columns.tolist() == list(TABLE_COLUMNS) and table.index.tolist() == [*range(1, len(solver.passes) + 1)]
    assert all(isinstance(text, str) for text in table.to_numpy().flatten())
    assert table["problems"].ne("").all()
    rows = [one for one in solver.passes if isinstance(one, PathProposals)]
    shown = table[table["pass"] == "PathProposals"]
    for row, text in zip(rows, shown["what it does"], strict=True):
        assert all(f"{follow.iterations} iterations" in text for follow in row.follow)
        assert text.startswith("the same paths") == (not row.roadmaps)


def test_rows_that_differ_are_shown_differently() -> None:
    """Of every field of a row that says what it does, at least with a value far from the present one."""
    follow = PATHS.follow[0]
    rows = [
        Solve(), Solve("end"), Solve(among="pathless"), Solve(single_contact_after=4), PATHS,
        replace(PATHS, when="far"), replace(PATHS, num_paths=7), replace(PATHS, relax_top=2),
        replace(PATHS, relax_iterations=0), replace(PATHS, refine=Refine(top=5)), replace(PATHS, max_penetration=0.2),
        replace(PATHS, roadmaps=(*PATHS.roadmaps, *PATHS.roadmaps)), COSTLY, replace(COSTLY, max_gap=0.4),
        closer(PATHS), thorough(PATHS), replace(PATHS, follow=(follow, follow)),
        varied(PATHS, tube=None), varied(PATHS, arrive=(0.9, 0.8)), varied(PATHS, smoothing=0.3),
        varied(PATHS, stiffness=(7.0,)),
        FromSamples(), FromSamples(redraws=2), FromSamples("caught"), ClearChords(), ClearChords(9),
        FromProposal(), IntoGoal(), IntoGoal("pathless"),
        Starts(), Starts(4), Starts(when="all"), Starts(bend=0.1), Starts(change=0.3),
        Tube(), Tube("maps"), Tube(num_paths=2), Direct(), Direct(0.5), Direct(most=2), Join(), FirstSolve(),
        FirstSolve(9), Paths(), Paths(num_paths=9), Paths(refined=4), Paths(max_gap=0.3), Paths(relax_top=2),
        Samples(), Samples(7), Tighten(), Tighten(0), Converge(), Converge("free"),
    ]  # fmt: skip
    table = Restarts(passes=(Solve(), PATHS, *rows)).table().iloc[2:]
    assert len(table) == len(rows) and not table.duplicated().any()


@pytest.mark.parametrize("attempts", [1, 3])
def test_rows_run_in_their_order_and_only_where_they_apply(attempts: int, monkeypatch) -> None:
    """PASSES arrives along a path; SHORT is attracted to the goal; no row is left out or made twice."""
    made = []
    for kind in KINDS:
        run = kind.run
        monkeypatch.setattr(kind, "run", lambda self, search, run=run: made.append(self) or run(self, search))
    solver = restarts(LOCAL, PATHS, SAMPLING, attempts=attempts)
    solution = solver.solve(*gates(), seed=3)
    assert made == list(solver.passes)
    assert solution.guided[[PASSES, SHORT]].tolist() == [1, 1]


def test_a_problem_has_the_rows_of_its_kind() -> None:
    bodies = planar_batch(B=1, N=10)[0]
    moving = Spheres([[0.1, 0.1]], [0.2], 0.06, velocities=torch.zeros(1, 2, dtype=torch.float64))
    bounds = bodies.constraints[1]
    field = Field(OccupancyGrid(np.zeros((20, 20), bool), [-1.0, -1.0], 0.1), 0.05)
    kinds = {"bodies": bodies.constraints, "moving": [moving, bounds], "free": [bounds], "maps": [field, bounds]}
    rows = {
        "free": ["guess", "tighten"], "moving": ["guess", "timed", "samples", "clear", "tighten"],
        "maps": ["guess", "maps", "paths", "samples", "clear", "tighten"],
        "bodies": ["guess", "paths", "tube", "samples", "clear", "tighten"],
    }  # fmt: skip
    for kind, constraints in kinds.items():
        problem = replace(bodies, constraints=constraints)
        assert presets.gco(problem).table(problem)["name"].tolist() == rows[kind]


@pytest.mark.parametrize("name", ["gco", "gco_fast", "gco_max"])
def test_a_table_is_a_mapping_of_its_rows_and_prints_whole(name: str) -> None:
    solver = presets.PRESETS[name](3)
    assert isinstance(solver, Restarts)
    rows = {**solver.passes}
    assert list(rows) == list(solver.passes.names) and tuple(rows.values()) == tuple(solver.passes)
    first, last = next(iter(rows)), rows.popitem()[0]
    assert replace(solver, passes=rows).passes == solver.passes.changed(**{last: None})
    assert replace(solver, passes={**solver.passes, first: rows[first]}) == solver
    table = solver.table()
    for text in table.to_numpy().flatten():
        assert " ".join(text.split()) in " ".join(repr(table).split()) and html.escape(text) in table._repr_html_()
