"""The passes of a solver as a table that a person can read: `Restarts.table`."""

from __future__ import annotations

from collections.abc import Sequence

from torchgco.search.chords import ClearChords
from torchgco.search.converge import Converge
from torchgco.search.finish import Finish
from torchgco.search.following import Follow
from torchgco.search.passes import FromProposal, FromSamples, IntoGoal, Pass, Solve
from torchgco.search.proposals import PathProposals
from torchgco.search.starts import Starts

COLUMNS = ("pass", "problems", "paths", "how they are followed", "relaxed", "refined", "accepted")
PROBLEMS = {
    "pathless": "all, where no path can be sought",
    "caught": "caught",
    "unarrived": "caught, not arrived",
    "far": "caught, not even close to the goal",
    "unproposed": "caught, without a proposal",
}

CONVERGED = {
    "first": "all, where there are no obstacles",
    "mapped": "in maps, where a limit has ended the solve",
    "last": "not solved as tightly yet",
}


def rows_of(passes: Sequence[Pass]) -> list[dict[str, str]]:
    """A row per pass, with the columns `COLUMNS`; empty where one says nothing.

    A trajectory is accepted where it is better than the best before: arrived before feasible before cheap.
    """
    return [dict.fromkeys(COLUMNS, "") | {"pass": type(one).__name__} | _described(one) for one in passes]


def _described(one: Pass) -> dict[str, str]:
    match one:
        case Solve():
            unsolved = "all, or those that have not arrived" if one.when == "unarrived" else PROBLEMS[one.when]
            after = one.single_contact_after
            single = "" if after is None else f", or inside one after {after} outer iterations"
            stop = f"until a knot lies inside two obstacles{single}" if one.until == "caught" else "to the end"
            return {"problems": unsolved, "accepted": stop}
        case PathProposals():
            return _proposals(one)
        case FromProposal():
            return {"problems": "with a proposal"}
        case IntoGoal():
            return {"problems": "caught, close to the goal, not arrived"}
        case FromSamples():
            draws = "continued once" if one.redraws == 0 else f"{one.redraws} times, other draws"
            return {"problems": f"{PROBLEMS[one.when]}: {draws}"}
        case Converge():
            problems = CONVERGED[one.when]
            tight = f"violation {one.solver.violation_tolerance:g}, optimality {one.solver.tolerance:g}"
            return {"problems": f"{problems}: interior point", "accepted": tight}
        case Finish():
            inner, outer = one.solver.inner.max_iterations, one.solver.max_outer_iterations
            limits = f"{outer} x {inner} iterations"
            return {"problems": f"cut off by a limit, or stalled: {limits}"}
        case Starts():
            problems = "all" if one.when == "all" else "unsolved at first"
            spread = f"bent by {one.bend:g}, controls by {one.change:g}"
            return {"problems": f"{problems}, without obstacles: {one.count} starts, {spread}: interior point"}
        case ClearChords():
            return {
                "problems": f"touching an obstacle between two knots: {one.rounds} rounds",
                "accepted": "more clearance between knots",
            }


def _proposals(one: PathProposals) -> dict[str, str]:
    if one.when == "costly" and one.max_gap is None:
        return {"problems": "none"}
    gap = "" if one.max_gap is None else f"proposal over {one.max_gap:.0%} dearer than without obstacles"
    points = " and ".join(str(roadmap.num_halton) for roadmap in one.roadmaps)
    at_least = " as refined" if one.refine.needed else ""
    relax = "all" if one.relax_top is None else f"best {one.relax_top}"
    return {
        "problems": gap if one.when == "costly" else PROBLEMS[one.when],
        "paths": f"{one.num_paths} over {points} points" if one.roadmaps else "the same",
        "how they are followed": "; then ".join(map(_follow, one.follow)),
        "relaxed": f"{relax}, {one.relax_iterations} iterations" if one.relax_iterations else "none",
        "refined": f"best {one.refine.top}, {one.refine.rounds} rounds" if one.refine.top > 1 else "none",
        "accepted": f"depth up to {one.max_penetration:g} R{at_least}",
    }


def _follow(follow: Follow) -> str:
    guide = "spring" if follow.tube is None else "tube"
    stiffness = ", ".join(f"{value:g}" for value in follow.stiffness)
    starts, paces = 1 + len(follow.initial_offsets), len(follow.paces)
    several = f", {starts * paces} candidates" if starts * paces > 1 else ""
    bare = ", without obstacles" if follow.obstacles == 0 else ""
    return f"{guide} {stiffness}, {follow.iterations} iterations, corners over {follow.smoothing:g} N{several}{bare}"
