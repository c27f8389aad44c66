"""The outer loop in C against the one in PyTorch around the same inner solves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.problems import planar_batch, quadrotor_batch
from tests.search.test_finish import brachistochrone, bryson_denham, parking
from tests.slow import mostly
from torchgco import ILQR, AugmentedLagrangian, Boxes, Problem, Spheres, StateBounds, presets
from torchgco.costs.quadratic import BoundQuadratic
from torchgco.kernels import chord_clearance, kernels_of, measured, open_loop
from torchgco.lagrangian.lagrangian import Lagrangian, Multipliers, SolveEnd
from torchgco.lagrangian.quality import violation
from torchgco.native.engine import Engine
from torchgco.native.packing import is_bounded
from torchgco.obstacles.spheres import BoundSpheres
from torchgco.problem.horizons import for_solvers
from torchgco.solvers.caught import StopWhenCaught
from torchgco.solvers.contracts import Call

STANDARD = AugmentedLagrangian(ILQR(max_iterations=12), initial_penalty=0.3, max_outer_iterations=8)
SOLVERS = {
    "standard": STANDARD,
    "as printed": replace(STANDARD, inner=ILQR(as_printed=True, tolerance=0.1, max_iterations=8)),
    "slots": replace(STANDARD, slots=2),
}


def walled() -> tuple[Problem, Tensor]:
    """Bodies among boxes, one of them turned, and spheres; a state is bounded at two knots."""
    problem, U0 = quadrotor_batch(B=5, N=25, obstacles=6, seed=2)
    boxes = Boxes(
        [[2.0, 0.5, 1.0], [4.0, -0.5, 1.5]], [[0.3, 0.8, 1.0], [0.5, 0.2, 2.0]],
        rotations=[[1.0, 0, 0, 0], [0.8, 0, 0, 0.6]], vehicle_radius=0.2,
    )  # fmt: skip
    most = torch.full((14,), torch.inf, dtype=torch.float64)
    most[3:6] = 2.0
    bounds = StateBounds(-most, most, knots=[4, 9])
    return replace(problem, constraints=[*problem.constraints, boxes, bounds]), U0


def of(make: Callable[[], Problem]) -> tuple[Problem, Tensor]:
    problem = make()
    return problem, problem.cost.rest_controls(problem.x0.new_zeros(problem.B, problem.N, problem.m)) + 0.1


PROBLEMS: dict[str, Callable[[], tuple[Problem, Tensor]]] = {
    "planar": lambda: planar_batch(B=5, N=25, obstacles=9, seed=4),
    "quadrotor": lambda: quadrotor_batch(B=5, N=25, obstacles=7, seed=2),
    "walled": walled,
    "brachistochrone": lambda: of(brachistochrone),
    "bryson_denham": lambda: of(bryson_denham),
    "parking": lambda: of(parking),
}


def both(monkeypatch: pytest.MonkeyPatch, solve: Callable[[], SolveEnd]) -> tuple[SolveEnd, SolveEnd]:
    native = solve()
    real = Engine.__init__

    def without(self: Engine, *arguments: object) -> None:
        real(self, *arguments)
        self.measures = False

    monkeypatch.setattr(Engine, "__init__", without)
    monkeypatch.setattr("torchgco.kernels.choice._engines", {})
    return native, solve()


@pytest.mark.sampled(6)
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("stops", mostly([False, True], True))
def test_both_loops_agree(name: str, solver: str, stops: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, U0 = PROBLEMS[name]()
    guidance = StopWhenCaught(3) if stops else None
    native, other = both(
        monkeypatch,
        lambda: SOLVERS[solver].outer_loop(Call.checked(problem, U0).in_cost_units()[0], guidance, by_arrival=stops),
    )
    assert native.status.tolist() == other.status.tolist()
    for count in ("iterations", "outer", "guided"):
        assert getattr(native, count).tolist() == getattr(other, count).tolist()
    for one, two in ((native.best, other.best), (native.last, other.last)):
        for part in ("X", "U", "cost", "violation"):
            torch.testing.assert_close(getattr(one, part), getattr(two, part), rtol=1e-5, atol=1e-7)
        torch.testing.assert_close(one.multipliers.mu, two.multipliers.mu)
        for a, b in zip(one.multipliers.lam, two.multipliers.lam, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("preset", ["gco_paper", "al_ilqr"])
def test_guided_and_printed_solves_agree(preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, U0 = planar_batch(B=3, N=25, obstacles=9, seed=4)
    solver = replace(presets.named(preset, problem), max_outer_iterations=4)
    native, other = both(monkeypatch, lambda: solver.outer_loop(Call.checked(problem, U0), solver.guidance))
    assert native.guided.tolist() == other.guided.tolist() and native.outer.tolist() == other.outer.tolist()
    torch.testing.assert_close(native.best.cost, other.best.cost, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("N", [1, 7, 8, 25])
def test_lines_count_up_to_each_problems_own_last_knot(N: int) -> None:
    problem, U0 = planar_batch(B=5, N=N, obstacles=9, seed=4)
    part, spheres = (
        for_solvers(replace(problem, horizon=[1 + b * (N - 1) // 4 for b in range(5)])),
        problem.obstacles[0],
    )
    X = open_loop(part, U0 + 0.3 * torch.randn(U0.shape, generator=torch.Generator().manual_seed(1), dtype=U0.dtype))
    X[:, -1, :2] = spheres.inflated().centers[:, 0]
    rows = [spheres.take([b]).chord_clearance(X[[b], : 2 + b * (N - 1) // 4], 0.0) for b in range(5)]
    torch.testing.assert_close(chord_clearance(part, X, 0.0), torch.cat(rows), rtol=1e-12, atol=1e-12)
    assert bool((chord_clearance(problem, X, 0.0) < 0).all())
    X[1, 1, 0] = torch.nan
    assert torch.isnan(chord_clearance(part, X, 0.0)).tolist() == [False, True, False, False, False]


@pytest.mark.parametrize("moving", [False, True])
def test_violations_slacks_and_clearances_equal_those_of_pytorch(moving: bool) -> None:
    problem, U0 = walled()
    if moving:
        spheres = problem.obstacles[0]
        assert isinstance(spheres, BoundSpheres)
        velocities = torch.linspace(-1.0, 1.0, spheres.centers.numel(), dtype=torch.float64).view_as(spheres.centers)
        radii = (spheres.inflated_radii - spheres.vehicle_radius[:, None]).masked_fill(spheres.absent, torch.nan)
        centers = spheres.centers.masked_fill(spheres.absent.unsqueeze(-1), torch.nan)
        others = [part for part in problem.constraints if part is not spheres]
        more = Spheres(centers, radii, spheres.vehicle_radius, velocities)
        problem = replace(problem, constraints=[more, *others])
    U = U0 + 0.3 * torch.randn(U0.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    X = open_loop(problem, U)
    spheres = next(part for part in problem.obstacles if isinstance(part, BoundSpheres))
    X[:3, 5, :3] = spheres.centers[:3, 0] + 0.05
    X[3:, 9, :3] = torch.tensor([2.1, 0.6, 1.2], dtype=torch.float64)  # in a box
    for parts, alone in ((problem.constraints, False), (problem.geometric, True)):
        found = measured(problem, X, U, obstacles=alone)
        torch.testing.assert_close(found, violation(parts, X, U), rtol=1e-12, atol=1e-12)
        assert bool((found > 0).any())
    draw, some = torch.Generator().manual_seed(2), [(problem.B, *shape) for shape in problem.row_shapes]
    lam = tuple(torch.rand(shape, generator=draw, dtype=torch.float64) - 0.3 for shape in some)
    for held in (lam, tuple(part.clamp(min=0.5) - 0.5 for part in lam)):
        lagrangian = Lagrangian(problem, Multipliers(held, torch.ones_like(X[:, 0, 0])), None, True)
        slack = lagrangian.slack(X, U)
        torch.testing.assert_close(kernels_of(problem).judged(lagrangian, X, U).slack, slack, rtol=1e-12, atol=1e-12)
        assert bool((slack > 0).all())
    for share in (0.0, 0.05, 0.3):
        rows = torch.stack([part.chord_clearance(X, share) for part in problem.obstacles])
        torch.testing.assert_close(chord_clearance(problem, X, share), rows.amin(0), rtol=1e-12, atol=1e-12)
    X[1, 7, 0] = torch.nan
    assert bool(torch.isnan(measured(problem, X, U))[1]) and bool(torch.isfinite(measured(problem, X, U))[0])


@pytest.mark.parametrize("name", ["planar", "quadrotor", "walled"])
@pytest.mark.parametrize("kind", ["standard", "as printed"])
def test_trials_that_end_early_are_those_that_would_be_refused(
    monkeypatch: pytest.MonkeyPatch, kind: str, name: str
) -> None:
    """Rollouts of the line search that end where L_M is already too high change no bit."""
    problem, U0 = PROBLEMS[name]()
    solver = SOLVERS[kind]
    short = solver.solve(problem, U0)
    assert is_bounded(problem.cost)
    monkeypatch.setattr("torchgco.native.engine.is_bounded", lambda cost: False)
    whole = solver.solve(problem.renewed(), U0)
    for field in ("X", "U", "K", "cost", "violation", "status", "iterations"):
        assert torch.equal(getattr(short, field), getattr(whole, field)), field


def test_a_cost_is_bounded_where_no_stage_can_be_below_zero() -> None:
    cost = planar_batch()[0].cost
    assert isinstance(cost, BoundQuadratic) and is_bounded(cost)
    below = replace(cost, R=-cost.R)
    linear = replace(cost, q=torch.ones_like(cost.Q))
    matrices = replace(cost, Q=cost.Q.diag_embed(), R=cost.R.diag_embed(), Qf=cost.Qf.diag_embed(), diagonal=False)
    assert not any(map(is_bounded, (below, linear, matrices)))
