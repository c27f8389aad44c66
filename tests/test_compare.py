"""Several solvers on the same problems, in one table."""

from __future__ import annotations

import numpy as np
import pytest

import torchgco
from tests.problems import planar_batch
from torchgco import InputError, presets


def test_each_row_is_that_of_a_solve_alone() -> None:
    problem, U0 = planar_batch(B=3, N=20, obstacles=2)
    table = torchgco.compare(problem, ["hold", "al_ilqr"], U0)
    assert table.index.names == ["solver", "element"] and len(table) == 6
    for name in ("hold", "al_ilqr"):
        alone = torchgco.solve(problem, U0, solver=name).to_frame(problem)
        assert table.loc[name, list(alone.columns)].equals(alone)
        assert (table.loc[name, "seconds"] > 0).all()
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
