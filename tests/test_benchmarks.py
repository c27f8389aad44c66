"""The smallest benchmarks: every section gives complete rows, and the tables are rewritten in place."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.families import oracle, quality
from benchmarks.lib import acados
from benchmarks.lib.families import FAMILIES
from benchmarks.lib.page import SET_UP, put_table
from benchmarks.lib.provenance import provenance
from benchmarks.speed import (
    batch,
    families,
    first_solve,
    first_use,
    growth,
    latency,
    mppi,
    own_model,
    paper,
    share,
    targets,
)
from benchmarks.speed.__main__ import main
from benchmarks.speed.bench import Bench
from benchmarks.speed.quadrotor_mppi import QuadrotorAmongSpheres
from benchmarks.speed.results import COLUMNS, Results, Row, read_rows
from benchmarks.speed.sizes import Sizes
from benchmarks.speed.tables import SPEED, TARGETS, rewrite, section_table
from torchgco import compose
from torchgco.base.errors import InputError
from torchgco.experiments import app
from torchgco.experiments.flying import study
from torchgco.native import engine as native_engine
from torchgco.scenarios import Layouts

ROOT = Path(__file__).resolve().parents[1]
TINY = Sizes(
    families=("forest30",), family_batch=2, large_batch=None, layouts=1, ipopt_layouts=1, ipopt_families=("forest30",),
    latency_layouts=1, own_layouts=1, paper_layouts=1, models=1,
    whole_batches=(), limited_batches=(2,), fewest_layouts=2,
    growth_batch=2, stages=(6,), obstacles=(3,), samples=(16,), mppi_repeats=1,
    share_batch=2, num_stages=8, inner_iterations=2,
)  # fmt: skip


@pytest.fixture(autouse=True)
def few_processes(monkeypatch) -> None:
    """Run the measurements of `first_use` in this process: a fixed number per import, a first solve per model."""

    def started(words: list[str], environment: dict[str, str]) -> str:
        return "1.5" if words[0] == "-c" else json.dumps(first_solve.measure(words[-1]))

    monkeypatch.setattr(first_use, "_started", started)


@pytest.fixture(autouse=True)
def without_acados(monkeypatch, tmp_path: Path) -> None:
    """Hide an installed acados: it compiles for seconds, and tests/test_speed_peers.py tests it."""
    monkeypatch.setattr(acados, "ENVIRONMENT", tmp_path)


@pytest.fixture
def studies_here(monkeypatch) -> None:
    """Run the studies of `quality` in this process, without figures."""

    def started(command: list[str], cwd: Path, **_: object) -> None:
        assert command[:3] == [sys.executable, "-m", "torchgco"]
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(sys, "argv", command[2:])
        assert app.main() == 0

    monkeypatch.setattr(quality, "subprocess", SimpleNamespace(run=started, DEVNULL=subprocess.DEVNULL))
    monkeypatch.setattr(study, "write_report", lambda folder, trajectories, figures: "")


def tiny(folder: Path) -> Bench:
    return Bench(TINY, Results(folder / "results.csv"), provenance("cpu"), say=lambda text: None)


def numbers(bench: Bench, quantity: str) -> list[float]:
    return [float(row["value"]) for row in bench.results.rows if row["quantity"] == quantity]


@pytest.mark.parametrize(
    "section", [batch, families, first_use, growth, latency, mppi, own_model, paper, share, targets]
)
def test_a_section_gives_whole_rows(section, tmp_path: Path) -> None:
    bench = tiny(tmp_path)
    section.run(bench)
    rows = bench.results.rows
    assert rows and {row["section"] for row in rows} == {section.SECTION}
    assert not any(row["quantity"].startswith(("left out", "ended with")) for row in rows)
    assert all(row["quantity"] and row["case"] and row["solver"] and row["commit"] for row in rows)
    with (tmp_path / "results.part.csv").open(newline="") as file:
        assert list(csv.DictReader(file)) == rows  # each row is written when it is measured
    for case, solver in {(row["case"], row["solver"]) for row in rows}:
        assert f"| {case} | `{solver}` |" in section_table(rows)


def test_ratios_are_those_of_their_rows(tmp_path: Path) -> None:
    bench = tiny(tmp_path)
    families.run(bench)
    seconds = {r["solver"]: float(r["value"]) for r in bench.results.rows if r["quantity"] == "seconds per problem"}
    assert set(seconds) == {"gco", "fatrop", "fatrop_guided", "ipopt"}
    ratios = {r["ratio"]: float(r["value"]) for r in bench.results.rows if r["quantity"] == "seconds, ratio"}
    for peer in set(seconds) - {"gco"}:
        assert ratios[f"{peer} / gco"] == pytest.approx(seconds[peer] / seconds["gco"], rel=1e-4)
    assert [r["case"] for r in bench.results.rows if r["quantity"] == "not installed"] == ["forest30"]


def test_shares_add_up(tmp_path: Path) -> None:
    """By phase, by native function, and in total. Afterwards the functions patched for the timers are restored."""
    run = native_engine.run
    bench = tiny(tmp_path)
    share.run(bench)
    assert native_engine.run is run
    rows = [row for row in bench.results.rows if row["case"] == "forest30, B = 2" and row["unit"] == "%"]
    sums = {row["solver"]: float(row["value"]) for row in rows if row["quantity"] == "sum"}
    assert sums.pop("all") == pytest.approx(100, abs=0.1) and sum(sums.values()) == pytest.approx(100, abs=0.1)
    for phase in sums:
        parts = [float(row["value"]) for row in rows if row["solver"] == phase and row["quantity"] != "sum"]
        assert sum(parts) == pytest.approx(sums[phase], abs=0.1)
    assert {"tgco_ilqr", "tgco_value"} <= {row["quantity"] for row in rows if row["solver"] == "all"}


def test_the_targets_are_read_off_the_rows(tmp_path: Path) -> None:
    """Rows of this run come before kept ones; a row from another commit names that commit."""
    path = tmp_path / "results.csv"
    former = Results(path)
    for section, value in (("mppi", "3"), ("paper", "7.25")):
        row = {**row_of(section, value), "commit": "0000000"}
        names = {
            "mppi": ("S = 1000", "torchgco", mppi.RATIO),
            "paper": ("planar_trap_paper, N = 1000, B = 8", "gco_paper", "all"),
        }
        former.add({**row, **dict(zip(("case", "solver", "quantity"), names[section], strict=True))})
        former.finish(section, "cpu")
    bench = Bench(TINY, Results(path), {**provenance("cpu"), "commit": "1111111"}, say=lambda text: None)
    bench.row("mppi", "S = 1000", "torchgco", mppi.RATIO, 21.04)
    targets.run(bench)
    values = {(row["case"], row["quantity"]): row["value"] for row in bench.results.rows}
    assert values["one round of MPPI, S = 1000", "pytorch-mppi"] == "21 x"
    assert values["walls, B = 32", "time"] == "not measured"
    assert values["planar_trap_paper, N = 1000, all of 8 problems", "time"] == "7.2 s (at 0000000)"
    assert [case for case, quantity in values if quantity == "time"] == [target.case for target in targets.TARGETS]


def test_a_solver_that_takes_too_long_is_left_out_and_named(tmp_path: Path) -> None:
    bench = tiny(tmp_path)
    bench.deadline = 0.0
    families.run(bench)
    assert [row["quantity"] for row in bench.results.rows] == ["left out: would take"]


def test_the_model_for_pytorch_mppi_equals_the_planners(tmp_path: Path) -> None:
    setup = Bench(TINY).setup("scenario=forest")
    problem = setup.task(setup.layouts(1)).problem
    model = QuadrotorAmongSpheres(problem, 1e8)
    x = problem.x0 + 3 * torch.randn(200, 14, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u = torch.linspace(-3, 9, 800, dtype=torch.float64).view(200, 4)
    after = model.dynamics(x.float(), u.float())
    torch.testing.assert_close(after.double(), problem.dynamics.step(x, u), rtol=1e-4, atol=1e-4)
    spheres = problem.constraints[0]
    inside = (x[:, None, :3] - spheres.centers[0]).norm(dim=-1) < spheres.inflated_radii[0]
    assert bool(inside.any()) and torch.equal(model.hits(x.float()).long(), inside.sum(1))
    cost = model.running_cost(x.float(), u.float()).double() - 1e8 * inside.sum(1)
    clear = ~inside.any(1)  # a collision's 1e8 would swallow the digits of the cost
    torch.testing.assert_close(cost[clear], problem.cost.stage(x, u, 0)[clear], rtol=1e-4, atol=1e-3)


def row_of(section: str, value: str, device: str = "cpu") -> Row:
    given = {"section": section, "case": "B = 2", "solver": "gco", "quantity": "time", "value": value, "unit": "s"}
    return {**dict.fromkeys(COLUMNS, ""), **given, "device": device}


def test_a_finished_section_replaces_its_former_rows_and_no_others(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    runs = (("mppi", "1", "cpu"), ("share", "2", "cpu"), ("mppi", "3", "cuda"), ("mppi", "4", "cpu"))
    for section, value, device in runs:
        results = Results(path)
        results.add(row_of(section, value, device))
        results.finish(section, device)
    Results(path).add(row_of("share", "5"))  # stopped before finish
    assert sorted(row["value"] for row in read_rows(path)) == ["2", "3", "4"]


def test_the_tables_are_rewritten_in_place(tmp_path: Path) -> None:
    readme, page = tmp_path / "README.md", tmp_path / "results" / "speed.md"
    page.parent.mkdir()
    for file, (begin, end) in ((readme, TARGETS), (page, SPEED)):
        file.write_text(f"before\n{begin}\nold\n{end}\nafter\n")
    rows = [row_of(*words) for words in (("mppi", "0.12345"), ("share", "1234.4"), ("mppi", "7", "cuda"))]
    rows.append(row_of("targets", "39 x FATROP"))
    rewrite(tmp_path, rows)
    first, second = readme.read_text(), page.read_text()
    rewrite(tmp_path, rows)
    assert (readme.read_text(), page.read_text()) == (first, second)
    for text, (begin, end) in ((first, TARGETS), (second, SPEED)):
        assert text.startswith(f"before\n{begin}\n") and text.endswith(f"{end}\nafter\n") and "old" not in text
    assert "39 x FATROP" in first and "39 x FATROP" not in second
    assert "| 0.123 |" in second and "| 1234 |" in second and "## Speed on a GPU" in second
    page.write_text("no marks")
    with pytest.raises(ValueError):
        rewrite(tmp_path, rows)


def test_the_published_page_matches_the_published_rows(tmp_path: Path) -> None:
    folder, pages = ROOT / "benchmarks", ("README.md", "results/speed.md")
    (tmp_path / "results").mkdir()
    for page in pages:
        (tmp_path / page).write_text((folder / page).read_text())
    rewrite(tmp_path, read_rows(folder / "results" / "speed.csv"))
    assert [(tmp_path / page).read_text() for page in pages] == [(folder / page).read_text() for page in pages]


def test_without_a_gpu_nothing_is_measured(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr("benchmarks.speed.__main__._one_core", lambda: None)
    assert main(["--device", "cuda", "--results", str(tmp_path / "results.csv")]) == 0
    assert "No CUDA device" in capsys.readouterr().out and not (tmp_path / "results.csv").exists()


@pytest.mark.parametrize("search", oracle.SEARCH)
def test_every_search_of_the_oracle_is_a_solver(search: str) -> None:
    compose(oracle.SEARCH[search])


def test_the_oracle_only_ever_lowers_a_cost(tmp_path: Path) -> None:
    path, nan = tmp_path / "layouts.npz", float("nan")
    replace(Layouts.load(ROOT / "benchmarks/data/planar_random.npz").take([0, 1, 2]), best_cost=None).save(path)
    for costs, best in (
        ([500.0, nan, nan], [500.0, nan, nan]),
        ([600.0, 300.0, nan], [500.0, 300.0, nan]),
        ([400.0, nan, nan], [400.0, 300.0, nan]),
    ):
        oracle.keep(path, np.array(costs), "here")
        np.testing.assert_array_equal(Layouts.load(path).best_cost, best)


@pytest.mark.usefixtures("studies_here")
def test_the_oracle_keeps_drawn_layouts_and_success_is_judged_for_them(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("benchmarks.lib.families.DATA", tmp_path)
    monkeypatch.setattr(oracle, "SEARCH", {"hold": ["solver=hold"]})
    words = ["--families", "planar_random", "--fresh", "2", "--seed", "7"]
    for _ in range(2):  # the second call finds the file
        assert oracle.main([*words, "--search", "hold"]) == 0
    family = FAMILIES["planar_random"]
    drawn = Layouts.load(family.file(2, 7))
    np.testing.assert_array_equal(drawn.centers, compose(family.overrides(3, 7)).layouts(2).centers)
    assert drawn.best_cost is None  # a vehicle that holds still never arrives
    with pytest.raises(InputError, match="fresh: expected the layouts that"):
        oracle.held(family, 3, 7)
    oracle.keep(family.file(2, 7), np.array([100.0, np.nan]), "here")
    flown = ["--solvers", "hold", "--outputs", str(tmp_path / "quality"), "study.workers=1"]
    assert quality.main(["--families", "planar_random", "--fresh", "3", "--seed", "7", *flown]) == 0
    assert "| 0 of 1 [0, 79] |" in capsys.readouterr().out


def test_no_best_cost_is_above_a_peers() -> None:
    for family in FAMILIES.values():
        best, theirs = Layouts.load(family.file()).best_cost, oracle.reference(family)
        assert best is not None and not bool((best > theirs).any())


@pytest.mark.slow
def test_the_quality_of_one_family(tmp_path: Path, capsys) -> None:
    words = ["--families", "planar_trap", "--solvers", "hold", "--fresh", "3", "--outputs", str(tmp_path)]
    assert quality.main([*words, "study.workers=1"]) == 0
    row = capsys.readouterr().out.splitlines()[-1].split(" | ")
    assert row[0] == "| planar_trap" and row[1:4] == ["`hold`", "3", "3 [44, 100]"] and row[4] == "0 [0, 56]"


@pytest.mark.usefixtures("studies_here")
def test_success_is_judged_with_the_current_best_cost(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("benchmarks.lib.families.DATA", tmp_path)
    family = FAMILIES["planar_trap"]
    layouts = Layouts.load(ROOT / "benchmarks/data/planar_trap.npz").take([0, 1])
    layouts.save(family.file())
    arguments = quality._parser().parse_args(["--solvers", "hold", "--outputs", str(tmp_path / "quality")])
    arguments.overrides = ["study.layouts=2", "study.workers=1"]
    flown = quality.fly(family, arguments)
    assert flown["solver"].unique().tolist() == ["hold"] and not flown["success"].any()
    lower = replace(layouts, best_cost=0.9 * layouts.best_cost)
    lower.save(family.file())
    again = quality.fly(family, arguments)  # a finished study may be judged again
    np.testing.assert_array_equal(again["best_cost"], lower.best_cost)
    there = flown.assign(reached=True, violation=[0.0, 2e-3], clearance=0.1, cost=flown["best_cost"])
    assert quality.succeeded(there, layouts)["success"].tolist() == [True, False]
    assert quality.succeeded(there, lower)["success"].tolist() == [False, False]


def test_the_generators_draw_the_families_of_the_files() -> None:
    """Fresh layouts have as many obstacles as the files' layouts, of the same size, and the same start and goal."""
    for family in FAMILIES.values():
        drawn, held = compose(family.overrides(fresh=2)).layouts(), Layouts.load(family.file())
        task, other = (compose(family.overrides(fresh=f)).task(layouts) for f, layouts in ((2, drawn), (0, held)))
        assert (task.problem.N, task.goal_radius) == (other.problem.N, other.goal_radius)
        torch.testing.assert_close(task.problem.x0[0], other.problem.x0[0])
        np.testing.assert_allclose(np.nanmax(drawn.radii), np.nanmax(held.radii))
        if family.name != "walls":
            assert drawn.centers.shape[1:] == held.centers.shape[1:]


def test_a_table_replaces_the_one_between_the_marks_of_its_page(tmp_path: Path) -> None:
    page = tmp_path / "maze.md"
    page.write_text("before\n<!-- maze -->\nold\n<!-- end maze -->\nafter\n")
    put_table(page, "64 starts, seed 0", "| new |", "CasADi", SET_UP)
    text = page.read_text()
    origin = provenance("cpu")
    first = (
        f"Measured on {origin['date']} at commit {origin['commit']}, 64 starts, seed 0, {origin['processor']}, shared"
    )
    assert f"<!-- maze -->\n{first}; CasADi {origin['casadi']}; set-up excluded.\n\n| new |\n" in text
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    empty = tmp_path / "barn.md"
    empty.write_text("no marks\n")
    with pytest.raises(ValueError, match="no part between"):
        put_table(empty, "", "")
