"""python -m benchmarks.families.bodies: vehicles whose shape decides: parallel parking, and a corridor hardly wider.

The car of `torchgco scenario=parking`, of 4.0 x 1.8 m, its rear axle 0.7 m from its end, steered by a rate, is covered
by 32 discs. It parks between two others at a kerb, from drawn poses beside them, with its final pose as a required
goal; and it passes a corridor that is 10 % wider than its covered width, and narrower than the ball around it, from
drawn poses before it. Beside the judge,
the true rectangle is measured against the boxes at 20 states between any two knots, by separating axes: `clear`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchgco
from benchmarks.lib import page
from benchmarks.lib.command import Command
from torchgco import Bicycle, Boxes, ControlBounds, Goal, Problem, QuadraticCost, StateBounds, judge

VEHICLE = torchgco.compose(["scenario=parking"]).vehicle
assert VEHICLE.footprint is not None
(BEHIND, _), (AHEAD, SIDE) = VEHICLE.footprint  # m, of the rectangle, from the rear axle
LENGTH, WIDTH = AHEAD - BEHIND, 2.0 * SIDE
CAR = VEHICLE.body
BETWEEN = 20  # states between two knots
FAR = math.inf


def parking(count: int, seed: int) -> Problem:
    """The slots of the scenario."""
    setup = torchgco.compose(["scenario=parking", f"seed={seed}"])
    return setup.task(setup.layouts(count)).problem


def corridor(count: int, seed: int, wide: float = 1.1, N: int = 120, dt: float = 0.1) -> Problem:
    """Two long walls, `wide` times the covered car apart, whose middle lies aside of the start."""
    assert CAR is not None
    rng, reach = np.random.default_rng(seed), float((CAR.offsets[:, 1].abs() + CAR.radii).max())
    middle, half = rng.uniform(-1.5, 1.5, count), wide * reach
    walls = [[[10.0, y + side * (half + 10.0)] for side in (-1.0, 1.0)] for y in middle]
    low, high = [-1.5, -1.5, -0.2, 0.0, 0.0], [-0.5, 1.5, 0.2, 0.0, 0.0]
    x0 = torch.tensor(rng.uniform(low, high, (count, 5)))
    ends = torch.tensor([[[20.0, y, 0.0, 0.0, 0.0]] for y in rng.uniform(-1.5, 1.5, count)], dtype=torch.float64)
    cost = QuadraticCost([0.01, 0.01, 0, 0.01, 0.01], [0.1, 0.1], [10.0, 10, 1, 1, 1], x_ref=ends)
    boxes = Boxes(walls, [[[5.0, 10.0]] * 2] * count, CAR)
    limits = [
        ControlBounds([-1.5, -1.0], [1.5, 1.0]),
        StateBounds([-FAR, -FAR, -FAR, -2.0, -0.6], [FAR, FAR, FAR, 4.0, 0.6]),
    ]
    return Problem(Bicycle(dt), cost, [boxes, *limits], x0, N, Goal(ends[:, 0, :2], 0.5, required=True))


def rectangle_clearance(problem: Problem, X: Tensor) -> np.ndarray:
    """Smallest distance (B,), m, of the rectangle of the car from the boxes along the best axis; below 0: they meet."""
    boxes: Any = problem.obstacles[-1].inscribed
    share = torch.linspace(0, 1, BETWEEN + 1, dtype=X.dtype)[:-1].view(1, 1, -1, 1)
    x = torch.lerp(X[:, :-1, None], X[:, 1:, None], share).flatten(1, 2).numpy()
    along = np.stack((np.cos(x[..., 2]), np.sin(x[..., 2])), axis=-1)
    axes = np.stack((along, np.stack((-along[..., 1], along[..., 0]), axis=-1)), axis=-2)  # (B, K, 2, 2)
    middle = x[..., :2] + (AHEAD + BEHIND) / 2 * along
    away = middle[..., None, :] - boxes.centers.numpy()[:, None]  # (B, K, M, 2)
    half, own = boxes.half_sizes.numpy()[:, None], np.array([LENGTH / 2, WIDTH / 2])
    of_boxes = np.abs(away) - half - np.einsum("i,bkij->bkj", own, np.abs(axes))[..., None, :]
    seen = np.einsum("bkij,bkmj->bkmi", axes, away)
    of_car = np.abs(seen) - own - np.einsum("bkij,bkmj->bkmi", np.abs(axes), np.broadcast_to(half, away.shape))
    return np.maximum(of_boxes.max(-1), of_car.max(-1)).min((1, 2))


def row(title: str, make: Callable[[int, int], Problem], count: int, seed: int) -> list[str]:
    """One scene: how many arrive clear, and the median time."""
    problem = make(count, seed)
    torchgco.solve(problem.take(slice(0, 1)), verbose=False)  # compiled
    began = time.process_time()
    solution = torchgco.solve(problem, verbose=False)
    seconds = (time.process_time() - began) / count
    verdict, true = judge(problem, solution.U), rectangle_clearance(problem, solution.X)
    told, clear = verdict.reached.numpy(), verdict.reached.numpy() & (true >= 0)
    cost = solution.cost[verdict.reached].median() if told.any() else math.nan
    counts = [page.share(int(part.sum()), count) for part in (told, clear)]
    return [title, *counts, f"{cost:.4g}", f"{seconds:.2f}"]


def text(count: int, seed: int) -> str:
    """The table."""
    scenes = {
        "parallel parking, slot of 1.35 car lengths": parking,
        "corridor 10 % wider than the covered car": corridor,
    }
    head = ["scene", "reached by the judge", "rectangle clear between knots", "median cost", "s each"]
    return page.markdown(head, [row(title, make, count, seed) for title, make in scenes.items()])


main = Command(
    __doc__, "bodies", text, "{count} drawn starts each, seed {seed}",
    count=(64, "starts of each scene"), seed=(3, "of the starts"),
)  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
