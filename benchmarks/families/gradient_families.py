"""Derivatives of the general families against differences: whether `differentiable` is right; see `gradients`.

Two directions are moved along: of the starts, random by a third of each state's range; and of all other numbers in the
problem's parts at once, random by a share of themselves. States and controls count in units of their ranges.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any

import torch
from torch import Tensor

import torchgco
from benchmarks.families.general_problems import FAMILIES, SETS
from benchmarks.lib.page import filed, markdown
from torchgco import ControlBounds, InteriorPoint, Problem, QuadraticCost, Solution, StateBounds
from torchgco.base.status import Differentiability
from torchgco.problem.problem import current_problem
from torchgco.sensitivity.attach import for_systems
from torchgco.sensitivity.points import points_of

STEPS = 1e-3, 1e-4, 1e-5, 1e-6
TIGHT = InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9, warm_barrier=1e-8)
WRONG = 1e-3  # share by which a derivative may be off where `differentiable` says True
# What plain numbers and lists stand for in the parts of the families; tensors are moved wherever they are.
PLAIN: dict[type, tuple[str, ...]] = {
    ControlBounds: ("lower", "upper"), StateBounds: ("lower", "upper"), QuadraticCost: ("Q", "R", "Qf", "x_ref"),
}  # fmt: skip
HEADS = ["family", "problems", "differentiable", "others", "median error", "largest", f"above {WRONG:.0e}"]

Moved = Callable[[str, Tensor], Tensor]


def moved(problem: Problem, by: Moved) -> Problem:
    """The problem with every number of its parts replaced, by its name and value."""
    assert problem.given is not None
    fields = dict(problem.given.fields)
    parts = "dynamics", "cost", "constraints", "x0"
    return Problem(**fields | {name: _mapped(fields[name], name, by) for name in parts})


def _mapped(part: Any, name: str, by: Moved) -> Any:
    if isinstance(part, Tensor):
        return by(name, part) if part.is_floating_point() else part
    if isinstance(part, Mapping):
        return {key: _mapped(held, f"{name}.{key}", by) for key, held in part.items()}
    if isinstance(part, tuple | list):
        return [_mapped(held, f"{name}.{place}", by) for place, held in enumerate(part)]
    if not is_dataclass(part) or isinstance(part, type):
        return part
    twin = object.__new__(type(part))
    for key, held in vars(part).items():
        held = torch.as_tensor(held, dtype=torch.float64) if key in PLAIN.get(type(part), ()) else held
        object.__setattr__(twin, key, _mapped(held, f"{name}.{key}", by))
    return twin


def directions(problem: Problem, spread: Tensor) -> dict[str, Tensor]:
    """Where every number is moved, by its name; `spread` (n,) is how far starts are."""
    found: dict[str, Tensor] = {}

    def draw(name: str, value: Tensor) -> Tensor:
        size = spread if name == "x0" else torch.where(torch.isfinite(value), value, 0.0)
        found[name] = torch.randn_like(value) * size
        if name == "x0" and problem.free_start is not None:
            found[name] = torch.where(problem.free_start, 0.0, found[name])
        weights = name.startswith("cost") and value.dim() > 1 and value.shape[-1] == value.shape[-2]
        found[name] = 0.5 * (found[name] + found[name].mT) if weights else found[name]
        return value

    moved(problem, draw)
    return found


def errors(problem: Problem) -> tuple[Solution, Tensor]:
    """The solution with gradients, and the largest error (B,) of both directions, each the best of all steps."""
    with torch.no_grad():
        plain = torchgco.solve(problem, verbose=False)
        growth = points_of(*for_systems(current_problem(problem), plain)).growth
    ranges = [part.abs().amax(dim=(0, 1)) for part in (plain.X, plain.U)]
    ranges = [torch.maximum(size, 0.01 * size.max()) for size in ranges]
    ways = directions(problem, 0.3 * ranges[0])
    aim = [torch.randn_like(part) / size for part, size in zip((plain.X, plain.U), ranges, strict=True)]

    def along(solution: Solution) -> Tensor:
        return (aim[0] * solution.X).sum((1, 2)) + (aim[1] * solution.U).sum((1, 2))

    def at(start: Tensor | float, others: Tensor | float) -> Problem:
        share = lambda name: start if name == "x0" else others
        step = lambda name, value: torch.where(torch.isfinite(value), value + share(name) * ways[name], value)
        return moved(problem, step)

    leaves = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    solution = torchgco.solve(at(*leaves), verbose=False)
    each = torch.eye(problem.B, dtype=torch.float64)
    (slopes,) = torch.autograd.grad(along(solution), leaves, each, is_grads_batched=True)
    held, worst = solution.detach(), torch.zeros_like(plain.cost)
    for way in range(2):
        best = torch.full_like(worst, torch.inf)
        for h in STEPS:
            pair = [at(*(step if way == place else 0.0 for place in range(2))) for step in (h, -h)]
            pair = [end.grown(growth) if bool((growth > 0).any()) else end for end in pair]
            ends = [TIGHT.solve(end, held.U, warm=held.multipliers, X0=held.X) for end in pair]
            change = (along(ends[0]) - along(ends[1])) / (2 * h)
            parts = zip((ends[0].X - ends[1].X, ends[0].U - ends[1].U), ranges, strict=True)
            size = sum(((part / span).flatten(1).norm(dim=1) for part, span in parts), torch.zeros_like(worst))
            mine = slopes[:, way]
            error = (change - mine).abs() / torch.maximum(mine.abs(), 0.01 * size / (2 * h)).clamp(min=1e-3)
            best = torch.fmin(best, error)
        worst = torch.maximum(worst, best)
    return solution, worst


def table(seed: int) -> str:
    """A row per family, filed, and one per set."""
    rows, sets = [], []
    for number, title in SETS.items():
        own: list[tuple[int, Tensor]] = []
        for family in (one for one in FAMILIES.values() if one.set == number):
            torch.manual_seed(seed)
            solution, worst = errors(family.problem(seed))
            told = solution.differentiable
            assert solution.reason is not None
            others = Counter(Differentiability(reason).name for reason in solution.reason[~told].tolist())
            named = ", ".join(f"{count} {name}" for name, count in others.items()) or "-"
            sure = worst[told]
            own.append((len(told), sure))
            figures = ["-", "-"] if len(sure) == 0 else [f"{sure.median():.0e}", f"{sure.max():.0e}"]
            rows.append([family.name, len(told), len(sure), named, *figures, int((sure > WRONG).sum())])
        all_of = torch.cat([sure for _, sure in own])
        counts = len(own), sum(count for count, _ in own), len(all_of)
        figures = f"{all_of.median():.0e}", f"{all_of.max():.0e}"
        sets.append([title, *counts, *figures, int((all_of > WRONG).sum())])
    heads = ["general families", "families", "problems", "differentiable", *HEADS[4:]]
    return filed("gradients-families", markdown(HEADS, rows), markdown(heads, sets))
