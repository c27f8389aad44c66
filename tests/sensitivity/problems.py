"""Problems made of named tensors, and their derivatives by differences: what tests of gradients share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

import torch
from torch import Tensor

import torchgco
from torchgco import (
    Boxes,
    ControlBounds,
    FunctionConstraint,
    FunctionCost,
    FunctionDynamics,
    Goal,
    InteriorPoint,
    Problem,
    QuadraticCost,
    Solution,
    Spheres,
    StateBounds,
)

D = torch.float64
B, N = 3, 24
TIGHT = InteriorPoint(tolerance=1e-12, violation_tolerance=1e-9, warm_barrier=1e-8)
STEPS = 5e-4, 5e-5  # of differences; the best of them counts: each kind of number has its own noise

Named = Mapping[str, Tensor]


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=D)


def boat(x: Tensor, u: Tensor, drag: Tensor, net: Callable[[Tensor], Tensor]) -> Tensor:
    """A boat's position and velocity under thrust, with a small net for what else acts on it."""
    v = x[..., 2:]
    speed = (v.square().sum(-1, keepdim=True) + 0.01).sqrt()
    return torch.cat((v, u - drag.unsqueeze(-1) * speed * v), -1) + 0.1 * net(torch.cat((x, u), -1))


def numbers() -> dict[str, Tensor]:
    """Everything that `discs` is made of, by name."""
    torch.manual_seed(0)
    random = lambda *shape: torch.rand(*shape, dtype=D) * 2 - 1
    return {
        "x0": 0.1 * random(B, 4), "centers": torch.tensor([[1.5, 0.2], [2.6, -0.6]], dtype=D) + 0.1 * random(B, 2, 2),
        "radii": torch.full((B, 2), 0.4, dtype=D), "vehicle": torch.full((B,), 0.1, dtype=D),
        "velocities": 0.05 * random(B, 2, 2), "Q": vector(1, 1, 0.1, 0.1), "R": torch.diag(vector(0.1, 0.1)),
        "Qf": torch.diag(vector(10, 10, 1, 1)), "x_ref": vector(3.5, 0, 0, 0).repeat(B, 1, 1),
        "u_ref": torch.zeros(2, dtype=D), "q": torch.zeros(4, dtype=D), "r": torch.zeros(2, dtype=D),
        "qf": torch.zeros(4, dtype=D),
        "lower": torch.full((B, 2), -50.0, dtype=D), "upper": torch.full((B, 2), 3.0, dtype=D),
        "fastest": vector(torch.inf, torch.inf, 1.9, torch.inf), "drag": torch.full((B,), 0.2, dtype=D),
        "first": random(5, 6), "bias": random(5), "second": random(4, 5), "budget": vector(9.0),
    }  # fmt: skip


KINDS = tuple(numbers())


def discs(th: Named) -> Problem:
    """A boat among moving discs, with a quadratic cost, bounds, and a row and a model of a user."""
    net = lambda z: torch.tanh(z @ th["first"].mT + th["bias"]) @ th["second"].mT
    model = FunctionDynamics(
        lambda x, u, drag: boat(x, u, drag, net), 4, 2, 0.15, "rk4", slice(0, 2), values={"drag": th["drag"]}
    )
    cost = QuadraticCost(**{name: th[name] for name in ("Q", "R", "Qf", "x_ref", "u_ref", "q", "r", "qf")})
    budget = FunctionConstraint(lambda x, u: u.square().sum(-1, keepdim=True) - th["budget"], knots=range(3), of="xu")
    constraints = [
        Spheres(th["centers"], th["radii"], th["vehicle"], th["velocities"]), ControlBounds(th["lower"], th["upper"]),
        StateBounds(-torch.inf, th["fastest"]), budget,
    ]  # fmt: skip
    return Problem(model, cost, constraints, th["x0"], N)


def boxed(th: Named) -> Problem:
    """The same boat around a turned, rounded box, with a user's cost."""
    stage = lambda x, u: (x - vector(3.5, 0, 0, 0)).square().sum(-1) + (0.1 + th["effort"]) * u.square().sum(-1)
    cost = FunctionCost(stage, lambda x: 10 * (x - vector(3.5, 0, 0, 0)).square().sum(-1))
    drag = lambda x, u: boat(x, u, torch.full_like(x[..., 0], 0.2), lambda z: 0.0 * z[..., :4])
    box = Boxes(th["centers"][:, :1], th["sides"], th["vehicle"], th["angles"], th["rounding"])
    model = FunctionDynamics(drag, 4, 2, 0.15, "rk4", slice(0, 2))
    return Problem(model, cost, [box, ControlBounds(-5, 5)], th["x0"], N, Goal([3.5, 0.0], 1.0))


def box_numbers() -> dict[str, Tensor]:
    """Everything that `boxed` is made of."""
    held = {name: part for name, part in numbers().items() if name in ("x0", "centers", "vehicle")} | {
        "effort": vector(0.05)
    }
    sides, angles = torch.tensor([[[0.3, 0.5]]], dtype=D).repeat(B, 1, 1), torch.full((B, 1), 0.4, dtype=D)
    return held | {"sides": sides, "angles": angles, "rounding": torch.full((B, 1), 0.1, dtype=D)}


def large_numbers() -> dict[str, Tensor]:
    """The same of a vehicle that is too large to cut into a corner of the box within a step."""
    return box_numbers() | {"vehicle": torch.full((B,), 0.4, dtype=D)}


def growth(problem: Problem, solution: Solution) -> Tensor:
    """By how much (B,) the box has grown, m: by its distance from the nearest knot."""
    (box,) = problem.obstacles
    X = solution.X.detach()
    return box.signed_distance(X[:, box.knots, :2], box.times(X)).flatten(1).amin(-1)


def asking(th: Named) -> dict[str, Tensor]:
    """The same numbers, each a leaf that asks for gradients."""
    return {name: part.clone().requires_grad_() for name, part in th.items()}


@cache
def solved(make: Callable[[Named], Problem], given: Callable[[], Named]) -> tuple[dict[str, Tensor], Solution]:
    """The leaves and the solution of a problem; once for all tests."""
    leaves = asking(given())
    return leaves, torchgco.solve(make(leaves), verbose=False)


def weights(solution: Solution) -> tuple[Tensor, ...]:
    """A direction in X, U and the multipliers of rows that push, in which nothing cancels; the same for all tests."""
    torch.manual_seed(1)
    pushing = [torch.randn_like(lam) * (lam > 1e-6) for lam in solution.detach().multipliers.lam]
    return torch.randn_like(solution.X.detach()), torch.randn_like(solution.U.detach()), *pushing


def along(solution: Solution, weights: tuple[Tensor, ...]) -> Tensor:
    """[of X and U, of the multipliers, of the costs] (3, B) in the direction `weights`."""
    parts = (solution.X, solution.U, *solution.multipliers.lam)
    sums = [(weight * part).flatten(1).sum(-1) for weight, part in zip(weights, parts, strict=True)]
    return torch.stack((sums[0] + sums[1], sum(sums[2:], torch.zeros_like(sums[0])), solution.cost))


def by_differences(
    make: Callable[[Named], Problem],
    th: Named,
    name: str,
    direction: Tensor,
    solution: Solution,
    weights: tuple[Tensor, ...],
    grown: Tensor | None = None,
) -> list[Tensor]:
    """Derivatives (3, B) of `along`, for each of STEPS, by differences of fourth order of tight solves from there."""
    found, start = [], solution.detach()
    for h in STEPS:
        total = torch.zeros(3, len(solution), dtype=D)
        for steps, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
            problem = make({**th, name: th[name] + steps * h * direction})
            problem = problem if grown is None else problem.grown(grown)
            with torch.no_grad():
                end = TIGHT.solve(problem, start.U, warm=start.multipliers, X0=start.X)
            total += weight * along(end, weights)
        found.append(total / (12 * h))
    return found
