"""Several solvers on the same problems, in one table."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import torchgco
from tests.problems import planar_batch
from torchgco import ControlBounds, FunctionCost, FunctionDynamics, InputError, Problem, Spheres, presets


def test_each_row_is_that_of_a_solve_alone() -> None:
    problem, U0 = planar_batch(B=3, N=20, obstacles=2)
    table = torchgco.compare(problem, ["hold", "al_ilqr"], U0)
    assert table.index.names == ["solver", "element"] and len(table) == 6
    for name in ("hold", "al_ilqr"):
        alone = torchgco.solve(problem, U0, solver=name).to_frame(problem)
        assert table.loc[name, list(alone.columns)].equals(alone)
        assert (table.loc[name, "seconds"] > 0).all() and set(table.loc[name, "kernels"]) == {"native"}
        assert set(table.loc[name, "device"]) == {"cpu"}
        assert set(table.loc[name, "threads"]) == {torch.get_num_threads()}
    good = table[table["reached"]] if table["reached"].any() else table.iloc[:0]
    assert table.loc[~table["reached"], "cost_ratio"].isna().all()
    for _, rows in good.groupby("element"):
        np.testing.assert_allclose(rows["cost_ratio"], rows["cost"] / rows["cost"].min())


def test_solvers_have_names_of_their_own() -> None:
    problem, _ = planar_batch(B=1, N=8)
    table = torchgco.compare(problem, {"still": "hold", "mine": presets.named("al_ilqr", problem)})
    assert table.index.get_level_values("solver").tolist() == ["still", "mine"]
    for wrong in ("hold", [], ["hold", "hold"], 3, None):
        with pytest.raises(InputError, match="solvers: expected a list of different ones"):
            torchgco.compare(problem, wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="solver: expected one of gco"):
        torchgco.compare(problem, ["nothing"])


def test_a_trajectory_through_an_obstacle_is_no_best_one() -> None:
    """Its knots lie before and behind the ball: what stays clear had a ratio of 301 to it."""
    model = FunctionDynamics(lambda x, u: u, 2, 2, 1.0, "rk4", position=slice(0, 2))
    end = torch.tensor([4.0, 0.0]).double()
    cost = FunctionCost(lambda x, u: 0.1 * u.square().sum(-1), lambda x: 10.0 * (x - end).square().sum(-1))
    rows, x0 = [Spheres([[2.0, 0.02]], [0.35]), ControlBounds(-3.0, 3.0)], torch.zeros(1, 2).double()
    problem = Problem(model, cost, rows, x0, 3)
    with pytest.warns(torchgco.ContactWarning):
        table = torchgco.compare(problem, ["al_ilqr", "hold"])
    assert table["cost"].iloc[0] < table["cost"].iloc[1] and (table["clearance"] < 0).tolist() == [True, False]
    assert np.isnan(table["cost_ratio"].iloc[0]) and table["cost_ratio"].iloc[1] == 1.0


def test_a_trajectory_is_judged_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """For its columns, and for the best cost, it was twice."""
    problem, U0 = planar_batch(B=2, N=10, obstacles=2)
    judged = []
    for place in (torchgco.api, torchgco.judging.judge):
        monkeypatch.setattr(
            place, "judge", lambda *given, own=place.judge, **named: (judged.append(1), own(*given, **named))[1]
        )
    table = torchgco.compare(problem, ["hold", "al_ilqr"], U0)
    assert len(judged) == 2 and "clearance" in table
