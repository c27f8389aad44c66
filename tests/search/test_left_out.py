"""Without native kernels a solver leaves parts out: a warning names them, and a column says which kernels solved."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchgco
from tests.problems import planar_batch
from torchgco import ILQR, AugmentedLagrangian, Hold, InteriorPoint, Problem, Restarts, Solution, presets
from torchgco.native.compiler import find_compiler
from torchgco.native.dispatch import EagerWarning
from torchgco.native.kernels import use_native
from torchgco.search import ClearChords, Converge, Solve, Starts

STARTS = "8 further starts by the interior point"
ENDS = "the interior point's ends of trajectories that touched between knots"
FIRST = "the first solve by the interior point (violation 1e-06)"
LAST = "the interior point at the end (violation 1e-06)"
QUICK = Restarts(
    AugmentedLagrangian(ILQR(max_iterations=2), max_outer_iterations=1),
    (Converge(when="first"), Solve(), Converge(when="mapped"), ClearChords(), Converge(), Starts()),
)


def problem_of(obstacles: bool, dtype: torch.dtype = torch.float64) -> Problem:
    problem, _ = planar_batch(B=1, N=8, obstacles=1)
    whole = problem if obstacles else replace(problem, constraints=problem.constraints[1:])
    return whole.cast(dtype)


def said(problem: Problem, solver: object) -> tuple[Solution, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = torchgco.solve(problem, solver=solver, verbose=False)  # type: ignore[arg-type]
    return solution, [str(one.message) for one in caught if issubclass(one.category, EagerWarning)]


@pytest.mark.parametrize(("obstacles", "lost"), [(True, [ENDS, LAST]), (False, [FIRST, LAST, STARTS])])
def test_what_is_left_out_is_named_once(obstacles: bool, lost: list[str]) -> None:
    problem = problem_of(obstacles, torch.float32)
    solution, (line,) = said(problem, QUICK)
    assert line.startswith("solved by PyTorch's kernels, as x0 is float32.") and "C compiler" in line
    assert line.endswith(f"the solver leaves out: {'; '.join(lost)}")
    assert solution.to_frame()["kernels"].tolist() == ["pytorch"]
    assert QUICK.left_out(problem) == lost  # said by the passes themselves
    assert sorted(presets.gco(2).left_out(problem)) == sorted(lost)


def test_a_pass_that_asks_for_the_interior_point_says_what_is_lost_without() -> None:
    with_walls, free = problem_of(True), problem_of(False)
    for passes in (presets.gco(2).passes, presets.gco_max(2).passes, presets.gco_exact(2).passes):
        users = [one for one in passes if "solver" in vars(one) and isinstance(one.solver, InteriorPoint)]
        assert users and all(isinstance(one, Converge | Starts | ClearChords) for one in users)
        assert all(one.left_out(with_walls) or one.left_out(free) or one.when == "mapped" for one in users)
    assert "1e-09" in presets.gco_exact(2).left_out(free)[-2]


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_native_kernels_leave_nothing_out_and_are_named(tmp_path: Path) -> None:
    problem = problem_of(False)
    solution, lines = said(problem, "gco")
    assert not lines and solution.to_frame()["kernels"].tolist() == ["native"]
    solution.save(tmp_path / "solution.npz")
    loaded = Solution.load(tmp_path / "solution.npz")
    assert loaded.to_frame()["kernels"].tolist() == ["native"]
    assert loaded.take(torch.tensor([0])).to_frame()["kernels"].tolist() == ["native"]
    bare = replace(solution, account=None)
    bare.save(tmp_path / "bare.npz")
    assert "kernels" not in Solution.load(tmp_path / "bare.npz").to_frame()


def test_reasons_and_solvers_without_such_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    assert said(problem_of(True, torch.float32), Hold())[1] == []
    (line,) = said(problem_of(False, torch.float32), InteriorPoint())[1]
    assert line.endswith("the solver leaves out: the interior point, in whose place AL-iLQR solves")
    use_native(False)
    try:
        solution, (line,) = said(problem_of(False), "gco")
        assert "as this process has chosen them" in line and solution.to_frame()["kernels"].tolist() == ["pytorch"]
    finally:
        use_native(True)
    monkeypatch.setenv("TORCHGCO_CC", "none")
    slower, left_out = said(problem_of(False), "gco")[1]
    assert "no C compiler" in slower and "no C compiler" in left_out and STARTS in left_out
