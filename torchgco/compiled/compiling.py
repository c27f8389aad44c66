"""compile: one problem, or phases, compiled and packed once, and solved again and again with other numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from torchgco.base.errors import InputError, shown
from torchgco.base.options import Positive, check_value
from torchgco.base.shapes import CPU, check_untransformed
from torchgco.compiled.compiled import Compiled
from torchgco.compiled.phases import CompiledPhases
from torchgco.constraints.link import Integral
from torchgco.phases import Phases
from torchgco.problem.problem import Problem, current_problem
from torchgco.solvers.interior import InteriorPoint

SOLVERS = "gco", "interior_point"


def compile(
    problem: Problem | Phases,
    solver: str | None = None,
    changes: Sequence[str] | None = None,
    receding: bool = False,
    tolerance: float | None = None,
) -> Any:
    """A problem whose code is traced, compiled and packed once, for solves with other numbers: a receding horizon, say.

        mpc = torchgco.compile(problem, receding=True)
        answer = mpc(x0=x, x_ref=reference)

    The first call solves as `torchgco.solve` does. Later ones begin with the last trajectories and multipliers, by the
    interior point in C; what that doesn't solve, `solver` solves again. Tensors that the problem's functions capture,
    such as the weights of a module, are read again at each call. What the functions do, Python's numbers in them, and
    which bounds are infinite stay as they are now: see `Compiled.stale`.

    Args:
        problem: B problems. Those of a GPU are solved as by `torchgco.solve`; answers lie on the CPU. Or phases on the
            CPU: an answer then has one for each, and numbers say of which phase, or jump, they are.
        solver: "gco" or "interior_point": of the first call, and of what no warm start leads to. None: "gco", of phases
            "interior_point".
        changes: names of the numbers that calls may change; others keep what the problem has. None: all that
            `Compiled.numbers` lists.
        receding: each call's horizon begins a stage after that of the call before; its warm start is shifted as far.
            Where the time is free, calls say what has `elapsed`.
        tolerance: of the optimality conditions; None: that of `InteriorPoint`.

    Raises:
        InputError: another solver, a name that isn't there, a problem of another device that can't be served from the
            CPU, `receding` in free time or of phases, rows with an `Integral`.
    """
    check_untransformed("compile")
    whole = isinstance(problem, Phases)
    problem = problem.current() if isinstance(problem, Phases) else current_problem(problem)
    if solver is not None and solver not in SOLVERS:
        raise InputError("solver", " or ".join(f'"{name}"' for name in SOLVERS), shown(solver))
    check_value(receding, bool, "receding")
    interior = InteriorPoint()
    if tolerance is not None:
        interior = replace(interior, tolerance=check_value(tolerance, Positive, "tolerance"))
    members: Any = problem.members if isinstance(problem, Phases) else [problem]
    if receding and (whole or members[0].time is not None):
        what = (
            "of phases, which PhasesMPC serves" if whole else "where the time is free: calls say what has `elapsed`, s"
        )
        raise InputError("receding", f"False {what}", True)
    if any(isinstance(part, Integral) for one in members for part in one.constraints):
        raise InputError("problem", "one without Integral in compiled problems and loops", "Integral")
    if whole and problem.x0.device.type != CPU.type:
        raise InputError("problem", "phases on the CPU", str(problem.x0.device))
    if whole:
        return CompiledPhases(problem, solver or "interior_point", changes, False, interior)
    return Compiled(problem, solver or "gco", changes, receding, interior)
