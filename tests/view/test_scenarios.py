"""The page of a study of every scenario, and of missions of every kind, opened in a headless Chromium."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.view.browser import Tab
from tests.view.test_browser import pixels, stony
from torchgco.experiments import app
from torchgco.experiments.config.groups import options_of
from torchgco.scenarios import Layouts

SIZE = (800, 500)
QUICK = ["study.baselines=[]", "study.workers=1", "study.figures=false", "study.view=true"]
FAST = ("cylinders", "layouts", "map", "mazes", "yard")  # obstacles of every kind; the others are tests marked slow
MADE = {
    "layouts": ["scenario.path=layouts.npz", "model=planar"], "map": ["scenario.path=map.npz", "model=quadrotor"],
}  # fmt: skip
MISSIONS = {
    "woods": ["experiment=mission", "scenario=woods"],
    "mazes": ["experiment=mission", "scenario=mazes"],
    "a map": ["experiment=mission", "scenario=map", "scenario.path=map.npz"],
    "unknown cylinders": ["experiment=mission_unknown", "scenario=cylinders"],
    "unknown forest": ["experiment=mission_unknown"],
    "unknown walls": ["experiment=mission_unknown", "scenario=walls"],
    "an unknown map": ["experiment=mission_unknown", "scenario=map", "scenario.path=map.npz"],
}


@pytest.fixture(scope="module")
def opened(chromium: Callable[[], Tab]) -> Tab:
    tab = chromium()
    tab.size(*SIZE)
    return tab


@pytest.fixture
def flown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Runs a study in a folder with a layout file and a map; returns its page."""
    rng = np.random.default_rng(0)
    centers, radii = rng.uniform(-0.8, 0.8, (2, 5, 2)), rng.uniform(0.02, 0.1, (2, 5))
    layouts = Layouts(centers, radii, start=np.array([-1.0, 0.0]), goal=np.array([1.0, 0.5]))
    layouts.save(tmp_path / "layouts.npz")
    cells = np.zeros((30, 20, 12), bool)
    cells[14:16], cells[14:16, 5:12, 3:10] = True, False  # a wall with a window, under a roof
    cells[:, :, -1] = True
    ends = np.array([[0.5, 2.0, 1.2], [5.5, 2.0, 1.2]])
    np.savez(tmp_path / "map.npz", occupied=cells, origin=np.zeros(3), resolution=0.2, start=ends[0], goal=ends[1])

    def run(*words: str) -> Path:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["torchgco", *words, "hydra.run.dir=study"])
        assert not app.main()
        return tmp_path / "study" / "view.html"

    return run


def check(tab: Tab, page: Path, fragment: str = "", obstacles: bool = True) -> np.ndarray:
    """Assert that the page shows obstacles where there are some, trajectories and no error; returns the picture."""
    tab.errors.clear()
    tab.requests.clear()
    tab.open(page, fragment)
    tab.evaluate("torchgcoView.toggle('through', false)")
    picture = pixels(tab)
    assert tab.errors == [] and tab.evaluate("document.getElementById('notes').children.length") == 0
    assert [url for url in tab.requests if not url.startswith(("file:", "blob:null/", "about:"))] == []
    assert tab.evaluate("torchgcoView.flights.all.length") > 0
    if obstacles:
        assert tab.evaluate("torchgcoView.layout.obstacles.reduce((sum, one) => sum + one.count, 0)") > 0
        assert stony(picture).mean() > 0.004
    low, high = np.array(tab.evaluate("[torchgcoView.space.low, torchgcoView.space.high].map((p) => p.toArray())"))
    assert np.isfinite([low, high]).all() and (high > low).all()
    return picture


NO_OBSTACLES = ("fleet_circle", "race")
CHOOSE_THE_TIME = ("gates", "race")  # which `hold` and `al_ilqr` can't
SCENARIOS = [
    pytest.param(name, marks=[] if name in FAST else [pytest.mark.slow]) for name in options_of("scenario")
]  # fmt: skip


@pytest.mark.sampled(2)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_scenario_has_its_page(scenario: str, flown: Callable[..., Path], opened: Tab) -> None:
    count = "study.layouts=null" if scenario == "map" else "study.layouts=2"
    solver = "interior_point" if scenario in CHOOSE_THE_TIME else "hold"
    page = flown(*QUICK, f"solver={solver}", f"scenario={scenario}", *MADE.get(scenario, []), count)
    first = check(opened, page, obstacles=scenario not in NO_OBSTACLES)
    if scenario == "rooms":  # outer walls hide what differs
        opened.evaluate("torchgcoView.toggle('through', true)")
        first = pixels(opened)
    if scenario != "map":
        opened.click("#next")
        opened.wait("document.getElementById('picture').dataset.layout === '1'")
        assert opened.errors == []
        if scenario != "planar_trap_paper":  # one arrangement
            assert (np.abs(pixels(opened) - first).max(axis=-1) > 20).mean() > 0.001


@pytest.mark.slow
@pytest.mark.parametrize("scenario", options_of("scenario"))
def test_every_scenario_as_it_is_flown(scenario: str, flown: Callable[..., Path], opened: Tab) -> None:
    """Two solvers, and the search for both layouts of the first."""
    count = "study.layouts=null" if scenario == "map" else "study.layouts=2"
    rival = "interior_point" if scenario in CHOOSE_THE_TIME else "al_ilqr"
    words = ["study.workers=1", "study.figures=false", "study.view=true", f"study.baselines=[{rival}]", count]
    page = flown(f"scenario={scenario}", *MADE.get(scenario, []), *words)
    check(opened, page, "#time=1", scenario not in NO_OBSTACLES)
    names = opened.evaluate("torchgcoView.head.solvers.map(({ name }) => name)")
    fleet = scenario.startswith("fleet")
    assert names == ([f"vehicle {i}" for i in range(4)] if fleet else ["gco", rival])


@pytest.mark.slow
@pytest.mark.parametrize("kind", MISSIONS)
def test_every_kind_of_mission_as_it_is_flown(kind: str, flown: Callable[..., Path], opened: Tab) -> None:
    page = flown(*MISSIONS[kind], "mission.duration=3", "study.workers=1", "study.figures=false", "study.view=true")
    check(opened, page, "#time=1.5")
    parts = opened.evaluate("[...torchgcoView.flights.partNames]")
    assert parts == (["plan", "safe", "sought", "sensed"] if "unknown" in kind else ["plan"])
    if "unknown" in kind:
        assert opened.evaluate("torchgcoView.flights.all[0].parts.seen.occupied.size") > 50
        assert opened.evaluate("torchgcoView.flights.all[0].parts.sought.line.geometry.attributes.position.count") > 1
