"""The page in a headless Chromium: what it shows, and what it does when it is asked."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.plotting.colours import GRAPHIC, TEXT, contrast
from tests.view.browser import Tab
from tests.view.scenes import DT, SOLVERS, UNEVEN, WORDS, N, document, trajectories
from torchgco.plotting.style import KNOWN, PALETTE, solver_colours
from torchgco.view.document import Line, SearchPart
from torchgco.view.page import page

SIZE = (900, 600)
PICTURE = "document.getElementById('picture')"
RED = (208, 32, 32)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    corners = np.array([[0.0, 0, 0], [3, -1.4, 0], [8, 0, 0]])
    lines = [Line(corners, "path", 0, "", "path 1: 8.3 m"), Line(corners + 0.2, "refined", 1, "proposed", WORDS)]
    balls = np.array([[3.0, -1.4, 0, 0.36], [4.0, -1.4, 0, 0.36]])
    search = SearchPart(["Solve", "PathProposals"], [("pass 4, 1 candidate", lines)], [("outer 2", balls, corners)])
    path = tmp_path_factory.mktemp("page") / "view.html"
    path.write_text(page(document(search=search)))
    return path


@pytest.fixture(scope="module")
def opened(chromium: Callable[[], Tab]) -> Tab:
    tab = chromium()
    tab.size(*SIZE)
    return tab


@pytest.fixture
def tab(opened: Tab, file: Path) -> Iterator[Tab]:
    opened.dark(False)
    opened.errors.clear()
    opened.requests.clear()
    opened.open(file)
    yield opened
    check_quiet(opened)


def check_quiet(tab: Tab) -> None:
    """Assert that the page complained of nothing, and asked for nothing from elsewhere."""
    assert tab.errors == []
    assert [url for url in tab.requests if not url.startswith(("file:", "blob:null/", "about:"))] == []


@pytest.fixture(scope="module")
def untouched(chromium: Callable[[], Tab], file: Path) -> Iterator[Tab]:
    """A page that is opened once, for tests that only read it."""
    tab = chromium()
    tab.size(*SIZE)
    tab.open(file)
    yield tab
    check_quiet(tab)


def pixels(tab: Tab) -> np.ndarray:
    """The canvas as (height, width, 3)."""
    width, height = tab.evaluate(f"[{PICTURE}.clientWidth, {PICTURE}.clientHeight]")
    whole = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
    return np.asarray(whole)[:height, :width].astype(int)


def alike(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Where the hue of a picture is that of a colour, in light and in shadow."""
    wanted = np.array(colour) / np.linalg.norm(colour)
    length = np.linalg.norm(picture, axis=-1)
    return (picture @ wanted > 0.985 * length) & (length > 60)


def stony(picture: np.ndarray) -> np.ndarray:
    """Where a picture has the warm grey of obstacles; the ground is a cold one."""
    return picture[..., 0] > 1.06 * picture[..., 2]


def rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def place(tab: Tab, point: list[float]) -> tuple[float, float]:
    """Where a point of space is seen, in pixels of the canvas."""
    script = f"""(() => {{ const {{ orbit, space, flights }} = torchgcoView;
      const seen = flights.all[0].points[0].clone().set(...{json.dumps(point)}).project(orbit.camera);
      return [(0.5 + 0.5 * seen.x) * {PICTURE}.clientWidth, (0.5 - 0.5 * seen.y) * {PICTURE}.clientHeight]; }})()"""
    x, y = tab.evaluate(script)
    return x, y


def vehicle(tab: Tab) -> np.ndarray:
    return np.array([float(word) for word in tab.evaluate(f"{PICTURE}.dataset.vehicle").split()])


def test_the_picture_shows_obstacles_and_both_trajectories(tab: Tab) -> None:
    tab.click("#view-above")
    picture = pixels(tab)
    for name, colour in solver_colours(SOLVERS).items():
        X = trajectories()[name][0].numpy()
        assert alike(picture, rgb(colour)).sum() > 150, name
        if name == SOLVERS[0]:
            for k in (8, 30):
                x, y = map(round, place(tab, X[k].tolist()))
                assert alike(picture[y - 3 : y + 4, x - 3 : x + 4], rgb(colour)).any(), (name, k)
    for center in ([3.0, 0, 0.8], [6.0, 2.5, 0.5], [4.5, -2, 0.8], [5.5, -3, 0.9]):
        x, y = map(round, place(tab, center))
        assert stony(picture[y - 8 : y + 9, x - 8 : x + 9]).mean() > 0.4, center


def test_violations_are_red_and_go_with_their_solver(tab: Tab) -> None:
    tab.click("#view-above")
    with_both = alike(pixels(tab), RED).sum()
    tab.click("#solvers .solver:nth-child(2) input")
    assert with_both > 40 and alike(pixels(tab), RED).sum() < 0.1 * with_both


def test_the_slider_moves_the_vehicle_and_the_obstacles(tab: Tab) -> None:
    tab.click("#view-above")
    before, picture = vehicle(tab), pixels(tab)
    tab.evaluate("(() => { const t = document.getElementById('time'); t.value = 2; "
                 "t.dispatchEvent(new Event('input', { bubbles: true })); })()")  # fmt: skip
    X = trajectories()[SOLVERS[0]][0].numpy()
    np.testing.assert_allclose(vehicle(tab), X[round(2 / DT)], atol=2e-3)
    assert np.linalg.norm(vehicle(tab) - before) > 1
    assert "2.00 of 4.00 s" in tab.evaluate("document.getElementById('clock').textContent")
    after = pixels(tab)
    x, y = map(round, place(tab, [6.0, 1.5, 0.5]))  # where the moving sphere is at 2 s
    spot = np.s_[y - 4 : y + 5, x - 4 : x + 5]
    assert stony(after[spot]).mean() > 0.6 > 0.3 > stony(picture[spot]).mean()


def test_a_click_changes_the_layout(tab: Tab) -> None:
    assert tab.evaluate(f"{PICTURE}.dataset.layout") == "0"
    before = pixels(tab)
    tab.click("#chips button:nth-child(3)")
    tab.wait(f"{PICTURE}.dataset.layout === '2' && torchgcoView.layout.flights[0].rows[1][1] === '3'")
    tab.click("#time")
    X = trajectories()[SOLVERS[0]][2].numpy()
    np.testing.assert_allclose(vehicle(tab), X[N // 2], atol=0.3)
    assert (np.abs(pixels(tab) - before).max(axis=-1) > 30).sum() > 200
    tab.click("#next")
    tab.wait(f"{PICTURE}.dataset.layout === '0'")


def test_stages_may_differ_in_length(tab: Tab) -> None:
    tab.click("#chips button:nth-child(2)")
    tab.wait(f"{PICTURE}.dataset.layout === '1' && torchgcoView.flights.times")
    assert "of 2.00 s" in tab.evaluate("document.getElementById('clock').textContent")
    X = trajectories()[SOLVERS[0]][1].numpy()
    tab.evaluate(f"torchgcoView.setTime({0.5 * (UNEVEN[20] + UNEVEN[21])})")
    np.testing.assert_allclose(vehicle(tab), 0.5 * (X[20] + X[21]), atol=2e-3)
    tab.evaluate(f"{PICTURE}.focus()")
    for key, k in ((".", 21), (".", 22), (",", 21)):
        tab.press(key)
        np.testing.assert_allclose(vehicle(tab), X[k], atol=2e-3)


def test_keys_play_step_and_choose(tab: Tab) -> None:
    tab.evaluate(f"{PICTURE}.focus()")
    tab.press(".")
    tab.press(".")
    np.testing.assert_allclose(vehicle(tab), trajectories()[SOLVERS[0]][0, 2].numpy(), atol=2e-3)
    tab.press("n")
    tab.wait(f"{PICTURE}.dataset.layout === '1'")
    azimuth = tab.evaluate("torchgcoView.orbit.azimuth")
    tab.press("ArrowRight")
    assert tab.evaluate("torchgcoView.orbit.azimuth") != azimuth
    before = vehicle(tab)
    tab.press(" ")
    assert tab.evaluate("document.getElementById('play').getAttribute('aria-pressed')") == "true"
    tab.wait(f"{PICTURE}.dataset.vehicle.split(' ')[0] > {before[0] + 0.1}")
    tab.press(" ")
    assert tab.evaluate("torchgcoView.playing") is False


def test_a_screen_reader_has_a_name_for_every_control(untouched: Tab) -> None:
    nodes = [one for one in untouched.call("Accessibility.getFullAXTree")["nodes"] if not one.get("ignored")]
    controls = [one for one in nodes if one["role"]["value"] in ("button", "checkbox", "slider", "combobox", "image")]
    assert len(controls) > 15 and all(len(one["name"]["value"].strip()) > 1 for one in controls)
    told = " ".join(one["name"]["value"] for one in nodes if "name" in one)
    assert f"layout 0 {WORDS}, in perspective. gco: reached; al_ilqr: failed" in told


def test_every_control_is_reached_by_the_tab_key(tab: Tab) -> None:
    tab.evaluate(f"{PICTURE}.focus()")
    reached = []
    for _ in range(40):
        for kind in ("rawKeyDown", "keyUp"):
            tab.call("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab", windowsVirtualKeyCode=9)
        reached.append(tab.evaluate("document.activeElement.id"))
    shown = "[...document.querySelectorAll('button[id], select, input[id]')].filter((one) => one.offsetParent)"
    assert set(tab.evaluate(f"{shown}.map((one) => one.id)")) <= set(reached)


def test_dragging_turns_the_picture(tab: Tab) -> None:
    before = pixels(tab)
    tab.mouse("mousePressed", 300, 300, button="left", buttons=1, clickCount=1)
    tab.mouse("mouseMoved", 380, 320, button="left", buttons=1)
    tab.mouse("mouseReleased", 380, 320, button="left", clickCount=1)
    assert (np.abs(pixels(tab) - before).max(axis=-1) > 30).mean() > 0.02


def test_the_hover_tells_what_is_under_the_pointer(tab: Tab) -> None:
    tab.click("#view-above")
    x, y = place(tab, trajectories()[SOLVERS[1]][0, 15].tolist())  # inside the sphere
    tab.mouse("mouseMoved", x, y)
    told = tab.wait("!document.getElementById('hover').hidden && document.getElementById('hover').innerText")
    assert told.startswith(f"layout 0 {WORDS}, al_ilqr: failed") and "knot 15, t = 1.50 s" in told
    assert f"status: {WORDS}" in told and "cost: " in told
    assert "here violated: spheres by" in told
    tab.mouse("mouseMoved", 5, 5)
    assert tab.evaluate("document.getElementById('hover').hidden")


def test_the_search_is_shown_on_demand(tab: Tab) -> None:
    tab.click("#view-above")
    before = pixels(tab)
    tab.click("#searched")
    assert (np.abs(pixels(tab) - before).max(axis=-1) > 25).sum() > 100
    told = tab.evaluate("document.getElementById('search').innerText")
    assert all(word in told for word in ("pass 4, 1 candidate", "PathProposals", "path 1: 8.3 m", WORDS))
    tab.click("#searched")
    assert (np.abs(pixels(tab) - before).max(axis=-1) > 25).sum() < 20


def test_a_trajectory_along_another_has_gaps(untouched: Tab) -> None:
    script = """torchgcoView.flights.all.map(({ line }) => Array.from(line.geometry.index.array))"""
    first, second = (np.reshape(corners, (N, -1)) for corners in untouched.evaluate(script))
    first, second = (int((pieces == 0).all(axis=1).sum()) for pieces in (first, second))
    assert first == 0 and 0 < second < 0.2 * N  # they share their start and their end alone


def test_views_of_obstacles(tab: Tab) -> None:
    pictures = [pixels(tab)]
    for name in ("#grown", "#through", "#follow"):
        tab.click(name)
        pictures.append(pixels(tab))
    for view in ("#view-side", "#view-behind", "#view-perspective"):
        tab.click(view)
        pictures.append(pixels(tab))
    assert all((np.abs(a - b).max(axis=-1) > 8).sum() > 300 for a, b in pairwise(pictures))


def test_nothing_is_shown_above_the_cut(tab: Tab) -> None:
    tab.click("#view-side")
    whole = stony(pixels(tab))
    space = tab.evaluate("({ low: torchgcoView.space.low.z, top: torchgcoView.space.top })")
    share = (0.05 - space["low"]) / (space["top"] - space["low"])  # through the middle of the sharp box
    tab.evaluate(f"document.getElementById('cut').value = {share}")
    tab.evaluate("document.getElementById('cut').dispatchEvent(new Event('input', { bubbles: true }))")
    cut = stony(pixels(tab))
    x, y = map(round, place(tab, [5.5, -3.0, 0.8]))  # the rounded box is wholly above 0.05 m
    assert whole[y, x] and not cut[y - 3 : y + 4, x - 3 : x + 4].any()
    x, y = map(round, place(tab, [4.5, -2.0, 0.4]))  # of the sharp one half is left
    below = round(place(tab, [4.5, -2.3, -0.4])[1])
    assert whole[y, x] and not cut[y, x] and cut[below, x]


def test_light_and_dark(tab: Tab) -> None:
    light = pixels(tab)
    tab.dark(True)
    tab.wait("torchgcoView.scene.background.getHex() === 0x16191d")
    dark = pixels(tab)
    assert light[:20].mean() > 200 > 80 > dark[:20].mean()
    assert tab.evaluate("getComputedStyle(document.body).color") == "rgb(232, 234, 237)"


@pytest.mark.parametrize("dark", [False, True])
def test_every_solver_is_seen_before_what_is_behind_it(tab: Tab, dark: bool) -> None:
    """On paper in the colours of figures, in the dark with the contrast that WCAG asks of graphics."""
    tab.dark(dark)
    ground = {False: "#e9ebee", True: "#20242a"}[dark]
    tab.wait(f"torchgcoView.colours.ground === 0x{ground[1:]}")
    for colour in dict.fromkeys([*KNOWN.values(), *PALETTE]):
        tab.evaluate(f"torchgcoView.head.solvers[0].colour = {json.dumps(colour)}; torchgcoView.rebuild()")
        swatch = "getComputedStyle(document.querySelector('.swatch')).backgroundColor.match(/\\d+/g).map(Number)"
        line = "torchgcoView.flights.all[0].line.material.color.getHexString()"
        shown, drawn = "#{:02x}{:02x}{:02x}".format(*tab.evaluate(swatch)), f"#{tab.evaluate(line)}"
        assert shown == drawn and (contrast(drawn, ground) > 0.99 * GRAPHIC if dark else drawn == colour.lower())


def test_layouts_differ_by_how_full_they_are_not_by_colour_alone(tab: Tab) -> None:
    level = "(name) => { const chip = document.querySelector('#chips button'); chip.className = name; "
    level += "return getComputedStyle(chip).backgroundImage.match(/(\\d+)%/)[1]; }"
    assert [tab.evaluate(f"({level})('{name}')") for name in ("success", "reached", "feasible", "failed")] == [
        "100", "66", "33", "0"
    ]  # fmt: skip


@pytest.mark.parametrize("dark", [False, True])
def test_all_words_can_be_read(tab: Tab, dark: bool) -> None:
    tab.dark(dark)
    tab.evaluate("document.querySelectorAll('.result').forEach((e, i) => { e.className = 'result ' + "
                 "['success', 'reached', 'feasible', 'failed'][i % 4]; })")  # fmt: skip
    check_readable(tab)
    tab.evaluate("document.querySelectorAll('.result').forEach((e, i) => { e.className = 'result ' + "
                 "['feasible', 'failed'][i % 2]; })")  # fmt: skip
    check_readable(tab)


def check_readable(tab: Tab) -> None:
    """Assert that all words that are shown have the contrast to what is behind them that WCAG asks of text."""
    script = """(() => { const parts = (text) => text.match(/[\\d.]+/g).map(Number);
      return [...document.querySelectorAll('body, body *')].filter((e) => e.getClientRects().length &&
        [...e.childNodes].some((one) => one.nodeType === 3 && one.textContent.trim())).map((e) => {
          const painted = (one) => parts(getComputedStyle(one).backgroundColor);
          let behind = e;
          while (behind && (painted(behind)[3] ?? 1) < 0.5) behind = behind.parentElement;
          const ground = behind ? painted(behind) : null;
          return [e.textContent.trim().slice(0, 40), parts(getComputedStyle(e).color), ground]; }); })()"""
    told = tab.evaluate(script)
    assert len(told) > 10
    canvas = [18, 18, 18] if tab.evaluate("matchMedia('(prefers-color-scheme: dark)').matches") else [255] * 3
    as_hex = lambda c: "#{:02x}{:02x}{:02x}".format(*(round(x) for x in c[:3]))
    weak = [(text, ink, ground) for text, ink, ground in told if contrast(as_hex(ink), as_hex(ground or canvas)) < TEXT]
    assert weak == []


def test_a_finger_asks_by_a_tap(tab: Tab) -> None:
    tab.click("#view-above")
    x, y = place(tab, trajectories()[SOLVERS[1]][0, 15].tolist())
    touch = {"enabled": True, "maxTouchPoints": 1}
    try:
        tab.call("Emulation.setTouchEmulationEnabled", **touch)
        tab.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        tab.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        assert "al_ilqr: failed" in tab.wait(
            "!document.getElementById('hover').hidden && document.getElementById('hover').innerText"
        )
    finally:
        tab.call("Emulation.setTouchEmulationEnabled", enabled=False)


def test_nothing_of_the_data_ran(untouched: Tab) -> None:
    assert untouched.evaluate("document.title") == WORDS
    assert untouched.evaluate("document.querySelectorAll('img, #panel script').length") == 0
    assert WORDS in untouched.evaluate("document.getElementById('layout').innerText")
    assert WORDS in untouched.evaluate("document.getElementById('solvers').innerText")


def test_half_precision_is_read_as_numpy_writes_it(untouched: Tab) -> None:
    bits = np.random.default_rng(0).integers(0, 2**16, 300, dtype=np.uint16)
    bits[:6] = 0, 1, 0x8001, 0x7BFF, 0x3C00, 0x0400
    values = bits.view(np.float16)
    finite = np.isfinite(values)
    script = "torchgcoView.half.map ? null : " + json.dumps(bits[finite].tolist()) + ".map(torchgcoView.half)"
    np.testing.assert_array_equal(np.array(untouched.evaluate(script)), values[finite].astype(float))


def test_a_damaged_page_says_so(opened: Tab, file: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.html"
    text = file.read_text()
    at = text.index('id="part-0"') + 60
    broken.write_text(text[:at] + "AAAA" + text[at + 4 :])
    opened.open(broken)
    assert "can't be shown" in opened.evaluate("document.getElementById('message').innerText")


def test_a_browser_without_webgl_is_told_so(opened: Tab, file: Path) -> None:
    source = "HTMLCanvasElement.prototype.getContext = () => null"
    script = opened.call("Page.addScriptToEvaluateOnNewDocument", source=source)
    opened.open(file)
    assert "no WebGL 2" in opened.evaluate("document.getElementById('message').innerText")
    opened.call("Page.removeScriptToEvaluateOnNewDocument", **script)


@pytest.mark.parametrize("width", [320, 390, 433])
def test_nothing_is_cut_off_on_a_phone(tab: Tab, width: int) -> None:
    """Whatever is shown ends within the window, values with their units and the button that folds the panel, too.

    A menu shows as much of a long name as fits; its list has all of it.
    """
    try:
        tab.size(width, 640)
        tab.wait(f"innerWidth === {width}")
        beyond = "[...document.querySelectorAll('body *')].filter((e) => e.getClientRects().length && "
        beyond += "!e.closest('.unseen') && (e.getBoundingClientRect().right > innerWidth + 0.5 || "
        beyond += "e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display === 'block' && "
        beyond += "e.tagName !== 'SELECT')).map((e) => e.id)"
        assert tab.evaluate(beyond) == []
        assert tab.evaluate("document.documentElement.scrollWidth") == width
        assert tab.evaluate("document.getElementById('fold').getBoundingClientRect().bottom") <= 640
        tab.click("#fold")
        assert tab.evaluate("document.getElementById('panel').getClientRects().length") == 0
        tab.click("#fold")
    finally:
        tab.size(*SIZE)
