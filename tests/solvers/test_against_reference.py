"""The batched loop follows the nested loops of the NumPy reference, iterate by iterate, in a mixed batch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.problems import planar_batch, quadrotor_batch, reference_of
from tests.reference.augmented_lagrangian import Schedule
from tests.reference.augmented_lagrangian import solve as reference_solve
from tests.reference.guidance import cpuf_hook
from tests.reference.mppi import MppiSettings
from tests.slow import mostly
from torchgco import GCO, ILQR, MPPI, AugmentedLagrangian
from torchgco.base.draws import DrawKey, standard_normal
from torchgco.solvers.contracts import Progress

CASES = {
    "planar": (lambda: planar_batch(B=4, N=40, obstacles=8, seed=4), 1e-3, 30),
    "quadrotor": (lambda: quadrotor_batch(B=3, N=25, obstacles=6, seed=2), 0.1, 30),
}
OUTER, SAMPLES = 5, 20


class Snapshots:
    """Multipliers in force at each outer iteration of each problem, taken from the running state."""

    def __init__(self) -> None:
        self.lam: dict[tuple[int, int], list[np.ndarray]] = {}
        self.mu: dict[tuple[int, int], float] = {}

    def __call__(self, progress: Progress) -> None:
        state = progress.state
        for i, (row, outer) in enumerate(zip(state.rows.tolist(), state.outer.tolist(), strict=True)):
            self.lam[row, outer] = [lam[i].numpy().copy() for lam in state.multipliers.lam]
            self.mu[row, outer] = float(state.multipliers.mu[i])


def _reference(problem, U0, b: int, tolerance: float, limit: int, guided: bool):
    twin = reference_of(problem, b)
    schedule = Schedule(outer_iterations=OUTER, tolerance=tolerance, max_iterations=limit)
    if not guided:
        return reference_solve(twin, U0[b].numpy(), schedule)

    def noise(outer: int) -> np.ndarray:
        # The reference counts guided updates from 0; the key counts finished inner solves.
        key = DrawKey(0, torch.tensor([b]), torch.tensor([outer + 1]))
        z = standard_normal(key, problem.N * problem.m, range(SAMPLES), torch.float64)
        return z.unflatten(0, (problem.N, problem.m))[:, :, 0].permute(2, 0, 1).numpy()

    settings = MppiSettings(sigma=np.ones(problem.m), lower=twin.u_lower, upper=twin.u_upper)
    vehicle = float(problem.constraints[0].vehicle_radius[b])
    return reference_solve(twin, U0[b].numpy(), schedule, guidance=cpuf_hook(twin, noise, settings, vehicle))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("guided", [False, True], ids=["al_ilqr", "gco"])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("native", mostly(["native", "eager"], "eager"), indirect=True)
def test_iterates_follow_the_nested_loops(case: str, guided: bool, native: bool) -> None:
    make, tolerance, limit = CASES[case]
    problem, U0 = make()
    guidance = GCO(sampler=MPPI(samples=SAMPLES)) if guided else None
    inner = ILQR(as_printed=True, tolerance=tolerance, max_iterations=limit)
    solver = AugmentedLagrangian(inner=inner, guidance=guidance, max_outer_iterations=OUTER, record=True)
    snapshots = Snapshots()
    solution = solver.solve(problem, U0, callback=snapshots)
    trace = solution.trace
    assert trace is not None
    lengths = set()
    for b in range(problem.B):
        reference = _reference(problem, U0, b, tolerance, limit, guided)
        mine = trace[trace.element == b]
        theirs = [(o, r) for o, outer in enumerate(reference.records) for r in outer.inner]
        assert len(mine) == len(theirs)
        lengths.add(len(theirs))
        assert mine.outer.tolist() == [o for o, _ in theirs]
        np.testing.assert_allclose(mine.merit, [r.cost for _, r in theirs], rtol=1e-7)
        np.testing.assert_array_equal(mine.alpha, [r.alpha for _, r in theirs])
        np.testing.assert_array_equal(mine.regularisation, [r.mu_r for _, r in theirs])
        for o, outer in enumerate(reference.records):
            if o < OUTER - 1:  # a problem leaves the running state with its last one
                present = ~problem.constraints[0].absent[b].numpy()
                spheres, bounds = snapshots.lam[b, o]
                np.testing.assert_allclose(spheres[:, present], outer.lam.spheres, rtol=1e-6, atol=1e-6)
                np.testing.assert_allclose(bounds, outer.lam.bounds, rtol=1e-6, atol=1e-6)
                assert snapshots.mu[b, o] == pytest.approx(outer.mu)
        guided_outer = set(mine.outer[mine.guided])
        assert guided_outer == {o for o, outer in enumerate(reference.records) if outer.guide is not None}
    assert len(lengths) > 1, "all problems took equally many iterations: the batch is not mixed"
    if guided:
        assert trace.guided.any()
