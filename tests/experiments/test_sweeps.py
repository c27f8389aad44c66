"""Reports on runs that differ in layouts, settings or versions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tests.experiments.commands import TINY
from tests.trials import trials
from torchgco.experiments.reports.report import main
from torchgco.experiments.results.folder import read_manifest
from torchgco.experiments.results.identity import Manifest, digest, layout_digests
from torchgco.experiments.results.kinds import TRAJECTORIES
from torchgco.experiments.results.merge import merge
from torchgco.experiments.statistics.paired import compare
from torchgco.experiments.statistics.statistics import summarise
from torchgco.maps.distance import DistanceField
from torchgco.maps.grid import OccupancyGrid
from torchgco.scenarios import Layouts

HIT, MISS = True, False
LIMIT = {"gco": 20, "al_ilqr": 10, "ipopt": 1000}


def study(
    folder: Path,
    hits: Mapping[str, Sequence[bool]],
    obstacles: int = 10,
    seed: int = 0,
    solver: Mapping[str, Mapping[str, Any]] | None = None,
    scene: object = None,
    best_cost: float | None = None,
    manifest: bool = True,
    **more: Any,
) -> Path:
    """Write a finished study; `hits` gives per solver, in the study's order, the layouts that reached the goal.

    solver  settings per solver, in addition to its iteration limit
    scene   determines the layouts, together with the seed; by default the number of obstacles
    """
    settings = {name: {"limit": LIMIT[name], **(solver or {}).get(name, {})} for name in hits}
    scene = obstacles if scene is None else scene
    layouts = {i: digest([scene, seed, i]) for i in range(max(map(len, hits.values())))}
    rows = []
    for name, flown in hits.items():
        for i, hit in enumerate(flown):
            row = {"solver": name, "layout": i, "seed": seed, "reached": hit, "feasible": hit, "cost": 100.0 + i}
            known = {"success": pd.NA, "best_cost": np.nan, "best_from": None}
            if best_cost is not None or len(hits) > 1:
                best = 100.0 + i if best_cost is None else best_cost
                known = {"success": hit, "best_cost": best, "best_from": "file" if best_cost else "study"}
            digests = {"layout_digest": layouts[i], "settings_digest": digest(settings[name])}
            rows.append(row | known | digests | more)
    folder.mkdir(parents=True)
    trials(*rows).to_parquet(folder / "trials.parquet", index=False)
    if manifest:
        configuration = {
            "version": more.get("version", "0.1.0"),
            "seed": seed,
            "scenario": {"name": "forest", "num_obstacles": obstacles, "goal": [1, 2]},
            "model": {"vehicle": {"name": "quadrotor", "radius": 0.3}, "gco": {"samples": obstacles}},
            "device": {"name": "cpu", "dtype": more.get("dtype", "float64"), "kernels": "native", "threads": seed + 1},
            "study": {"layouts": len(layouts), "workers": seed + 1},
        }
        (folder / "study.json").write_bytes(Manifest(configuration, settings, layouts).to_json())
    return folder


def counts(table: pd.DataFrame, *columns: str) -> dict[tuple[Any, ...] | Any, tuple[int, int]]:
    """(reached, n) per combination of swept columns and solver."""
    summary = summarise(table)
    rows = summary.set_index([*columns, "solver"])[["reached_count", "n"]]
    return {key: tuple(row) for key, row in zip(rows.index, rows.to_numpy().tolist(), strict=True)}


def pairs(table: pd.DataFrame, *columns: str) -> list[tuple[Any, ...]]:
    """Swept columns, solvers, n and unmatched trials of every comparison by `reached`."""
    rows = compare(table).query("outcome == 'reached'")
    return list(rows[[*columns, "solver_a", "solver_b", "n", "unmatched"]].itertuples(index=False, name=None))


OBSTACLES = "scenario.num_obstacles"


def test_flights_on_different_layouts_are_never_paired(tmp_path) -> None:
    study(tmp_path / "a", {"gco": [HIT] * 4}, obstacles=5)
    study(tmp_path / "b", {"al_ilqr": [MISS] * 4}, obstacles=60)
    table = merge([tmp_path])
    assert counts(table, OBSTACLES) == {(5, "gco"): (4, 4), (60, "al_ilqr"): (0, 4)}
    assert pairs(table, OBSTACLES) == []
    text = TRAJECTORIES.text(summarise(table), compare(table))
    assert "num_obstacles  solver" in text and "gco - al_ilqr" not in text


def test_one_solver_on_different_scenes_has_a_row_for_each(tmp_path) -> None:
    study(tmp_path / "a", {"gco": [HIT] * 4}, obstacles=5)
    study(tmp_path / "b", {"gco": [HIT] * 4}, obstacles=60, seed=1)
    assert counts(merge([tmp_path]), OBSTACLES) == {(5, "gco"): (4, 4), (60, "gco"): (4, 4)}


def test_a_sweep_of_solvers_and_scenes_pairs_within_each_scene(tmp_path) -> None:
    """al_ilqr flies alone, and as the baseline of gco."""
    for number, reached in ((10, [HIT, MISS]), (30, [MISS, MISS])):
        study(tmp_path / f"al_ilqr{number}", {"al_ilqr": reached}, obstacles=number, seconds=9.0)
        study(tmp_path / f"gco{number}", {"gco": [HIT, HIT], "al_ilqr": reached}, obstacles=number)
    table = merge([tmp_path])
    assert list(counts(table, OBSTACLES).items()) == [
        ((10, "gco"), (2, 2)),
        ((10, "al_ilqr"), (1, 2)),
        ((30, "gco"), (2, 2)),
        ((30, "al_ilqr"), (0, 2)),
    ]
    assert pairs(table, OBSTACLES) == [(10, "gco", "al_ilqr", 2, 0), (30, "gco", "al_ilqr", 2, 0)]
    assert table.attrs["repeated"] == 4 and table["success"].notna().all()
    assert not [name for name in table.columns if name.startswith("_")]


def test_other_seeds_are_more_trials_of_the_same(tmp_path) -> None:
    for seed in range(3):
        study(tmp_path / str(seed), {"gco": [HIT] * 4, "al_ilqr": [MISS] * 4}, seed=seed)
    table = merge([tmp_path])
    assert counts(table) == {"gco": (12, 12), "al_ilqr": (0, 12)}
    assert pairs(table) == [("gco", "al_ilqr", 12, 0)]
    assert not [name for name in table.columns if "." in name]


def test_other_settings_of_a_solver_get_separate_rows(tmp_path) -> None:
    for limit, reached in ((10, [HIT, MISS]), (20, [HIT, HIT])):
        hits = {"gco": reached, "al_ilqr": [MISS, MISS]}
        study(tmp_path / str(limit), hits, solver={"gco": {"inner": {"samples": limit}}})
    table = merge([tmp_path])
    few, many = "gco [inner.samples=10]", "gco [inner.samples=20]"
    assert counts(table) == {few: (1, 2), many: (2, 2), "al_ilqr": (0, 2)}
    assert pairs(table) == [(few, many, 2, 0), (few, "al_ilqr", 2, 0), (many, "al_ilqr", 2, 0)]


def test_other_settings_with_equal_results_and_other_seeds_are_not_pooled(tmp_path) -> None:
    study(tmp_path / "a", {"gco": [HIT]}, solver={"gco": {"samples": 1}})
    study(tmp_path / "b", {"gco": [HIT]}, solver={"gco": {"samples": 2}})
    study(tmp_path / "c", {"gco": [HIT]}, solver={"gco": {"samples": 2}}, seed=1)
    assert counts(merge([tmp_path])) == {"gco [samples=1]": (1, 1), "gco [samples=2]": (2, 2)}


def test_an_option_of_a_row_of_a_solver_is_its_label(tmp_path) -> None:
    for name, top in (("a", 2), ("b", 3)):
        rows = [{"when": "all"}, {"top": top, "pace": [0.8, 0.6]}]
        study(tmp_path / name, {"gco": [HIT]}, solver={"gco": {"passes": rows}})
    assert counts(merge([tmp_path])) == {"gco [passes.1.top=2]": (1, 1), "gco [passes.1.top=3]": (1, 1)}


@pytest.mark.parametrize(
    ("key", "label"), [("version", "version"), ("dtype", "device.dtype"), ("device", "device.name")]
)
def test_versions_and_devices_get_separate_rows(key: str, label: str, tmp_path) -> None:
    for name in ("one", "two"):
        study(
            tmp_path / name,
            {"gco": [HIT]},
            **{key: name},
            cost=len(name),
            solver={"gco": {"new": name}} if key == "version" else None,
        )
    assert set(counts(merge([tmp_path]))) == {f"gco [{label}=one]", f"gco [{label}=two]"}


def test_settings_are_known_by_their_digest_where_a_manifest_is_lost(tmp_path) -> None:
    study(tmp_path / "a", {"gco": [HIT]})
    study(tmp_path / "b", {"gco": [HIT]}, seed=1, manifest=False)
    study(tmp_path / "c", {"gco": [HIT]}, seed=2, manifest=False, solver={"gco": {"samples": 3}})
    found = counts(merge([tmp_path]))
    assert sorted(found.values()) == [(1, 1), (2, 2)] and all(name.startswith("gco [") for name in found)


def test_a_file_that_moved_is_the_same_and_one_that_differs_gets_a_column(tmp_path) -> None:
    def flown(name: str, path: str, scene: str, solver: str) -> None:
        folder = study(tmp_path / name, {solver: [HIT]}, scene=scene)
        held = read_manifest(folder / "study.json")
        assert held is not None
        held.configuration["scenario"]["path"] = path
        (folder / "study.json").write_bytes(held.to_json())

    flown("a", "here/walls.npz", "walls", "gco")
    flown("b", "there/walls.npz", "walls", "al_ilqr")
    assert pairs(merge([tmp_path])) == [("gco", "al_ilqr", 1, 0)]
    flown("c", "elsewhere/walls.npz", "other walls", "ipopt")
    assert set(merge([tmp_path])["scenario.path"]) == {f"{name}/walls.npz" for name in ("here", "there", "elsewhere")}


def test_many_settings_make_a_short_label(tmp_path) -> None:
    for n in range(3):
        study(
            tmp_path / str(n),
            {"gco": [HIT]},
            solver={"gco": {"a": 0, "b": 0, "c": 0, "d": n, "e": n > 1, "f": n, "g": n}},
        )
    names = set(counts(merge([tmp_path])))
    assert len(names) == 3 and all("d=" in name and "1 more" in name and "a=" not in name for name in names)


def test_layouts_that_differ_without_a_reason_are_distinguished_by_folder(tmp_path) -> None:
    """As after a change of a layout file in place."""
    study(tmp_path / "a", {"gco": [HIT] * 2}, scene="old")
    study(tmp_path / "b", {"al_ilqr": [HIT] * 2}, scene="new")
    study(tmp_path / "c", {"ipopt": [HIT] * 2}, scene="old")
    table = merge([tmp_path])
    where = {row["solver"]: Path(row["hydra.run.dir"]).name for _, row in table.iterrows()}
    assert where == {"gco": "a", "al_ilqr": "b", "ipopt": "a"}
    assert [row[1:] for row in pairs(table, "hydra.run.dir")] == [("gco", "ipopt", 2, 0)]


def test_pairing_needs_the_same_layout_even_within_a_table() -> None:
    rows = [{"solver": "gco", "layout_digest": "one"}, {"solver": "al_ilqr", "layout_digest": "two"}]
    assert pairs(trials(*rows)) == [("gco", "al_ilqr", 0, 2)]


def test_success_is_judged_against_the_best_of_the_merged_table(tmp_path) -> None:
    study(tmp_path / "a", {"gco": [HIT, HIT], "al_ilqr": [HIT, HIT]})
    study(tmp_path / "b", {"ipopt": [HIT]}, cost=10.0)
    table = merge([tmp_path]).set_index(["solver", "layout"])
    assert table["best_cost"].to_dict() == {
        ("gco", 0): 10, ("gco", 1): 101, ("al_ilqr", 0): 10, ("al_ilqr", 1): 101, ("ipopt", 0): 10
    }  # fmt: skip
    cheap = {("ipopt", 0), ("gco", 1), ("al_ilqr", 1)}
    assert set(table.index[table["success"].astype(bool)]) == cheap


def test_a_best_cost_from_a_file_is_kept(tmp_path) -> None:
    study(tmp_path / "a", {"gco": [HIT]}, best_cost=98.0)
    study(tmp_path / "b", {"ipopt": [HIT]}, cost=10.0, best_cost=98.0)
    table = merge([tmp_path])
    assert set(table["best_cost"]) == {98.0} and table["success"].all()


@pytest.mark.slow
@pytest.mark.usefixtures("without_report")
def test_a_sweep_from_the_command_line(run, tmp_path, capsys) -> None:
    sweep = ["-m", "solver=hold,al_ilqr", "study.baselines=[hold]", "scenario.num_obstacles=2,3", *TINY[:4], TINY[5]]
    code, _, err = run(*sweep)
    assert code == 0, err
    assert main([str(tmp_path / "outputs")]) == 0
    table = pd.read_parquet(tmp_path / "outputs" / "report" / "trials.parquet")
    assert {key: n for key, (_, n) in counts(table, OBSTACLES).items()} == {
        (number, solver): 3 for number in (2, 3) for solver in ("al_ilqr", "hold")
    }
    assert pairs(table, OBSTACLES) == [(2, "al_ilqr", "hold", 3, 0), (3, "al_ilqr", "hold", 3, 0)]
    assert "6 rows left out" in capsys.readouterr().out


PLANE = {"start": [0, 0], "goal": [1, 1], "radius": 0.1, "goal_radius": 0.2, "stages": 5, "dynamics": {"drag": 1}}


def scene(**more: Any) -> Layouts:
    centers = np.array([[[0.5, 0.5], [np.nan, np.nan]], [[0.2, 0.2], [0.3, 0.3]]])
    return Layouts(centers, np.where(np.isnan(centers[:, :, 0]), np.nan, 0.1), **more)


def test_a_layout_digest_depends_only_on_what_is_flown() -> None:
    codes = layout_digests(scene(), PLANE)
    assert len(set(codes.values())) == 2
    assert layout_digests(scene().take([1]), PLANE) == {1: codes[1]}
    absent = np.full((2, 2, 2), np.nan)
    padded = Layouts(np.concatenate((scene().centers, absent), 1), np.concatenate((scene().radii, absent[..., 0]), 1))
    assert layout_digests(padded, PLANE) == codes, "absent obstacles do not count"
    assert layout_digests(scene(best_cost=np.ones(2)), PLANE) == codes
    assert layout_digests(scene(velocities=0 * scene().centers), PLANE) == codes
    assert layout_digests(scene(), PLANE | {"name": "other", "radius": 0.10, "stages": 5.0}) == codes
    assert layout_digests(scene(vehicle_radius=0.1), PLANE) == codes, "radius from the layouts or from the vehicle"
    assert layout_digests(scene(vehicle_radius=0.1), PLANE | {"radius": 7}) == codes, "layouts overrule the vehicle"


BOXED = {"box_centers": np.zeros((2, 1, 2)), "box_half_sizes": np.ones((2, 1, 2))}
SWINGING = BOXED | dict.fromkeys(("box_amplitudes", "box_rates", "box_phases"), np.ones((2, 1, 1, 2)))
FLEET = {"start": np.ones((2, 2, 2)), "goal": np.zeros((2, 2, 2)), "apart": 0.4}
GATED = {"gate_centers": np.ones((2, 1, 2)), "gate_radii": np.ones((2, 1))}
OTHERS = {
    "vehicle_radius": 0.2, "goal_radius": 0.3, "dt": 0.1, "stages": 6, "control_lower": [-1.0], "control_upper": [1.0],
    "start": np.ones(2), "goal": np.zeros(2), "velocities": np.ones((2, 2, 2)), "centers": scene().centers + 1.0,
    "radii": np.array([[0.3, np.nan], [0.3, 0.3]]), "box_radii": np.ones((2, 1)), "box_rotations": np.ones((2, 1)),
    "free_time": [0.5, 2.0, 1.0], "goal_required": True, "apart": 0.5,
    "map": DistanceField.of(OccupancyGrid(np.eye(3, dtype=bool), [0.0, 0.0], 0.1)),
    **{name: value + 1.0 for name, value in (SWINGING | GATED).items()},
}  # fmt: skip
OF_NO_FLIGHT = {"best_cost", "name", "ids"}


def test_boxes_make_another_layout_unless_absent() -> None:
    boxes = {"box_centers": np.zeros((2, 1, 2)), "box_half_sizes": np.ones((2, 1, 2))}
    absent = {name: np.full((2, 1, 2), np.nan) for name in boxes}
    turned = boxes | {"box_rotations": np.ones((2, 1))}
    plain, none, some, other = (layout_digests(scene(**more), PLANE) for more in ({}, absent, boxes, turned))
    assert plain == none and len({plain[0], some[0], other[0]}) == 3
    sharp, rounded = (layout_digests(scene(**boxes, box_radii=np.array([[r], [0.0]])), PLANE) for r in (0.0, 0.1))
    assert sharp == some and rounded[0] != some[0] and rounded[1] == some[1]


@pytest.mark.parametrize("field", sorted({f.name for f in fields(Layouts)} - OF_NO_FLIGHT))
def test_every_input_of_a_flight_changes_the_digest(field: str) -> None:
    boxes = field in ("box_radii", "box_rotations")
    groups = (FLEET,) if field == "apart" else (BOXED, SWINGING, GATED)
    plain = scene(**next((group for group in groups if field in group or boxes), {}))
    one, other = layout_digests(plain, PLANE), layout_digests(replace(plain, **{field: OTHERS[field]}), PLANE)
    assert not set(one.values()) & set(other.values())


def test_another_model_makes_another_layout() -> None:
    one, other = (layout_digests(scene(), PLANE | {"dynamics": {"drag": drag}}) for drag in (1, 2))
    assert not set(one.values()) & set(other.values())
