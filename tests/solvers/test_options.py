"""Every option of the solvers is read, its range is checked, and wrong calls are named."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
import torch

from tests.problems import planar_batch
from torchgco import GCO, ILQR, MPPI, AugmentedLagrangian, InputError, LineSearch
from torchgco.baselines import Hold, IteratedMPPI

BASE = AugmentedLagrangian(
    inner=ILQR(as_printed=True, max_iterations=10, tolerance=1e-2),
    guidance=GCO(sampler=MPPI(samples=12, covariance=None, spread=0.05, rounds=2, noise_knots=5)),
    max_outer_iterations=7,
    violation_tolerance=0.05,
    record=True,
)
# Another value for every option, with the settings that it needs to have an effect.
CHANGES = {
    AugmentedLagrangian: dict(
        inner=ILQR(max_iterations=2), guidance=None, initial_penalty=50.0, penalty_growth=5.0,
        max_outer_iterations=3, violation_tolerance=0.2, record=False,
    ),
    ILQR: dict(as_printed=False, tolerance=1e3, max_iterations=3),
    GCO: dict(
        sampler=MPPI(samples=5), initial_penalty=2.0, penalty_growth=1.0, sample_from_rest=True,
    ),
    MPPI: dict(
        samples=7, covariance=4.0, spread=0.2, temperature=100.0, saturation=None, rounds=1,
        noise_knots=3, decay=0.3, elite=4, dwell_cost=10.0, dtype="float32",
    ),
}  # fmt: skip
# `slots` changes no result (test_batch_contract); test_ilqr tests the line search, test_restarts replaced iterates.
ELSEWHERE = {
    (AugmentedLagrangian, "slots"), (ILQR, "line_search"), (GCO, "start_from_sample"),
}  # fmt: skip
PLACES = {
    AugmentedLagrangian: lambda s, c: replace(s, **c),
    ILQR: lambda s, c: replace(s, inner=replace(s.inner, **c)),
    GCO: lambda s, c: replace(s, guidance=replace(s.guidance, **c)),
    MPPI: lambda s, c: replace(s, guidance=replace(s.guidance, sampler=replace(s.guidance.sampler, **c))),
}


def _run(solver) -> tuple:
    problem, U0 = planar_batch(B=5, N=25, obstacles=12, seed=5)
    solution = solver.solve(problem, U0 + 3.0, seed=1)
    trace = None if solution.trace is None else solution.trace.to_numpy(dtype=float).tobytes()
    return solution.U.numpy().tobytes(), solution.status.tolist(), trace


@pytest.fixture(scope="module")
def base_run() -> tuple:
    return _run(BASE)


@pytest.mark.sampled(9)
@pytest.mark.parametrize(
    ("cls", "change"), [(cls, {name: value}) for cls, changes in CHANGES.items() for name, value in changes.items()]
)
def test_every_option_changes_something(cls, change: dict, base_run: tuple) -> None:
    assert _run(PLACES[cls](BASE, change)) != base_run


def test_no_option_is_forgotten_above() -> None:
    for cls, changes in CHANGES.items():
        covered = {*changes, *(name for c, name in ELSEWHERE if c is cls)}
        assert {f.name for f in fields(cls)} == covered, cls


@pytest.mark.parametrize(
    ("make", "field"),
    [
        (lambda: ILQR(tolerance=-1.0), "ilqr.tolerance"),
        (lambda: ILQR(max_iterations=0), "ilqr.max_iterations"),
        (lambda: LineSearch(back=-1), "line_search.back"),
        (lambda: GCO(initial_penalty=0.0), "gco.initial_penalty"),
        (lambda: GCO(penalty_growth=0.5), "gco.penalty_growth"),
        (lambda: AugmentedLagrangian(initial_penalty=0.0), "solver.initial_penalty"),
        (lambda: AugmentedLagrangian(penalty_growth=0.9), "solver.penalty_growth"),
        (lambda: AugmentedLagrangian(max_outer_iterations=0), "solver.max_outer_iterations"),
        (lambda: AugmentedLagrangian(violation_tolerance=0.0), "solver.violation_tolerance"),
        (lambda: AugmentedLagrangian(slots=0), "solver.slots"),
        (lambda: IteratedMPPI(iterations=0), "solver.iterations"),
        (lambda: IteratedMPPI(violation_tolerance=0.0), "solver.violation_tolerance"),
    ],
)
def test_bad_options_are_named(make, field: str) -> None:
    with pytest.raises(InputError, match=field):
        make()


def test_bad_calls_are_named() -> None:
    problem, U0 = planar_batch(B=2, N=10)
    for solver in (AugmentedLagrangian(), ILQR(), Hold(), IteratedMPPI()):
        with pytest.raises(InputError, match="U0"):
            solver.solve(problem, U0[:, :5])
        with pytest.raises(InputError, match="U0"):
            solver.solve(problem, U0.float())
        with pytest.raises(InputError, match="ids"):
            solver.solve(problem, U0, ids=torch.arange(3))
