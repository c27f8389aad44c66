"""Controls of anybody's solver: read from any file, judged as a study judges its own."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

import torchgco
from tests.bombs import zipped
from torchgco import InputError, Layouts
from torchgco.experiments.referee.board import Scene, judged_page
from torchgco.experiments.referee.judge import judge_files
from torchgco.scenarios import concatenate

DATA = Path(__file__).parents[2] / "benchmarks" / "data"
COUNT, N, M = 3, 200, 2
JUDGED = ["feasible", "reached", "success", "clear_95", "cost", "violation", "clearance", "clearance_knots"]
CERTIFIED = ["dynamics_residual", "clearance_full", "bound_violation", "kkt_residual", "step_error", "step_cost"]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first three layouts of planar_trap."""
    file = tmp_path_factory.mktemp("layouts") / "planar_trap.npz"
    Layouts.load(DATA / "planar_trap.npz").take(range(COUNT)).save(file)
    return file


@pytest.fixture(scope="module")
def U(path: Path) -> np.ndarray:
    task = Scene.read(path).vehicle.task(Layouts.load(path))
    return torchgco.solve(task.problem, task.U0, solver="interior_point").U.numpy()


def table_of(U: np.ndarray, **more: Any) -> pd.DataFrame:
    """The rows of a CSV file, a stage each."""
    layout, k = (index.ravel() for index in np.indices(U.shape[:2]))
    return pd.DataFrame({"layout": layout, "k": k, "u1": U[..., 0].ravel(), "u2": U[..., 1].ravel(), **more})


@pytest.mark.slow
def test_a_study_judged_by_its_controls_alone(run, path: Path, tmp_path: Path) -> None:
    words = ["scenario=layouts", f"scenario.path={path}", "model=planar", "solver=al_ilqr", "study.workers=1"]
    code, _, err = run(*words, "study.baselines=[interior_point]", "study.figures=false", "hydra.run.dir=flown")
    assert code == 0, err
    own = pd.read_parquet(tmp_path / "flown" / "trials.parquet")
    trials = judge_files(path, [tmp_path / "flown" / "solutions.npz"])
    assert trials[["solver", "layout", "scenario", "seed"]].equals(own[["solver", "layout", "scenario", "seed"]])
    assert trials["layout_digest"].equals(own["layout_digest"]) and own["feasible"].any()
    for name in JUDGED:
        assert trials[name].equals(own[name]), name
    for name in CERTIFIED[:3]:
        np.testing.assert_allclose(trials[name], own[name], atol=1e-12, err_msg=name)
    assert (trials["kkt_residual"].isna() == ~own["feasible"]).all()


@pytest.mark.slow
def test_an_npz_file_and_a_csv_file_of_the_same_controls_are_judged_alike(
    path: Path, U: np.ndarray, tmp_path: Path
) -> None:
    np.savez(tmp_path / "mine.npz", U=U, seconds=np.array([0.1, 0.2, 0.3]))
    rows = table_of(U, seconds=np.repeat([0.1, 0.2, 0.3], N)).sample(frac=1, random_state=0)
    rows.to_csv(tmp_path / "a file.csv", index=False)
    one, other = (judge_files(path, [tmp_path / name]) for name in ("mine.npz", "a file.csv"))
    assert set(one["solver"]) == {"mine"} and set(other["solver"]) == {"a file"}
    pd.testing.assert_frame_equal(one.drop(columns="solver"), other.drop(columns="solver"), rtol=0, atol=0)
    assert one["seconds"].tolist() == [0.1, 0.2, 0.3] and one["feasible"].all()
    verdict = torchgco.judge(Scene.read(path).vehicle.task(Layouts.load(path)).problem, torch.from_numpy(U))
    assert one["cost"].tolist() == verdict.cost.tolist()


def test_seconds_may_stand_in_one_row_of_a_layout(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    rows = table_of(U, seconds=np.nan).sample(frac=1, random_state=0)
    rows.loc[(rows["k"] == 0) & (rows["layout"] < 2), "seconds"] = [0.1, 0.1]
    rows.to_csv(tmp_path / "mine.csv", index=False)
    assert judge_files(path, [tmp_path / "mine.csv"])["seconds"].fillna(-1).tolist() == [0.1, 0.1, -1]


@pytest.mark.parametrize("word", ["study.layouts=1", "solver=gco", "seed=1", "scenario.path=other.npz", "+map=x"])
def test_words_without_an_effect_are_refused(word: str, path: Path) -> None:
    with pytest.raises(InputError, match="words that name a model or change it"):
        Scene.read(path, [word])


def test_a_csv_file_of_several_solvers(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    rows = pd.concat([table_of(U, solver="my solver, 2"), table_of(0 * U, solver="007")])
    rows.to_csv(tmp_path / "both.csv", index=False)
    np.savez(tmp_path / "my.npz", U=U)
    trials = judge_files(path, [tmp_path / "both.csv", tmp_path / "my.npz"])
    assert list(dict.fromkeys(trials["solver"])) == ["my solver, 2", "007", "my"]
    costs = trials.groupby("solver")["cost"].apply(list)
    assert costs["my solver, 2"] == costs["my"] != costs["007"] and set(trials["best_from"]) == {"file"}
    rows["solver"] = None
    rows.to_csv(tmp_path / "both.csv", index=False)
    with pytest.raises(InputError, match="one row per stage, got two for layout 0, k 0"):
        judge_files(path, [tmp_path / "both.csv"])


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", ["<f4", ">f8", ">f4", "<f2", "i4"])
def test_numbers_of_other_kinds_are_judged_as_they_are(kind: str, path: Path, U: np.ndarray, tmp_path: Path) -> None:
    given = np.nan_to_num(U).astype(kind)
    np.savez(tmp_path / "mine.npz", U=given)
    np.savez(tmp_path / "double.npz", U=given.astype(float))
    trials = [judge_files(path, [tmp_path / name]) for name in ("mine.npz", "double.npz")]
    pd.testing.assert_frame_equal(*(table.drop(columns="solver") for table in trials), rtol=0, atol=0)


@pytest.mark.slow
def test_what_is_missing_fails_alone(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    rows = table_of(U)
    rows[~((rows["layout"] == 1) & (rows["k"] == 7)) & (rows["layout"] != 2)].to_csv(tmp_path / "few.csv", index=False)
    np.savez(tmp_path / "some.npz", U=U[[2]], layout=[2])
    lost = U.copy()
    lost[0, 5, 1], lost[1, 3, 0] = np.nan, np.inf
    np.savez(tmp_path / "lost.npz", U=lost)
    trials = judge_files(path, [tmp_path / name for name in ("few.csv", "some.npz", "lost.npz")])
    whole = judge_files(path, [tmp_path / "few.csv"])
    status = trials.pivot(index="solver", columns="layout", values="status").loc[["few", "some", "lost"]]
    few, some, bad = status.to_numpy().tolist()
    assert few == ["FEASIBLE", "INCOMPLETE", "ABSENT"] and some == ["ABSENT", "ABSENT", "FEASIBLE"]
    assert bad == ["NON_FINITE", "NON_FINITE", "FEASIBLE"]
    assert not trials.loc[trials["status"] != "FEASIBLE", ["feasible", "reached"]].to_numpy().any()
    np.savez(tmp_path / "all.npz", U=U)
    every = judge_files(path, [tmp_path / "all.npz"])
    same = [*JUDGED[:2], *JUDGED[3:], *CERTIFIED]
    assert trials.loc[trials["status"] == "FEASIBLE", same].iloc[:1].equals(every[same].iloc[:1])
    assert len(whole) == COUNT and whole["status"].tolist() == ["FEASIBLE", "INCOMPLETE", "ABSENT"]


def test_layouts_of_different_lengths_need_no_controls_beyond_their_own(
    path: Path, U: np.ndarray, tmp_path: Path
) -> None:
    layouts = Layouts.load(path)
    file = tmp_path / "uneven.npz"
    replace(layouts, stages=np.array([N, N - 20, N])).save(file)
    rows = table_of(U)
    rows[(rows["layout"] != 1) | (rows["k"] < N - 20)].to_csv(tmp_path / "short.csv", index=False)
    np.savez(tmp_path / "long.npz", U=np.where(np.arange(N)[:, None] < N - 20, U[1], np.nan)[None], layout=[1])
    short, long = (judge_files(file, [tmp_path / name]) for name in ("short.csv", "long.npz"))
    assert (short["status"] != "INCOMPLETE").all() and long["status"][1] in ("FEASIBLE", "INFEASIBLE")
    assert short["cost"][1] == long["cost"][1] and np.isfinite(short["cost"]).all()


def test_a_free_time_needs_the_times_of_knots(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    file = tmp_path / "free.npz"
    replace(Layouts.load(path), free_time=np.array([0.2, 3.0, 1.0]), best_cost=None).save(file)
    dt = float(Layouts.load(path).dt or 0)
    np.savez(tmp_path / "timed.npz", U=U, times=np.tile(np.arange(N + 1) * dt, (COUNT, 1)))
    table_of(U, dt=dt).to_csv(tmp_path / "timed too.csv", index=False)
    one, other = (judge_files(file, [tmp_path / name]) for name in ("timed.npz", "timed too.csv"))
    np.testing.assert_allclose(one["duration"], N * dt)
    np.testing.assert_allclose(one["cost"], other["cost"], rtol=1e-12)
    late = np.tile(np.arange(N + 1) * dt, (COUNT, 1))
    late[0], late[1, 7], late[2] = np.nan, np.nan, -late[2]
    np.savez(tmp_path / "late.npz", U=U, times=late)
    trials = judge_files(file, [tmp_path / "late.npz"])
    assert trials["status"].tolist() == ["ABSENT", "INCOMPLETE", "INFEASIBLE"] and not trials["feasible"].any()
    np.savez(tmp_path / "bare.npz", U=U)
    with pytest.raises(InputError, match="times, as the time is free"):
        judge_files(file, [tmp_path / "bare.npz"])
    with pytest.raises(InputError, match="no times: the time is given"):
        judge_files(path, [tmp_path / "timed.npz"])


class Planted:
    """Python that would run if a pickle were read."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.mark),)


def pickled(file: Path) -> None:
    np.savez(file, U=np.array([Planted(file.parent / "ran")], dtype=object))


WRONG: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "no file": ("none.npz", lambda file: None, "an npz or CSV file, got none"),
    "a folder": ("folder.npz", os.mkdir, "no regular file"),
    "a device": ("zero.npz", lambda file: file.symlink_to("/dev/zero"), "no regular file"),
    "a pipe": ("pipe.csv", os.mkfifo, "no regular file"),
    "no zip": ("text.npz", lambda file: file.write_text("hello"), "a readable npz file without pickles"),
    "cut": ("cut.npz", lambda file: file.write_bytes(zipped("U.npy", 100)[:60]), "a readable npz file"),
    "pickles": ("objects.npz", pickled, "with Python objects"),
    "a bomb": ("bomb.npz", lambda file: file.write_bytes(zipped("U.npy", 4 * 10**9)), "arrays of 4 GB"),
    "no U": ("x.npz", lambda file: np.savez(file, times=np.zeros(3)), "an array U, got only times"),
    "another array": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, N, M)), second=1), "names U, solver"),
    "complex": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, N, M), complex)), "U of numbers, got complex128"),
    "text": ("x.npz", lambda file: np.savez(file, U=np.full((3, N, M), "1")), "U of numbers"),
    "truths": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, N, M), bool)), "U of numbers, got bool"),
    "stages": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, N - 1, M))), r"U \(3, 200, 2\), got \(3, 199, 2\)"),
    "axes": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, M, N))), r"got \(3, 2, 200\)"),
    "too many": ("x.npz", lambda file: np.savez(file, U=np.zeros((4, N, M))), r"got \(4, 200, 2\)"),
    "unnamed": ("x.npz", lambda file: np.savez(file, U=np.zeros((2, 3, N, M))), r"U \(1, 3, 200, 2\)"),
    "other layouts": ("x.npz", lambda file: np.savez(file, U=np.zeros((1, N, M)), layout=[7]), "got layout 7"),
    "twice": ("x.npz", lambda file: np.savez(file, U=np.zeros((2, N, M)), layout=[1, 1]), "each once"),
    "fractions": ("x.npz", lambda file: np.savez(file, U=np.zeros((1, N, M)), layout=[0.5]), "whole numbers"),
    "no name": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, N, M)), solver=" "), "of 1 to 64 letters"),
    "negative time": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, N, M)), seconds=[0, -1, 1]), "got -1 of x"),
    "no time": ("x.npz", lambda file: np.savez(file, U=np.zeros((3, N, M)), seconds=[0, np.inf, 1]), "got inf of x"),
    "empty": ("x.csv", lambda file: file.write_text(""), "a readable npz file without pickles, or a CSV file"),
    "heads alone": ("x.csv", lambda file: file.write_text("layout,k,u1,u2\n"), "a row per stage, got no rows"),
    "no column": ("x.csv", lambda file: file.write_text("layout,k,u1\n0,0,1\n"), "none called u2"),
    "a column more": ("x.csv", lambda file: file.write_text("layout,k,u1,u2,u3\n0,0,1,1,1\n"), "columns among"),
    "no number": ("x.csv", lambda file: file.write_text("layout,k,u1,u2\n0,0,1,1\n0,1,a,1\n"), "got 'a' in line 3"),
    "half a stage": ("x.csv", lambda file: file.write_text("layout,k,u1,u2\n0,0.5,1,1\n"), "whole numbers in column k"),
    "no layout": ("x.csv", lambda file: file.write_text("layout,k,u1,u2\n,0,1,1\n"), "whole numbers in column layout"),
    "far layouts": ("x.csv", lambda file: file.write_text("layout,k,u1,u2\n9,0,1,1\n"), "got layout 9"),
    "beyond": ("x.csv", lambda file: file.write_text(f"layout,k,u1,u2\n0,{N},1,1\n"), "k from 0 to 199, got 200"),
    "repeated": ("x.csv", lambda file: file.write_text("layout,k,u1,u2\n0,3,1,1\n0,3,1,1\n"), "two for layout 0, k 3"),
    "unlike seconds": (
        "x.csv",
        lambda file: file.write_text("layout,k,u1,u2,seconds\n1,0,1,1,2\n1,1,1,1,3\n"),
        "2 and 3 for layout 1",
    ),
    "packed": ("x.csv", lambda file: file.write_bytes(b"\x1f\x8b" + bytes(50)), "CONTROLS: expected"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_files_are_one_line(case: str, path: Path, tmp_path: Path) -> None:
    name, make, told = WRONG[case]
    make(tmp_path / name)
    with pytest.raises(InputError, match=told) as error:
        judge_files(path, [tmp_path / name])
    assert "\n" not in str(error.value) and not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_many_names_take_no_memory_before_they_are_refused(path: Path, tmp_path: Path) -> None:
    """A line for each of 600,000 solvers would make arrays of 1.7 TB."""
    lines = "\n".join(f"0,0,1,1,{i}" for i in range(600_000))
    (tmp_path / "many.csv").write_text(f"layout,k,u1,u2,solver\n{lines}\n")
    with pytest.raises(InputError, match="controls of 600000 solvers"):
        judge_files(path, [tmp_path / "many.csv"])


def test_two_solvers_of_one_name_are_refused(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        np.savez(tmp_path / folder / "mine.npz", U=U)
    with pytest.raises(InputError, match="another name for each solver"):
        judge_files(path, [tmp_path / "a" / "mine.npz", tmp_path / "b" / "mine.npz"])


def test_extreme_controls_fail_alone(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    extreme = U.copy()
    extreme[0], extreme[1] = 1e300, -1e-320
    np.savez(tmp_path / "extreme.npz", U=extreme)
    np.savez(tmp_path / "all.npz", U=U)
    trials, whole = (judge_files(path, [tmp_path / name]) for name in ("extreme.npz", "all.npz"))
    assert not trials["feasible"][0] and trials["feasible"][1] and not trials["reached"][:2].any()
    assert trials[JUDGED].iloc[2].equals(whole[JUDGED].iloc[2]) and "INFEASIBLE" in judged_page(trials)


def test_layouts_that_are_numbered_otherwise(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    layouts = Layouts.load(path)
    turned = concatenate([layouts.take([2]), layouts.take([0])])
    turned.save(tmp_path / "planar_trap.npz")
    np.savez(tmp_path / "mine.npz", U=U[[0, 2]], layout=np.array([0, 2]))
    np.savez(tmp_path / "all.npz", U=U)
    trials = judge_files(tmp_path / "planar_trap.npz", [tmp_path / "mine.npz"])
    whole = judge_files(path, [tmp_path / "all.npz"])
    assert trials["layout"].tolist() == [2, 0] and trials["cost"].tolist() == whole["cost"].iloc[[2, 0]].tolist()
    assert trials["layout_digest"].tolist() == whole["layout_digest"].iloc[[2, 0]].tolist()


@pytest.mark.slow
def test_the_model_is_that_with_as_many_states(path: Path, U: np.ndarray, tmp_path: Path) -> None:
    assert Scene.read(path).vehicle.name == "planar" and Scene.read(DATA / "walls.npz").vehicle.name == "quadrotor"
    wide = Scene.read(path, ["model.vehicle.control_weight=[5,5]"])
    np.savez(tmp_path / "mine.npz", U=U)
    usual, changed = (scene.judged(scene.controls(tmp_path / "mine.npz")) for scene in (Scene.read(path), wide))
    assert (usual["cost"] != changed["cost"]).all() and (usual["layout_digest"] != changed["layout_digest"]).all()
    with pytest.raises(InputError, match=r"layouts\.start: expected"):
        Scene.read(path, ["model=unicycle"]).judged([])
    centers, start = np.full((1, 1, 2), np.nan), np.zeros((1, 9))
    Layouts(centers, np.full((1, 1), np.nan), start=start).save(tmp_path / "nine.npz")
    with pytest.raises(InputError, match="model: expected model=planar or"):
        Scene.read(tmp_path / "nine.npz")
