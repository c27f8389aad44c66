"""acados as a peer: its worker reads the same problem, and its solutions are judged like all others."""

from __future__ import annotations

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import torch

from benchmarks.lib import acados, acados_worker
from benchmarks.lib.provenance import provenance
from benchmarks.speed import families
from benchmarks.speed.bench import Bench
from benchmarks.speed.results import Results
from tests.benchmarks.test_speed import TINY
from tests.problems import boxed_batch, planar_batch, quadrotor_batch
from torchgco import ControlBounds, InputError, Problem, QuadraticCost, Spheres, StateBounds
from torchgco.baselines import CasADiSolver
from torchgco.dynamics.rollout import open_loop

needs_acados = pytest.mark.skipif(not acados.installed(), reason="acados isn't installed: `make benchmark` does")


def read_problem(folder: Path) -> tuple[dict, dict[str, np.ndarray]]:
    with np.load(folder / "problems.npz") as file:
        return json.loads((folder / "form.json").read_text()), dict(file)


def guess(problem: Problem, U: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return open_loop(problem.dynamics, problem.x0, U), U


def test_instructions_compute_the_function() -> None:
    x, p = ca.SX.sym("x", 3), ca.SX.sym("p", 2)
    result = ca.vertcat(
        ca.sin(x[0]) * p[1] - 2.5,
        ca.if_else(x[1] > 0, x[1] ** 2, ca.exp(x[2])),
        ca.fmin(x[0], ca.atan2(x[1], p[0])),
        7.0,
    )
    plain = json.loads(json.dumps(acados.instructions("f", ([x, p], result))))
    again = ca.Function("f", [x, p], [acados_worker.replay(plain, x, p)])
    for point in np.random.default_rng(0).normal(size=(5, 5)):
        expected = ca.Function("f", [x, p], [result])(point[:3], point[3:])
        assert np.array_equal(again(point[:3], point[3:]), expected)


@pytest.mark.parametrize("batch", [planar_batch, quadrotor_batch])
def test_the_worker_gets_the_problem(batch, tmp_path: Path) -> None:
    """Step, rows, cost and bounds at random points equal those of the problem in PyTorch."""
    problem, U0 = batch(B=2, N=10)
    acados.write(problem, *guess(problem, U0), tmp_path)
    form, numbers = read_problem(tmp_path)
    n, m = problem.n, problem.m
    draw = torch.Generator().manual_seed(1)
    X = problem.x0.unsqueeze(1) + torch.randn(2, problem.N + 1, n, generator=draw, dtype=torch.float64)
    U = torch.randn(2, problem.N, m, generator=draw, dtype=torch.float64)
    spheres, bounds = problem.constraints
    rows = spheres.value(X, U).numpy()
    symbols = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("p", numbers["p"].shape[-1])
    step, stage, last = (
        ca.Function(word, symbols, [acados_worker.replay(form[word], *symbols)])
        for word in ("step", "rows", "last_rows")
    )
    for b in range(2):
        x, u, p = X[b, 3].numpy(), U[b, 3].numpy(), numbers["p"][b, 0]
        after = problem.dynamics.step(X[:, 3], U[:, 3])[b]
        np.testing.assert_allclose(np.ravel(step(x, u, p)), after, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(np.ravel(stage(x, u, p)), rows[b, 3 - spheres.knots.start], rtol=1e-10)
        np.testing.assert_allclose(np.ravel(last(X[b, -1].numpy(), u, p)), rows[b, -1], rtol=1e-10)
        z = np.concatenate((x, u))
        cost = 0.5 * (numbers["weight"][b] * (z - numbers["reference"][b]) ** 2).sum()
        np.testing.assert_allclose(cost, problem.cost.stage(X[:, 3], U[:, 3], 3)[b], rtol=1e-12)
        end = 0.5 * (numbers["last_weight"][b] * (X[b, -1].numpy() - numbers["last_reference"][b]) ** 2).sum()
        np.testing.assert_allclose(end, problem.cost.terminal(X[:, -1])[b], rtol=1e-12)
    assert form["equality"] == form["last_equality"] == [False] * rows.shape[-1]
    for side in ("lower", "upper"):
        np.testing.assert_allclose(numbers[side], getattr(bounds, side).expand(2, problem.N, m))


def rows_at(folder: Path, b: int, k: int, x: np.ndarray, m: int) -> np.ndarray:
    """The rows that the worker gets for problem b at knot k."""
    form, numbers = read_problem(folder)
    own = numbers["p"][b]
    p = own[k if len(own) > 1 else 0]
    symbols = ca.SX.sym("x", len(x)), ca.SX.sym("u", m), ca.SX.sym("p", len(p))
    word = "last_rows" if k == form["N"] else "rows"
    rows = ca.Function("rows", symbols, [acados_worker.replay(form[word], *symbols)])
    return np.ravel(rows(x, np.zeros(m), p))


def moving_spheres() -> Problem:
    """Two problems with three spheres, absent in one; at 0.1 s per stage a time of 1 s simplifies products."""
    plain, _ = planar_batch(B=2, N=14)
    rng = np.random.default_rng(0)
    centers, velocities, radii = rng.normal(size=(2, 3, 2)), rng.normal(size=(2, 3, 2)), np.full((2, 3), 0.1)
    for array in (centers, velocities, radii):
        array[0, 2] = np.nan
    spheres = Spheres(centers, radii, 0.06, velocities)
    return Problem(plain.dynamics, plain.cost, [spheres, plain.constraints[1]], plain.x0, 14)


@pytest.mark.parametrize("kind", ["moving", "boxes", "rounded"])
def test_the_worker_gets_the_rows_of_every_knot(kind: str, tmp_path: Path) -> None:
    """Spheres that move, and boxes, with some absent: rows at random states equal those of the problem in PyTorch."""
    problem = moving_spheres() if kind == "moving" else boxed_batch(3, B=2, N=14, rounded=kind == "rounded")[0]
    B, N, m = problem.B, problem.N, problem.m
    U0 = torch.zeros(B, N, m, dtype=torch.float64)
    acados.write(problem, *guess(problem, U0), tmp_path)
    X = torch.randn(B, N + 1, problem.n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    obstacles = [c for c in problem.constraints if c.geometric]
    values = np.concatenate([c.value(X, U0).numpy() for c in obstacles], axis=-1)
    for b, k in ((0, 1), (1, 5), (0, 10), (1, N)):
        np.testing.assert_allclose(rows_at(tmp_path, b, k, X[b, k].numpy(), m), values[b, k - 1], rtol=1e-9, atol=1e-9)


def write_problem(problem: Problem, U0: torch.Tensor, folder: Path) -> None:
    acados.write(problem, *guess(problem, U0), folder)


def test_problems_without_a_form_for_acados_are_named(tmp_path: Path) -> None:
    plain, U0 = planar_batch(B=2, N=8)
    spheres, bounds = plain.constraints
    some = ControlBounds([-9.0, -9.0], [9.0, 9.0], knots=[1, 2])
    linear = QuadraticCost(Q=[1.0] * 6, R=[0.1] * 2, Qf=[9.0] * 6, q=[1.0] * 6)
    for cost, constraints, field in (
        (plain.cost, [bounds, StateBounds([-9.0] * 6, [9.0] * 6)], "states"),
        (plain.cost, [spheres], "all controls"),
        (plain.cost, [some], "all controls"),
        (linear, [bounds], "linear"),
    ):
        with pytest.raises(InputError, match=field):
            write_problem(Problem(plain.dynamics, cost, constraints, plain.x0, 8), U0, tmp_path)


@pytest.mark.slow
def test_a_failed_worker_gives_a_row_and_stops_nothing(tmp_path: Path, monkeypatch) -> None:
    """The other peers still run; the failed ones leave one row each, with the error."""
    monkeypatch.setattr(acados, "installed", lambda: True)
    monkeypatch.setattr(acados, "ENVIRONMENT", tmp_path)
    (tmp_path / "bin").mkdir()
    python = tmp_path / "bin" / "python"
    python.write_text("#!/bin/sh\necho no such library >&2\nexit 3\n")
    python.chmod(0o755)
    bench = Bench(TINY, Results(tmp_path / "results.csv"), provenance("cpu"), say=lambda text: None)
    families.run(bench)
    ended = {row["solver"]: row["value"] for row in bench.results.rows if row["quantity"] == "ended with"}
    assert ended == dict.fromkeys(("acados", "acados_guided"), "acados ended with 3: no such library")
    assert {"fatrop / gco", "fatrop_guided / gco"} <= {row["solver"] for row in bench.results.rows}


@needs_acados
def test_acados_agrees_with_fatrop(tmp_path: Path) -> None:
    """Twice, the second time without compiling; no number of one problem carries over to the next."""
    problem, U0 = planar_batch(B=3, N=30, obstacles=3, seed=2)
    rows = torch.tensor([1, 2])  # the first has two paths around its obstacles
    first = acados.fly(problem, U0, tmp_path)
    solution = CasADiSolver("fatrop").solve(problem, U0)
    X = open_loop(problem.dynamics, problem.x0, first.U)
    cost = problem.cost.total(X, first.U)
    torch.testing.assert_close(cost[rows], solution.cost[rows], rtol=1e-2, atol=0)
    assert (first.status == 0).all() and (first.iterations > 1).all() and (first.processor >= 0).all()
    again = acados.fly(problem, U0, tmp_path)
    assert torch.equal(again.U, first.U) and again.setup < first.setup
    part = problem.take(rows)
    alone = acados.fly(part, U0[rows], tmp_path)
    torch.testing.assert_close(alone.U, first.U[rows], rtol=1e-9, atol=1e-9)
