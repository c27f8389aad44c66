"""With the time free, trajectories keep clear of obstacles between the knots, too."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import torchgco
from torchgco import ControlBounds, FreeTime, FunctionDynamics, Goal, Problem, QuadraticCost, Spheres, Status, presets

END = [10.0, 0.0, 0.0, 0.0]


def slalom(radii: list[float]) -> Problem:
    """Points in the least time past seven discs, left and right of the straight line, in few stages."""
    point = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), -1), 4, 2, 0.3, "rk4", slice(0, 2))
    centers = [[1.0 + 1.3 * i, 0.28 * (-1) ** i] for i in range(7)]
    sizes = torch.tensor(radii, dtype=torch.float64).unsqueeze(1).expand(-1, 7)
    parts = [Spheres(centers, sizes, 0.05), ControlBounds(-4.0, 4.0)]
    cost, start = QuadraticCost([0.0] * 4, [0.01] * 2, [0.0] * 4, x_ref=END), torch.zeros(len(radii), 4).double()
    return Problem(point, cost, parts, start, 12, Goal(state=END, required=True), time=FreeTime(0.3, 8.0, weight=1.0))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")
def test_a_trajectory_in_free_time_is_cleared_between_the_knots() -> None:
    problem = slalom([0.4, 0.25, 0.02])
    solver = presets.gco(problem)
    touching = torchgco.solve(problem, solver=replace(solver, passes=solver.passes.changed(clear=None)), verbose=False)
    clear = torchgco.solve(problem, verbose=False)
    before, after = (torchgco.judge(problem, one.U, times=one.t).clearance for one in (touching, clear))
    assert bool((before[:2] < 0).all()) and bool((after >= 0).all())
    ratio = clear.cost / touching.cost
    assert bool((ratio < 1.02).all()) and clear.statuses[0] is Status.CONVERGED
    assert float(before[2]) >= 0 and torch.equal(clear.U[2], touching.U[2]), "what touches nothing stays as it is"
    alone = torchgco.solve(problem.take([1]), verbose=False)
    assert torch.equal(alone.U[0], clear.U[1]), "the same bits alone and in a batch"
