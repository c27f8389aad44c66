"""A problem in a few lines, for consoles and notebooks."""

from __future__ import annotations

from typing import Any


def summary(problem: Any) -> str:
    """Sizes, parts, goal and free time of a bound problem."""
    sizes = f"B={problem.B}, N={problem.N}, n={problem.n}, m={problem.m}"
    lines = [f"Problem({sizes}, {str(problem.x0.dtype).removeprefix('torch.')}"]
    parts = {"dynamics": problem.dynamics, "cost": problem.cost, "constraints": list(problem.constraints)}
    lines += [f"  {name}={part!r}" for name, part in parts.items()]
    if (goal := problem.goal) is not None:
        places = goal.position.unique(dim=0)
        where = [round(x, 4) for x in places[0].tolist()] if len(places) == 1 else f"{len(places)} places"
        radii = sorted({f"{float(radius):.4g}" for radius in (goal.radius.min(), goal.radius.max())})
        kind = "" if not goal.required else ", a state required" if goal.state is not None else ", required"
        lines.append(f"  goal={where}, radius {' to '.join(radii)} m{kind}")
    if problem.time is not None:
        lines.append(f"  time={problem.time!r}")
    return "\n".join(lines) + ")"
