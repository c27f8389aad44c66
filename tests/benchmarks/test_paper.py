"""The paper's figures are drawn, and show the samples that the solver drew."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.collections import LineCollection
from matplotlib.image import imread

from benchmarks.lib import RESULTS
from benchmarks.paper import __main__ as script
from benchmarks.paper import flights, missions, runs, tables
from torchgco.plotting import animation

STAGES = 80


@pytest.mark.slow
def test_the_planar_figures_and_the_table_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "DPI", 40)
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- table-A4 -->\nold\n<!-- end table-A4 -->\nafter\n")
    words = ["--parts", "planar", "--stages", str(STAGES), "--page", str(page), "--outputs", str(tmp_path / "out")]
    assert script.main(words) == 0
    pictures = sorted((tmp_path / "out").glob("*.png"))
    assert [path.stem for path in pictures] == [f"figure-{n}" for n in ("03", "04", "05", "A1", "A2", "A3")]
    shown = (RESULTS / "paper.md").read_text() + (RESULTS.parents[1] / "docs" / "algorithm.md").read_text()
    for path in pictures:
        assert f"](paper/{path.name})" in shown
        assert (RESULTS / "paper" / path.name).stat().st_size < 200_000
        assert imread(path).std() > 0.01
    table, text = pd.read_csv(tmp_path / "out" / "table-A4.csv"), page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert list(table.cost_paper) == [1364.08, 1655.35]
    assert all(f"{cost:.2f}" in text for cost in table.cost)
    # The table's costs are those of the solver without a witness.
    assert table.cost[0] == pytest.approx(_cost(draws=0), rel=1e-12)


@pytest.mark.slow
def test_missions_and_animations_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "DPI", 40)
    monkeypatch.setattr(animation, "DPI", 30)
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- missions -->\nold\n<!-- end missions -->\nafter\n")
    words = ["--parts", "mission", "--duration", "0.2", "--page", str(page), "--outputs", str(tmp_path / "out")]
    assert script.main(words) == 0
    shown = (RESULTS / "paper.md").read_text() + (RESULTS.parents[1] / "docs" / "algorithm.md").read_text()
    limits = {"mission.gif": 1_500_000, "freeing.gif": 700_000}
    names = [f"figure-{n}.png" for n in ("08", "09", "10", "11", "12", "A4", "A5")]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted([*names, *limits, "missions.csv"])
    for name in (*names, *limits):
        assert f"paper/{name})" in shown
        assert (RESULTS / "paper" / name).stat().st_size < limits.get(name, 200_000)
        assert imread(tmp_path / "out" / name).std() > 0.01
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
    assert "| outcome | TIMEOUT | TIMEOUT | TIMEOUT |" in text
    rows = (tmp_path / "out" / "missions.csv").read_text().splitlines()
    assert {"control steps,4,4,4", "violation accepted in a new plan,any,any,0.01", "shifted plans,0,0,0"} < set(rows)


def test_the_papers_planners_have_nothing_of_the_librarys_own() -> None:
    for name in ("al_ilqr", "gco_paper", "gco"):
        planner, tracker = flights.mission_of(name, 1.0)[0].planner, flights.mission_of(name, 1.0)[0].tracker
        papers = (planner.multipliers, planner.tolerance, planner.margin, planner.margin_growth, planner.estimation)
        assert (papers == ("reset", np.inf, 0.0, 0.0, 0.0)) == (name != "gco")
        assert (tracker.multipliers == "reset" and tracker.inner.as_printed) == (name != "gco")


@pytest.mark.slow
def test_figures_of_a_mission_show_samples_medians_and_names() -> None:
    (part,) = flights.fly(["gco_paper"], 0.1)
    assert part.tolerance == np.inf and (part.frame["guided"] > 0).all()
    seconds = part.frame["planner_seconds"]
    (ax,) = missions.times([part]).axes
    assert ax.get_title(loc="left") == f"gco_paper: median of the planner {1e3 * seconds.median():.0f} ms"
    assert list(ax.get_yticks()) == [5, 10, 20, 50, 100]
    drawn = missions.snapshots(part).axes
    for ax, plane in zip(drawn[:2], ((0, 1), (0, 2)), strict=True):
        (samples,) = (lines for lines in ax.collections if isinstance(lines, LineCollection))
        expected = part.sampled[0].samples(missions.SAMPLES)[..., plane]
        assert np.array_equal(np.stack([path.vertices for path in samples.get_paths()]), expected)
    names = [[text.get_text() for text in ax.get_legend().get_texts()] for ax in missions.states(part).axes[3:]]
    assert names == [["x", "y", "z"], ["roll", "pitch", "yaw"], ["x", "y", "z"]]


@pytest.mark.slow
def test_samples_of_a_mission_belong_to_their_control_step() -> None:
    (part,) = flights.fly(["gco_paper"], 0.15)
    for step, call in enumerate(part.sampled):
        state = part.frame.loc[step, [f"x{i}" for i in range(13)]].to_numpy(dtype=float)
        assert np.allclose(call.problem.x0[0, :13].numpy(), state, rtol=0, atol=1e-12)  # a quaternion is normed again
        assert np.allclose(call.samples(2)[:, 0], np.stack([state[:3]] * 2), rtol=0, atol=1e-12)


def test_the_papers_tables_have_our_values() -> None:
    found = tables.tables()
    assert (RESULTS / "paper" / script.TABLES).read_text() == tables.frame(found).to_csv(index=False)
    assert {name.split(":")[0]: len(lines) for name, lines in found.items()} == {
        "Table 1": 9, "Table 2": 15, "Table 3": 13, "Table 4": 12, "Table 5": 14,
        "Table A1": 9, "Table A2": 6, "Table A3": 13,
    }  # fmt: skip
    unlike = [line.name for lines in found.values() for line in lines if not line.agrees]
    assert unlike == ["the same for collisions, 0.95 r_veh (m)"]  # 0.342, rounded in print


def test_a_line_agrees_only_with_equal_values() -> None:
    line = tables.Line
    assert line("", "", [1, 2.0], torch.tensor([[1.0, 2.0]])).agrees and line("", "", "a", "a").agrees
    assert not line("", "", [1, 2], [1, 2.1]).agrees and not line("", "", 1, [1, 1]).agrees
    assert not line("", "", 0, "shifted").agrees


def _cost(draws: int) -> float:
    size = [f"scenario.stages={STAGES}", f"scenario.dt={runs.HORIZON / STAGES}"]
    setup = runs.compose(["experiment=planar_trap_paper", *size, "device.threads=1"])
    task = setup.task(setup.layouts(1))
    return float(setup.solver.solve(task.problem, task.U0, seed=0, ids=torch.tensor([draws])).cost[0])


@pytest.mark.slow
def test_the_samples_shown_are_those_that_the_solver_averaged() -> None:
    solve = runs.planar("gco_paper", 0, STAGES)
    call = next(step.sampling for step in solve.steps if step.sampling is not None)
    sampler, problem = call.sampler, call.problem
    V = call.controls(sampler.samples)
    X = problem.x0.expand(sampler.samples, -1)
    S, spheres = torch.zeros(sampler.samples, dtype=X.dtype), problem.geometric[0]
    how = sampler.sampling(problem, call.key)
    noise = how.noise(problem, call.key, how.sigma.sqrt(), 0, range(sampler.samples)).eps
    states = [X]
    for k in range(problem.N):
        S = S + problem.cost.stage(X, V[:, k], k) + (call.U[:, k] / 100.0 * noise[k, 0]).sum(-1)
        X = problem.dynamics.step(X, V[:, k])
        states.append(X)
        S = S + 1e8 * ((X[:, None, :2] - spheres.centers[0]).norm(dim=-1) <= spheres.inflated_radii[0]).sum(-1)
    S = S + problem.cost.terminal(X)
    mean = (torch.softmax(S.min() - S, 0)[:, None, None] * V).sum(0)
    plan = problem.x0
    for k in range(problem.N):
        plan = problem.dynamics.step(plan, mean[None, k])
    torch.testing.assert_close(plan[0], call.plan[-1], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(
        torch.from_numpy(call.samples(5)), torch.stack(states, 1)[:5, :, :2], rtol=1e-9, atol=1e-9
    )


def test_a_cross_marks_knots_inside_an_inflated_obstacle_alone() -> None:
    solve = runs.planar("al_ilqr", 0, STAGES)
    marked = solve.infeasible(solve.positions)
    reach = 0.153 + 0.06
    for point, mark in zip(solve.positions, marked, strict=True):
        assert mark == any(((point - center) ** 2).sum() ** 0.5 < reach - 1e-3 for center in solve.centers)
    assert marked.any()
