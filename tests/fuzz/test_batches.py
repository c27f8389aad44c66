"""The batch contract with random batches: bits don't depend on neighbours, order, slots or repetition."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.tally import count, examples
from tests.problems import FIELDS, boxed_batch, planar_batch, quadrotor_batch, quick_gco
from torchgco import GCO, ILQR, MPPI, AugmentedLagrangian, MultiStart, Problem, Solution, Spheres, Status
from torchgco.baselines import IteratedMPPI

pytestmark = pytest.mark.slow

LOCAL = AugmentedLagrangian(ILQR(max_iterations=6), initial_penalty=0.1, max_outer_iterations=5)
SOLVERS = {
    "al_ilqr": lambda problem: LOCAL,
    "ilqr": lambda problem: ILQR(max_iterations=12),
    "guided": lambda problem: replace(LOCAL, guidance=GCO(MPPI(samples=16))),
    "gco": lambda problem: quick_gco(problem, LOCAL),
    "multistart": lambda problem: MultiStart(LOCAL, starts=3),
    "mppi": lambda problem: IteratedMPPI(MPPI(samples=16), iterations=3),
}
BROKEN = ("nan start", "start in an obstacle", "infinite controls", "huge start")


@st.composite
def batches(draw: Any) -> tuple[Problem, torch.Tensor, dict[int, str]]:
    """Problems in the plane or in space, with spheres, boxes or moving spheres, some of which can't be solved."""
    B, N, seed = draw(st.integers(1, 7)), draw(st.integers(2, 24)), draw(st.integers(0, 10**6))
    kind = draw(st.sampled_from(["plane", "space", "boxes in the plane", "boxes in space", "moving"]))
    M = draw(st.integers(1, 8))
    if kind == "space":
        problem, U0 = quadrotor_batch(B, N, M, seed)
    elif kind.startswith("boxes"):
        problem, U0 = boxed_batch(2 if kind.endswith("plane") else 3, B, N, M, seed)
    else:
        problem, U0 = planar_batch(B, N, M, seed)
    rng = np.random.default_rng(seed)
    if kind == "moving":
        held: Any = problem.constraints[0]
        centers = held.centers.masked_fill(held.absent.unsqueeze(-1), torch.nan)
        radii = (held.inflated_radii - 0.06).masked_fill(held.absent, torch.nan)
        moving = Spheres(centers, radii, 0.06, velocities=rng.uniform(-0.1, 0.1, centers.shape))
        problem = replace(problem, constraints=[moving, *problem.constraints[1:]])
    x0, U0 = problem.x0.clone(), U0 + torch.from_numpy(0.1 * rng.normal(size=U0.shape))
    x0[:, :2] += torch.from_numpy(rng.uniform(-0.05, 0.05, (B, 2)))
    broken = draw(st.dictionaries(st.integers(0, B - 1), st.sampled_from(BROKEN), max_size=2))
    for b, how in broken.items():
        spheres: Any = problem.constraints[0]
        if how == "nan start":
            x0[b, 1] = torch.nan
        elif how == "start in an obstacle":
            d = spheres.centers.shape[-1]
            x0[b, :d] = spheres.centers[b, 0]
        elif how == "infinite controls":
            U0[b, 0, 0] = torch.inf
        else:
            x0[b, 3] = 1e200
    return replace(problem, x0=x0), U0, broken


def assert_same(part: Solution, whole: Solution, rows: torch.Tensor) -> None:
    """Equal bits in all fields; NaN equals NaN."""
    held = whole.take(rows)
    for name in FIELDS:
        a, b = getattr(part, name), getattr(held, name)
        assert torch.equal(a.nan_to_num(7.0) if a.is_floating_point() else a,
                           b.nan_to_num(7.0) if b.is_floating_point() else b), name  # fmt: skip


@pytest.mark.parametrize("name", SOLVERS)
@settings(max_examples=examples(60), suppress_health_check=list(HealthCheck))
@given(batch=batches(), data=st.data())
def test_bits_do_not_depend_on_the_batch(name: str, batch: tuple, data: st.DataObject) -> None:
    problem, U0, broken = batch
    solver, every = SOLVERS[name](problem), torch.arange(problem.B)
    whole = solver.solve(problem, U0, seed=5, ids=every)
    rows = torch.tensor(data.draw(st.lists(st.sampled_from(every.tolist()), min_size=1, max_size=8)))
    assert_same(solver.solve(problem.take(rows), U0[rows], seed=5, ids=rows), whole, rows)
    slots = solver.in_slots(data.draw(st.integers(1, 3)))
    if slots is not None:
        assert_same(slots.solve(problem, U0, seed=5, ids=every), whole, every)
    for b in every.tolist():
        if b not in broken:
            assert whole.statuses[b] not in (Status.RUNNING, Status.NON_FINITE), b
            assert bool(torch.isfinite(whole.X[b]).all() and torch.isfinite(whole.U[b]).all()), b
        elif broken[b] == "start in an obstacle" and name in ("al_ilqr", "gco", "guided"):
            assert whole.statuses[b] == Status.INVALID_START
    count(f"batches solved by {name}", "with broken problems" if broken else "all sound")
