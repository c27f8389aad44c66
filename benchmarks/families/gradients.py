"""python -m benchmarks.families.gradients: derivatives of solutions against differences, their share, and their time.

Each number of a kind is moved along one random direction, of radii and weights by a share of themselves. The derivative
is that of a random linear function of states and controls; differences are of solves to 1e-12 from the solution, of
which the best of four steps counts. Errors are shares of the derivative, or of 1 % of the change of the states.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

import torchgco
from benchmarks.families import gradient_families
from benchmarks.families.gradient_families import STEPS, TIGHT
from benchmarks.families.gradient_peers import Found, table
from benchmarks.lib import DATA
from benchmarks.lib.command import Command
from benchmarks.lib.page import filed, markdown, share
from torchgco import (
    ControlBounds,
    FunctionDynamics,
    Goal,
    Layouts,
    Problem,
    QuadraticCost,
    QuadrotorPlanning,
    Solution,
    Spheres,
)
from torchgco.base.status import Differentiability
from torchgco.experiments.config.build import compose

D = torch.float64
RELATIVE = (
    "Q",
    "R",
    "Qf",
    "radii",
    "vehicle radius",
    "rate constant",
    "thrust constant",
    "goal radius",
)  # moved by a share of themselves

ERRORS = ("problems", "by", "median error", "largest", "below 1e-6", "below 1e-4", "of")

Numbers = Mapping[str, Tensor]


@dataclass(frozen=True)
class Set:
    """Problems as a function of all their numbers, and a guess for the solver."""

    make: Callable[[Numbers], Problem]
    numbers: dict[str, Tensor]
    U0: Tensor | None
    smoothing: float | None = None
    kinds: tuple[str, ...] | None = None  # that are moved; None: all


def flown(family: str, model: str, scenario: str, count: int, seed: int | None, required: bool = False) -> Set:
    """Layouts of a family: the public ones, or drawn with a seed; with a goal that is stated, or `required`."""
    setup = compose([f"model={model}", f"scenario={scenario}"])
    public = Layouts.load(DATA / f"{family}.npz") if seed is None else None
    task = setup.vehicle.task(setup.scenario.draw(list(range(count)), seed) if public is None else public)
    whole, B = task.problem, task.problem.B
    discs, bounds, cost = whole.constraints[0], whole.constraints[1], whole.cost
    each = lambda part, size: part.expand(B, size).clone()
    numbers = {
        "x0": whole.x0, "centres": discs.centers, "radii": discs.inflated_radii - discs.vehicle_radius.unsqueeze(-1),
        "vehicle radius": discs.vehicle_radius, "Q": each(cost.Q[:, 0], whole.n), "R": each(cost.R[:, 0], whole.m),
        "Qf": each(cost.Qf, whole.n), "x_ref": each(cost.xf_ref, whole.n), "u_ref": each(cost.u_ref[:, 0], whole.m),
        "lower bound": each(bounds.lower, whole.m), "upper bound": each(bounds.upper, whole.m),
    }  # fmt: skip
    if required:
        numbers |= {"goal": whole.goal.position, "goal radius": whole.goal.radius}
    if isinstance(whole.dynamics, QuadrotorPlanning):
        numbers |= {name: torch.full((B,), 1.5, dtype=D) for name in ("rate constant", "thrust constant")}

    def make(th: Numbers) -> Problem:
        model, full = whole.dynamics, torch.diag_embed
        if "rate constant" in th:
            model = replace(model, rate_time_constant=th["rate constant"], thrust_time_constant=th["thrust constant"])
        weights = full(th["Q"]).unsqueeze(1), full(th["R"]).unsqueeze(1), full(th["Qf"])
        cost = QuadraticCost(*weights, x_ref=th["x_ref"].unsqueeze(1), u_ref=th["u_ref"].unsqueeze(1))
        around = Spheres(th["centres"], th["radii"], th["vehicle radius"])
        limits = ControlBounds(th["lower bound"], th["upper bound"])
        goal = Goal(th["goal"], th["goal radius"], required=True) if required else whole.goal
        return Problem(model, cost, [around, limits], th["x0"], whole.N, goal)

    return Set(make, {name: part.clone() for name, part in numbers.items()}, task.U0)


def bounded_lq(B: int = 128, N: int = 20, n: int = 8, m: int = 4) -> Set:
    """Linear-quadratic problems with bounded controls, half of which hold."""
    torch.manual_seed(0)
    A, M = torch.eye(n) + 0.2 * torch.randn(n, n) / n**0.5, 0.3 * torch.randn(n, m)
    numbers = {
        "x0": 2 * torch.randn(B, n), "A": A.repeat(B, 1, 1), "B": M.repeat(B, 1, 1), "b": 0.05 * torch.randn(B, n),
        "Q": torch.ones(B, n), "R": 0.1 * torch.ones(B, m), "upper bound": torch.ones(B, m),
    }  # fmt: skip

    def make(th: Numbers) -> Problem:
        step = lambda x, u, A, B, b: (A * x.unsqueeze(-2)).sum(-1) + (B * u.unsqueeze(-2)).sum(-1) + b
        model = FunctionDynamics(step, n, m, 0.1, "none", values={name: th[name] for name in ("A", "B", "b")})
        Q, R = torch.diag_embed(th["Q"]), torch.diag_embed(th["R"])
        bounds = [ControlBounds(-th["upper bound"], th["upper bound"])]
        return Problem(model, QuadraticCost(Q.unsqueeze(1), R.unsqueeze(1), Q), bounds, th["x0"], N)

    return Set(make, {name: part.to(D) for name, part in numbers.items()}, None)


@dataclass(frozen=True)
class Measured:
    """Of one set: the solution with its leaves, and processor seconds."""

    solution: Solution
    leaves: dict[str, Tensor]
    forward: float  # without gradients
    recorded: float  # more with them
    backward: float


def measured(of: Set, aim: tuple[Tensor, Tensor]) -> Measured:
    """Solve without and with gradients, each twice, of which the second counts; and one backward pass."""
    leaves = {name: part.clone().requires_grad_() for name, part in of.numbers.items()}
    times = []
    for gradients in (False, False, True, True):
        problem = of.make(leaves)
        began = time.process_time()
        with torch.set_grad_enabled(gradients):
            solution = torchgco.solve(problem, of.U0, smoothing=of.smoothing, verbose=False)
        times.append(time.process_time() - began)
    total, values = along(solution, aim).sum(), list(leaves.values())
    began = time.process_time()
    torch.autograd.grad(total, values, retain_graph=True)
    return Measured(solution, leaves, times[1], times[3] - times[1], time.process_time() - began)


def along(solution: Solution, aim: tuple[Tensor, Tensor]) -> Tensor:
    """A linear function of states and controls, (B,)."""
    return (aim[0] * solution.X).sum((1, 2)) + (aim[1] * solution.U).sum((1, 2))


def errors(of: Set, found: Measured, aim: tuple[Tensor, Tensor], name: str) -> Tensor:
    """The errors (B,) of derivatives by the numbers `name`, the best of all steps."""
    numbers, start = of.numbers[name], found.solution.detach()
    direction = torch.nan_to_num(torch.randn_like(numbers)) * (numbers.nan_to_num() if name in RELATIVE else 1.0)
    (slope,) = torch.autograd.grad(along(found.solution, aim).sum(), found.leaves[name], retain_graph=True)
    mine, best = (slope * direction).flatten(1).sum(-1) if slope.dim() > 1 else slope * direction, None
    for h in STEPS:
        ends = []
        for sign in (1, -1):
            problem = of.make({**of.numbers, name: numbers + sign * h * direction})
            if of.smoothing is None:
                ends.append(TIGHT.solve(problem, start.U, warm=start.multipliers, X0=start.X))
            else:
                ends.append(torchgco.solve(problem, solver=TIGHT, warm=start, smoothing=of.smoothing, verbose=False))
        change = (along(ends[0], aim) - along(ends[1], aim)) / (2 * h)
        size = ((ends[0].X - ends[1].X) / (2 * h)).flatten(1).norm(dim=1)
        error = (change - mine).abs() / torch.maximum(mine.abs(), 0.01 * size).clamp(min=1e-3)
        best = error if best is None else torch.fmin(best, error)
    assert best is not None
    return best


def unit(*shape: int) -> Tensor:
    """Random directions, one for each problem, of length 1."""
    drawn = torch.randn(*shape, dtype=D)
    return drawn / drawn.flatten(1).norm(dim=1).view(-1, 1, 1)


def differentiated(th: Numbers, aim: Tensor) -> Found:
    """Gradients of controls by starts and offsets of the bounded problems, and seconds."""
    leaves = {name: part.clone().requires_grad_() for name, part in th.items()}
    problem = bounded_lq(len(th["x0"])).make(leaves)
    began = time.process_time()
    U = torchgco.solve(problem, verbose=False).U
    forward, middle = time.process_time() - began, time.process_time()
    slopes = torch.autograd.grad((aim * U).sum(), [leaves["x0"], leaves["b"]])
    return slopes, forward, time.process_time() - middle


def text(count: int, seed: int) -> str:
    """The tables."""
    forest, lq = flown("forest30", "quadrotor", "forest", count, seed), bounded_lq()
    trap = flown("planar_trap", "planar", "planar_trap", 32, None)
    required = flown("forest30", "quadrotor", "forest", count, seed, True)
    few, cost = ("x0", "centres", "Q", "upper bound"), 12_500.0  # its median
    soft = {
        f"forest30, smoothing {mu:.0e} of the cost": replace(forest, smoothing=mu * cost, kinds=few)
        for mu in (1e-8, 1e-6)
    }
    sets = {
        f"forest30, {count} drawn": forest,
        "the same, the goal required": replace(required, kinds=("goal", "goal radius", "x0", "centres", "Q")),
        "planar_trap, public": trap,
        "bounded LQ, (N, n, m) = (20, 8, 4)": lq,
        **soft,
    }
    shares, kinds, costs = [], [], []
    for title, of in sets.items():
        torch.manual_seed(1)
        problem = of.make(of.numbers)
        aim = unit(problem.B, problem.N + 1, problem.n), unit(problem.B, problem.N, problem.m)
        found = measured(of, aim)
        told, B = found.solution.differentiable, problem.B
        others = Counter(Differentiability(reason).name for reason in found.solution.reason[~told].tolist())
        shares.append([title, share(int(told.sum()), B), ", ".join(f"{n} {name}" for name, n in others.items()) or "-"])
        f, r, b = found.forward, found.recorded, found.backward
        costs.append(
            [title, f"{1e3 * f:.0f}", f"{1e3 * r:.0f}", f"{1e3 * b:.0f}", f"{b / f:.1%}", f"{(r + b) / f:.1%}"]
        )
        for name in of.kinds or of.numbers:
            one = errors(of, found, aim, name)[told]
            below = [int((one < limit).sum()) for limit in (1e-6, 1e-4)]
            kinds.append([title, name, f"{one.median():.0e}", f"{one.max():.0e}", *below, len(one)])
    return "\n\n".join([
        markdown(["problems", "differentiable", "others"], shares),
        filed("gradients", markdown(ERRORS, kinds), summary(kinds)),
        gradient_families.table(seed),
        markdown(["problems", "solve, ms", "more, ms", "backward, ms", "backward / solve", "all / solve"], costs),
        table(differentiated, lq.numbers, 20, 4),
    ])  # fmt: skip


def summary(kinds: Sequence[Sequence[Any]]) -> str:
    """The worst of all numbers of a kind of problems, and how many derivatives they have."""
    rows = []
    for title in dict.fromkeys(row[0] for row in kinds):
        own = [row for row in kinds if row[0] == title]
        median, largest = (max((row[place] for row in own), key=float) for place in (2, 3))
        rows.append([title, f"{sum(int(row[6]) for row in own):,}", median, largest])
    return markdown(["problems", "derivatives", "largest median error", "largest error"], rows)


main = Command(
    __doc__, "gradients", text, "{count} drawn layouts, seed {seed}",
    count=(256, "layouts of forest30"), seed=(7, "of the layouts"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
