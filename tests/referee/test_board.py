"""The command `torchgco-judge`: tables, pages and leaderboards."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import torchgco
from tests.referee.boards import CARD, DATA, HOSTILE, SHAPES, board, enter
from torchgco import Layouts
from torchgco.experiments.referee import board as board_module
from torchgco.experiments.referee.board import Scene, leaderboard
from torchgco.experiments.referee.judge import main
from torchgco.experiments.referee.page import Board, Cell, page
from torchgco.experiments.reports.report import main as report

TAGS = {
    "html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "section", "label", "input", "span", "div",
    "table", "thead", "tbody", "tr", "th", "td", "button", "a", "footer", "script",
}  # fmt: skip


class Tags(HTMLParser):
    """The tags and attributes of a page, and the text of its cells."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: set[str] = set()
        self.texts: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def checked(html: str) -> list[str]:
    """The texts of a page that has no element of another origin."""
    read = Tags(html)
    assert set(read.tags) <= TAGS and read.tags.count("script") == 1 and read.tags.count("style") == 1
    assert not [name for name in read.attributes if name.startswith("on") or name == "src"]
    return read.texts


@pytest.fixture
def layouts(tmp_path: Path) -> Path:
    path = tmp_path / "planar_trap.npz"
    Layouts.load(DATA / "planar_trap.npz").take([0, 1]).save(path)
    return path


@pytest.mark.slow
def test_the_command_writes_tables_and_a_page(layouts: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "my controls").mkdir()
    task = Scene.read(layouts).vehicle.task(Layouts.load(layouts))
    np.savez(tmp_path / "my controls" / "best & <b>.npz", U=torchgco.solve(task.problem, task.U0).U.numpy())
    np.savez(tmp_path / "my controls" / "rest.npz", U=task.U0.numpy(), seconds=[0.5, np.nan])
    files = [str(tmp_path / "my controls" / name) for name in ("best & <b>.npz", "rest.npz")]
    for _ in range(2):  # the second time it is written again
        assert main([str(layouts), *files]) == 0
    out = capsys.readouterr().out
    assert "2/2 100 %" in out and "0/2 0 %" in out and "paired" in out
    folder = tmp_path / "my controls" / "judged"
    assert {path.name for path in folder.iterdir()} == {"trials.parquet", "summary.csv", "paired.csv", "judged.html"}
    assert not re.search(r"<b>", (folder / "judged.html").read_text())
    texts = checked((folder / "judged.html").read_text())
    assert texts.count("best & <b>") == 3 and texts.count("ABSENT") == 0 and "0.5" in texts
    assert main([str(layouts), files[1], "--format", "csv", "--output", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("trajectory,planar_trap,planar,rest,2,")


def test_a_page_of_many_layouts_shows_the_first(layouts: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(board_module, "SHOWN", 3)
    np.savez(tmp_path / "two.npz", U=np.zeros((2, *SHAPES["planar_trap"])), solver=["a", "b"])
    assert main([str(layouts), str(tmp_path / "two.npz")]) == 0
    html = (tmp_path / "judged" / "judged.html").read_text()
    assert "The first 3 of 4 rows of trials.parquet" in html and html.count("<tr><td>") == 2 + 3


def test_best_costs_of_another_file(layouts: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "rest.npz", U=np.zeros(SHAPES["planar_trap"]))
    np.savez(tmp_path / "best.npz", best_cost=[1.0, 2.0])
    assert main([str(layouts), str(tmp_path / "rest.npz"), "--best", str(tmp_path / "best.npz")]) == 0
    trials = pd.read_parquet(tmp_path / "judged" / "trials.parquet")
    assert trials["best_cost"].tolist() == [1.0, 2.0] and set(trials["best_from"]) == {"file"}
    np.savez(tmp_path / "best.npz", best_cost=[1.0])
    assert main([str(layouts), str(tmp_path / "rest.npz"), "--best", str(tmp_path / "best.npz")]) == 2


@pytest.mark.slow
def test_a_report_compares_foreign_controls_with_a_study(run, tmp_path: Path, capsys) -> None:
    (tmp_path / "data").mkdir()
    path = tmp_path / "data" / "planar_trap.npz"
    Layouts.load(DATA / "planar_trap.npz").take(range(3)).save(path)
    words = ["scenario=layouts", f"scenario.path={path}", "model=planar", "solver=interior_point", "study.workers=1"]
    code, _, err = run(*words, "study.baselines=[]", "study.figures=false", "hydra.run.dir=studies/own")
    assert code == 0, err
    with np.load(tmp_path / "studies" / "own" / "solutions.npz") as held:
        np.savez(tmp_path / "studies" / "theirs.npz", U=held["U"][0] * 0.5)
    assert main([str(path), str(tmp_path / "studies" / "theirs.npz")]) == 0
    capsys.readouterr()
    together = [str(tmp_path / "studies"), str(tmp_path / "studies" / "judged")]
    assert report([*together, "--output", str(tmp_path / "report")]) == 0
    (pair,) = pd.read_csv(tmp_path / "report" / "paired.csv").query("outcome == 'feasible'").to_dict("records")
    assert {pair["solver_a"], pair["solver_b"]} == {"interior_point", "theirs"} and pair["n"] == 3
    alone = torchgco.read(tmp_path / "studies")
    assert set(alone["solver"]) == {"interior_point"}, "it counts where its own folder is named"


@pytest.mark.parametrize(
    "words",
    [
        [], ["planar_trap.npz"], ["none.npz", "rest.npz"], ["planar_trap.npz", "rest.npz", "--best", "rest.npz"],
        ["planar_trap.npz", "rest.npz", "model=none"], ["planar_trap.npz", "rest.npz", "model.vehicle.nothing=1"],
        ["planar_trap.npz", "rest.npz", "--output", "rest.npz"], ["--board", "nowhere"], ["rest.npz", "rest.npz"],
        ["planar_trap.npz", "rest.npz", "--board", "."], ["planar_trap.npz", "rest.npz", "--format", "pdf"],
    ],
)  # fmt: skip
def test_wrong_words_are_one_line(words: list[str], layouts: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("rest.npz", U=np.zeros(SHAPES["planar_trap"]))
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert not out and err.startswith("torchgco-judge: ") and len(err.splitlines()) == 1 and "expected" in err
    assert not (tmp_path / "judged").exists()


def test_a_study_is_kept(layouts: Path, tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "study.json").write_text("{}")
    np.savez(tmp_path / "rest.npz", U=np.zeros(SHAPES["planar_trap"]))
    assert main([str(layouts), str(tmp_path / "rest.npz"), "--output", str(tmp_path / "study")]) == 2
    assert [path.name for path in (tmp_path / "study").iterdir()] == ["study.json"]


def test_a_leaderboard_of_good_entries_and_bad_ones(tmp_path: Path, capsys) -> None:
    """Whatever an entry holds, the others are judged, and no text of it is more than text."""
    folder = board(tmp_path / "a board")
    enter(folder, "rest", "planar_trap", "walls")
    enter(folder, HOSTILE.replace("/", "-"), "walls", name=HOSTILE, authors="=1+1", link="https://example.org/?a=1&b=<")
    enter(folder, "shape", "walls", "planar_trap", U=np.zeros(SHAPES["walls"]))
    enter(folder, "elsewhere", link="javascript:alert(1)")
    enter(folder, "unnamed", name="")
    enter(folder, "listed", authors=["A", "B"])
    enter(folder, "misspelt", hardwear="x")
    enter(folder, "long", method="x" * 1001)
    enter(folder, "no controls")
    (enter(folder, "others") / "forest.npz").write_bytes(b"")
    (enter(folder, "twice", "walls") / "walls.csv").write_text("layout,k,u1,u2,u3,u4\n")
    (enter(folder, "broken") / "entry.toml").write_text("name = ")
    (folder / "entries" / "device").mkdir()
    (folder / "entries" / "device" / "entry.toml").symlink_to("/dev/zero")
    (folder / "entries" / "no card").mkdir()
    (folder / "entries" / "README.md").write_text("A file is no entry.")
    assert main(["--board", str(folder)]) == 2
    out, err = capsys.readouterr()
    refused = {line.split("refused ")[1].split(":")[0] for line in err.splitlines() if "refused" in line}
    bad = {"elsewhere", "unnamed", "listed", "misspelt", "long", "no controls", "others", "twice", "broken", "device"}
    assert refused == {*bad, "no card", "shape/planar_trap.npz"}
    table = pd.read_csv(folder / "board.csv")
    assert len(table) == 4 == len(out.split("\n\n")[0].splitlines()) - 1
    assert table["layouts"].tolist() == ["planar_trap", "walls", "walls", "walls"] and "'=1+1" in set(table["authors"])
    assert (table["n"] == 2).all() and (table["reached_count"] == 0).all()
    texts = checked((folder / "board.html").read_text())
    assert texts.count(HOSTILE) == 2
    assert set(re.findall(r'href="(\w+)', (folder / "board.html").read_text())) == {"https"}


@pytest.mark.slow
def test_entries_are_ranked_against_each_other_where_no_best_cost_is_known(tmp_path: Path) -> None:
    folder = board(tmp_path)
    layouts = Layouts.load(folder / "layouts" / "planar_trap.npz")
    replace(layouts, best_cost=None).save(folder / "layouts" / "planar_trap.npz")
    task = Scene.read(DATA / "planar_trap.npz").vehicle.task(layouts)
    U = torchgco.solve(task.problem, task.U0).U.numpy()
    enter(folder, "alone", "planar_trap", U=U)
    assert leaderboard(folder).table["success_n"].tolist() == [0], "nothing to compare with"
    enter(folder, "second", "planar_trap", U=U)
    assert leaderboard(folder).table["success_count"].tolist() == [2, 2]


def test_the_page_forbids_all_but_its_own_script_and_style() -> None:
    html = page("<t>", "&", [Board("<i>", [("<h>", '"')], [[Cell("<c>", 1.0)], [Cell("-", float("nan"))]])], ["<n>"])
    texts = checked(html)
    assert {"<t>", "&", "<i>", "<h>", "<c>", "<n>"} <= set(texts)
    (policy,) = re.findall(r'Content-Security-Policy" content="(.*?)"', html)
    assert policy.startswith("default-src 'none'; script-src 'sha256-") and "unsafe" not in policy
    assert 'data-sort="1.0"' in html and 'data-sort=""' in html and set(CARD) >= {"name", "authors"}
