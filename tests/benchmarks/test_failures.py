"""Causes of gco_paper's failures: derived from synthetic histories, and the smallest whole run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch

from benchmarks.causes import failures
from benchmarks.causes.failures import CAUSES, Witness, cause
from tests.problems import planar_batch
from torchgco import GCO, ILQR, MPPI, AugmentedLagrangian

PLAIN = dict(cost=1.0, violation=0.1, caught=True, near=2.0, deep=0.0, ends=0.1, moved=0.1, crosses=0.0)


def history(rounds: int = 4, **changes) -> pd.DataFrame:
    return pd.DataFrame({name: [value] * rounds for name, value in {**PLAIN, **changes}.items()})


@pytest.mark.parametrize(
    ("changes", "feasible", "name"),
    [
        (dict(caught=False), False, "no pair in contact"),
        (dict(caught=False, violation=0.0), True, "stopped in front"),
        (dict(near=0.2), False, "noise too weak"), (dict(deep=1.0), False, "guide infeasible"),
        (dict(ends=0.6), False, "guide stops"), (dict(moved=1.5), False, "guide changes"),
        (dict(crosses=1.0), False, "other class"), (dict(), False, "not in time"),
        (dict(deep=1.0, ends=0.6), False, "guide infeasible"),
    ],
)  # fmt: skip
def test_a_history_has_its_cause(changes: dict, feasible: bool, name: str) -> None:
    assert name in CAUSES and cause(history(**changes), feasible, 1.0) == name


def test_an_iterate_thrown_far_off_is_the_first_cause() -> None:
    flown = history(near=0.1)
    flown.loc[3, "cost"] = 6.0
    assert cause(flown, False, 1.0) == "diverged"


def test_only_the_last_outer_iterations_count() -> None:
    early = pd.concat([history(5, deep=1.0), history(3)], ignore_index=True)
    assert cause(early, False, 1.0) == "not in time"


def test_the_witness_changes_nothing() -> None:
    problem, U0 = planar_batch(B=3, N=25, obstacles=9, seed=4)
    guidance = GCO(sampler=MPPI(samples=20))
    solver = AugmentedLagrangian(inner=ILQR(max_iterations=4), guidance=guidance, max_outer_iterations=4)
    witness = Witness(guidance)
    seen, unseen = (replace(solver, guidance=g).solve(problem, U0, seed=2) for g in (witness, guidance))
    notes = pd.concat(witness.rows)
    assert torch.equal(seen.U, unseen.U)
    assert notes.groupby("id").size().tolist() == [3, 3, 3] and notes.near.notna().any()


def test_the_whole_run_at_its_smallest(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "failures.md").write_text("# Why\n<!-- failures -->\n<!-- end failures -->\n")
    whole = failures.compose
    quick = ["solver.max_outer_iterations=2", "solver.inner.max_iterations=2", "solver.guidance.sampler.samples=8"]
    monkeypatch.setattr(failures, "compose", lambda words: whole([*words, *quick]))
    assert failures.main(["--families", "planar_trap", "--first", "2", "--outputs", str(tmp_path)]) == 0
    text = (tmp_path / "failures.md").read_text()
    assert "| **not reached** |  | 2 of 2 |" in text and (tmp_path / "failures.png").stat().st_size > 5000
