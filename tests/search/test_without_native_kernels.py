"""Without native kernels a solver leaves nothing out: PyTorch's find the same trajectories, and a column names them."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchgco
from tests.problems import planar_batch
from torchgco import Hold, InteriorPoint, Problem, Solution, Status
from torchgco.kernels import EagerWarning, use_native
from torchgco.native.compiler import NativeError, find_compiler


def problem_of(obstacles: bool, dtype: torch.dtype = torch.float64) -> Problem:
    problem, _ = planar_batch(B=1, N=8, obstacles=1)
    whole = problem if obstacles else replace(problem, constraints=problem.constraints[1:])
    return whole.cast(dtype)


def said(problem: Problem, solver: object) -> tuple[Solution, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solution = torchgco.solve(problem, solver=solver, verbose=False)  # type: ignore[arg-type]
    return solution, [str(one.message) for one in caught if issubclass(one.category, EagerWarning)]


@pytest.mark.parametrize("obstacles", [True, False])
def test_single_precision_is_solved_by_the_same_passes(obstacles: bool) -> None:
    solution, lines = said(problem_of(obstacles, torch.float32), "gco")
    assert not lines and solution.statuses == [Status.CONVERGED]
    assert solution.to_frame()["kernels"].tolist() == ["pytorch"] and solution.X.dtype == torch.float32
    whole = torchgco.solve(problem_of(obstacles), verbose=False)
    torch.testing.assert_close(solution.cost.double(), whole.cost, rtol=1e-4, atol=0)


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_native_kernels_are_named(tmp_path: Path) -> None:
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


def test_only_the_time_is_warned_of_and_only_where_a_part_or_a_compiler_is_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for solver in (Hold(), InteriorPoint()):
        assert said(problem_of(True, torch.float32), solver)[1] == []
    use_native(False)
    try:
        solution, lines = said(problem_of(False), "gco")
        assert not lines and solution.to_frame()["kernels"].tolist() == ["pytorch"]
    finally:
        use_native(True)
    monkeypatch.setenv("TORCHGCO_CC", "none")
    (slower,) = said(problem_of(False), "gco")[1]
    assert "many times slower" in slower and "no C compiler" in slower


@pytest.mark.parametrize("obstacles", [True, False])
def test_without_a_compiler_a_search_goes_on_with_al_ilqr(monkeypatch: pytest.MonkeyPatch, obstacles: bool) -> None:
    whole = torchgco.solve(problem_of(obstacles), verbose=False)
    monkeypatch.setenv("TORCHGCO_CC", "none")
    solution, _ = said(problem_of(obstacles), "gco")
    assert solution.statuses[0] in (Status.CONVERGED, Status.FEASIBLE)
    torch.testing.assert_close(solution.cost, whole.cost, rtol=1e-3, atol=0)
    with pytest.raises(NativeError, match="no C compiler"):
        said(problem_of(obstacles), InteriorPoint())
