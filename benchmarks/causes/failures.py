"""python -m benchmarks.causes.failures: why the paper's guidance fails where it does, with one picture per cause.

`gco_paper` flies the public layouts while a witness records, after every inner solve, the state that guidance got and
its answer. Every layout whose goal isn't reached gets one cause, derived from its last outer iterations; the table and
the pictures go to benchmarks/failures.md and failures.png.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from benchmarks.causes.picture import Example, picture, table
from benchmarks.lib import ROOT
from benchmarks.lib.command import parser_of
from benchmarks.lib.families import FAMILIES, Family
from benchmarks.lib.page import origin, put
from benchmarks.lib.recorded import Told
from torchgco import compose, judge
from torchgco.base.draws import DrawKey
from torchgco.guidance.gco import GCO
from torchgco.lagrangian.quality import violation
from torchgco.problem.problem import Problem
from torchgco.solvers.caught import active_counts, caught_knots

LAST = 3  # outer iterations that decide the cause
CAUSES = {
    "diverged": "the penalty has outgrown the model: the last iterate costs over five times the first",
    "no pair in contact": "spheres are touched, but no two at one knot: J is empty, and there is no guidance",
    "stopped in front": "feasible, free of contact, and not at the goal: waiting is cheaper than the detour",
    "noise too weak": "the sampled plan lies within half a sphere's radius of the caught trajectory",
    "guide infeasible": "the sampled plan touches obstacles at the knots that it guides",
    "guide stops": "the sampled plan ends before the obstacle: farther from the goal than a quarter of the distance",
    "guide changes": "plans of successive outer iterations lie over a sphere's radius apart",
    "other class": "plan and trajectory pass a sphere on different sides: the guide leads through it",
    "not in time": "none of these: the guide is good and stays, and the limits end the solve",
}


@dataclass
class Witness:
    """Guidance that records its calls, and those of its sampler, and changes nothing."""

    guidance: GCO
    rows: list[pd.DataFrame] = field(default_factory=list)
    last: dict[int, Tensor] = field(default_factory=dict)  # by layout: the plan (N+1, d), m, when last caught
    plan: tuple[Tensor, Tensor] | None = None  # ids and plans of the last call of the sampler

    def suited(self, problem: Problem) -> Any:
        return self

    def start(self, problem: Problem, X: Tensor) -> Any:
        return self.guidance.start(problem, X)

    def update(self, problem: Problem, X: Tensor, U: Tensor, penalty: Any, key: DrawKey) -> Any:
        self.plan = None
        sampler = Told.of(self.guidance.sampler, self._told)
        advice = replace(self.guidance, sampler=sampler).update(problem, X, U, penalty, key)
        self._note(problem, X, U, key)
        return advice

    def _told(self, problem: Problem, U: Tensor, key: DrawKey, X: Tensor) -> None:
        self.plan = (key.ids, X)

    def _note(self, problem: Problem, X: Tensor, U: Tensor, key: DrawKey) -> None:
        caught = caught_knots(problem, X, U)
        at = problem.dynamics.position
        frame = {
            "id": key.ids, "outer": key.outer, "cost": problem.cost.total(X, U),
            "violation": violation(problem.constraints, X, U), "caught": caught.any(-1),
        }  # fmt: skip
        for name in ("near", "deep", "ends", "moved", "crosses"):
            frame[name] = torch.full_like(frame["cost"], torch.nan)
        if self.plan is not None:
            ids, plans = self.plan
            for i, plan in zip(ids.tolist(), plans, strict=True):
                row = int((key.ids == i).nonzero())
                path, part = X[row, :, at], problem.take(torch.tensor([row]))
                frame["near"][row] = (plan[:, at] - path)[caught[row]].norm(dim=-1).mean()
                hits = active_counts(part, plan[None], U[row : row + 1])[0] > 0
                frame["deep"][row] = float((hits & caught[row]).any())
                goal = part.goal.position[0]
                frame["ends"][row] = (plan[-1, at] - goal).norm() / (part.x0[0, at] - goal).norm()
                if i in self.last:
                    frame["moved"][row] = (plan[:, at] - self.last[i]).norm(dim=-1).mean()
                frame["crosses"][row] = float(_crosses(part, path, plan[:, at]))
                self.last[i] = plan[:, at].clone()
        self.rows.append(pd.DataFrame({name: value.numpy() for name, value in frame.items()}))


def _crosses(problem: Problem, path: Tensor, plan: Tensor) -> bool:
    """Whether the band between path and plan (N+1, d), knot by knot, covers the middle of a sphere."""
    spheres = problem.geometric[0]
    along = plan - path
    toward = spheres.centers[0].unsqueeze(1) - path
    share = (toward * along).sum(-1) / along.square().sum(-1).clamp(min=1e-12)
    off = (toward - share.unsqueeze(-1) * along).norm(dim=-1)
    return bool(((share > 0) & (share < 1) & (off < 0.25 * spheres.inflated_radii[0].unsqueeze(1))).any())


def cause(history: pd.DataFrame, feasible: bool, R: float) -> str:
    """The cause for one layout that wasn't reached, from the records of its outer iterations.

    R is the mean inflated radius r_obs + r_veh, m.
    """
    last = history.tail(LAST)
    if last.cost.iloc[-1] > 5 * history.cost.iloc[0] or not np.isfinite(last.cost.iloc[-1]):
        return "diverged"
    if not last.caught.any():
        return "stopped in front" if feasible and last.violation.iloc[-1] <= 1e-3 else "no pair in contact"
    caught = last[last.caught]
    tests = {
        "noise too weak": (caught.near < 0.5 * R).mean(),
        "guide infeasible": caught.deep.mean(),
        "guide stops": (caught.ends > 0.25).mean(),
        "guide changes": (caught.moved > R).mean(),
        "other class": caught.crosses.mean(),
    }
    return next((name for name, share in tests.items() if share > 0.5), "not in time")


def fly(family: Family, count: int, seed: int) -> tuple[pd.DataFrame, dict[str, Example]]:
    """One row per layout with its cause, and one example per cause."""
    setup = compose([*family.overrides(seed=seed), "solver=gco_paper", "device.threads=1"])
    task = setup.task(setup.layouts(count))
    witness = Witness(setup.solver.guidance)
    solver = replace(setup.solver, guidance=witness)
    solution = solver.solve(task.problem, task.U0, seed=seed)
    verdict = judge(task.problem, solution.U, task.goal, task.goal_radius)
    notes, spheres = pd.concat(witness.rows).sort_values("outer"), task.problem.geometric[0]
    rows, examples = [], {}
    for i in range(task.problem.B):
        name, distances = None, spheres.inflated_radii[i]
        if not verdict.reached[i]:
            R = float(distances[distances > 0].mean())
            name = cause(notes[notes.id == i], bool(verdict.feasible[i]), R)
            path = solution.X[i, :, task.problem.dynamics.position]
            plan = witness.last.get(i)
            goal = task.problem.goal.position[i]
            examples.setdefault(name, Example(family.name, i, spheres.centers[i], distances, path, plan, goal))
        rows.append({"family": family.name, "layout": i, "cause": name, "reached": bool(verdict.reached[i])})
    return pd.DataFrame(rows), examples


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--families", nargs="+", default=list(FAMILIES), choices=list(FAMILIES), metavar="NAME")
    parser.add_argument("--first", type=int, default=32, help="layouts per family, the first ones")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--outputs", type=Path, default=ROOT / "benchmarks")
    asked = parser.parse_args(words)
    parts, examples = [], {}
    for name in asked.families:
        trials, found = fly(FAMILIES[name], asked.first, asked.seed)
        parts.append(trials)
        examples = {**found, **examples}
        print(table(pd.concat(parts), CAUSES, "not reached"), flush=True)
    head = f"{origin('`gco_paper`')}, seed {asked.seed}, the first {asked.first} layouts of each family."
    put(asked.outputs / "failures.md", "failures", f"{head}\n\n{table(pd.concat(parts), CAUSES, 'not reached')}")
    picture({name: examples[name] for name in CAUSES if name in examples}, asked.outputs / "failures.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
