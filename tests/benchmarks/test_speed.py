"""The smallest benchmarks of speed: every section gives complete rows, and the tables are rewritten in place."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import torch

from benchmarks.lib import ROOT, acados
from benchmarks.lib.provenance import provenance
from benchmarks.speed import (
    batch,
    cores,
    families,
    first_use,
    growth,
    latency,
    learned,
    loop,
    mppi,
    own_model,
    paper,
    scaling,
    share,
    targets,
)
from benchmarks.speed.bench import Bench
from benchmarks.speed.peers import CasADiPeer
from benchmarks.speed.quadrotor_mppi import QuadrotorAmongSpheres
from benchmarks.speed.results import COLUMNS, Results, Row, read_rows
from benchmarks.speed.sizes import Sizes
from benchmarks.speed.tables import rewrite, section_table
from torchgco.native import engine as native_engine

TINY = Sizes(
    families=("forest30",), family_batch=2, large_batch=None, layouts=1, ipopt_layouts=1, ipopt_families=("forest30",),
    latency_layouts=1, loop_periods=9, loop_disturbed=7, loop_fleets=(2,), loop_compiled=False,
    own_layouts=1, own_models=1, training_steps=2, paper_layouts=1, models=1,
    whole_batches=(), limited_batches=(2,), fewest_layouts=2,
    world_batch=0, cores_batch=2, growth_batch=2, peers_layouts=1, stages=(6,), obstacles=(30,),
    samples=(16,), mppi_repeats=1,
    share_batch=2, share_alone=2, num_stages=8, inner_iterations=2,
)  # fmt: skip


@pytest.fixture(autouse=True)
def few_processes(monkeypatch) -> None:
    """Run the measurements of `first_use` and `cores` in this process, with a fixed number per import."""

    def started(words: list[str], environment: dict[str, str]) -> str:
        return "1.5" if words[0] == "-c" else json.dumps(first_use.measure(words[-1]))

    monkeypatch.setattr(first_use, "started", started)
    monkeypatch.setattr(cores, "_started", lambda bench, threads: cores.measure(1, bench.sizes))


@pytest.fixture(autouse=True)
def without_acados(monkeypatch, tmp_path: Path) -> None:
    """Hide an installed acados: it compiles for seconds, and tests/benchmarks/test_acados.py tests it."""
    monkeypatch.setattr(acados, "ENVIRONMENT", tmp_path)


def tiny(folder: Path) -> Bench:
    return Bench(TINY, Results(folder / "results.csv"), provenance("cpu"), say=lambda text: None)


SLOW = batch, cores, families, first_use, growth, latency, learned, mppi, own_model, paper, scaling, share


@pytest.mark.filterwarnings("ignore::torchgco.ContactWarning")  # steps of sizes for tests are long
@pytest.mark.parametrize(
    "section",
    [
        loop,
        targets,
        *(pytest.param(section, marks=pytest.mark.slow) for section in SLOW),
    ],
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
    cases = {(row["case"], row["solver"]) for row in rows}
    several = len({solver for _, solver in cases}) > 1  # one solver has no column
    for case, solver in cases:
        assert (f"| {case} | `{solver}` |" if several else f"| {case} | ") in section_table(rows)


@pytest.mark.slow
def test_ratios_are_those_of_their_rows(tmp_path: Path) -> None:
    bench = tiny(tmp_path)
    families.run(bench)
    seconds = {r["solver"]: float(r["value"]) for r in bench.results.rows if r["quantity"] == "seconds per problem"}
    assert set(seconds) == {"gco", "fatrop", "fatrop_guided", "ipopt"}
    ratios = {r["ratio"]: float(r["value"]) for r in bench.results.rows if r["quantity"] == "seconds, ratio"}
    for peer in set(seconds) - {"gco"}:
        assert ratios[f"{peer} / gco"] == pytest.approx(seconds[peer] / seconds["gco"], rel=1e-4)
    assert [r["case"] for r in bench.results.rows if r["quantity"] == "not installed"] == ["forest30"]


@pytest.mark.slow
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
    assert {"tgco_outer", "tgco_gains"} <= {row["quantity"] for row in rows if row["solver"] == "all"}


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
    for file, name in ((readme, "targets"), (page, "speed")):
        file.write_text(f"before\n<!-- {name} -->\nold\n<!-- end {name} -->\nafter\n")
    rows = [row_of(*words) for words in (("mppi", "0.12345"), ("loop", "1234.4"), ("mppi", "7", "cuda"))]
    rows += [{**row_of("targets", "39 x"), "quantity": "FATROP"}, {**row_of("targets", "12 MiB"), "case": "memory"}]
    rewrite(tmp_path, rows)
    first, second = readme.read_text(), page.read_text()
    rewrite(tmp_path, rows)
    assert (readme.read_text(), page.read_text()) == (first, second)
    for text, name in ((first, "targets"), (second, "speed")):
        assert text.startswith(f"before\n<!-- {name} -->\n") and text.endswith(f"<!-- end {name} -->\nafter\n")
        assert "old" not in text
    assert "39 x" in first and "39 x" not in second and "12 MiB" not in first
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


@pytest.mark.slow
def test_one_stage_later_fatrop_continues_with_its_multipliers(tmp_path: Path) -> None:
    """As torchgco does beside it: to the same trajectory in fewer iterations."""
    bench = tiny(tmp_path)
    setup = bench.setup("scenario=forest")
    task = setup.task(setup.scenario.draw([0], setup.seed))
    solution = latency.WARM.prepare(task.problem).solve(task.problem, task.U0)
    following = latency._next(task, solution)
    fresh, warm = (
        CasADiPeer.ready(bench, "fatrop", following), latency.Continued.after(bench, task, solution, following)
    )  # fmt: skip
    for peer in (fresh, warm):
        peer.fly(bench)
    assert warm.iterations < fresh.iterations
    assert fresh.verdict is not None and warm.verdict is not None
    assert torch.allclose(warm.verdict.cost, fresh.verdict.cost, rtol=1e-4)
