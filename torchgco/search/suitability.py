"""Whether paths can be sought for a problem, checked before anything is solved."""

from __future__ import annotations

from collections.abc import Sequence

from torchgco.base.shapes import repeated
from torchgco.guidance.suitability import check_form, failure
from torchgco.kernels import kernels_of
from torchgco.lagrangian.expansion import linearise
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers
from torchgco.problem.problem import Problem
from torchgco.roadmap.scene import has_paths
from torchgco.search.table import Row


def suited_paths(passes: Sequence[Row], problem: Problem) -> tuple[Sequence[Row | None], str | None]:
    """The passes, with None for proposals along paths that can't serve; and a sentence on what is lost, or None.

    Obstacles that the roadmap doesn't know by design, such as moving ones, are no loss. Initial offsets for another
    number of controls are left out.
    """
    others = [None if one.seeks_paths else one for one in passes]
    if None not in others:
        return others, None
    position, bodies = problem.dynamics.position, bool(problem.obstacles)
    if position is None:
        return others, "the dynamics have no position"
    d = position.stop - position.start
    if d not in (2, 3) and bodies:
        return others, f"no path is sought around obstacles in {d}-D, as the roadmap knows only 2-D and 3-D"
    if problem.goal is None and bodies:
        return others, "no path is sought around obstacles without a goal: Problem(..., goal=Goal(position, radius))"
    if not has_paths(problem):
        return others, None
    why = None if kernels_of(problem).compiled else failure(_expand, problem, problem.x0.dtype)
    if why is not None:
        return others, f"no path can be followed ({why})"
    return [one.fitting(problem.m) for one in passes], None


def _expand(problem: Problem) -> None:
    """Evaluate the parts of an iLQR iteration, for one problem that stays at its start."""
    X = repeated(problem.x0, problem.N + 1)
    U = X.new_zeros(1, problem.N, problem.m)
    check_form("dynamics", problem.along.step(X[:, :-1], U), X[:, :-1])
    lagrangian = Lagrangian(problem, Multipliers.zero(problem, 1.0), None, True)
    check_form("cost", lagrangian.value(X, U)[1], X[:, 0, 0])
    linearise(problem, X, U)
    lagrangian.expand(X, U)
