"""The site of the manual: its pages, links and search, and the API; and the numbers of a release."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ADDRESS = re.compile(r'(?:href|src)="?([^"\s>]+)')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("manual") / "site"
    command = [sys.executable, str(ROOT / "docs" / "manual.py"), "--output", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mkdocs") is None or find_spec("pdoc") is None, reason="no MkDocs or no pdoc")
def test_the_site_has_all_pages_and_their_links_lead_somewhere(site: Path) -> None:
    pages = {page.stem for page in (ROOT / "docs").glob("*.md")} - {"README"}
    assert pages <= {page.stem for page in (site / "docs").glob("*.html")}
    for page in (site / "index.html", *(site / "docs").glob("*.html"), *(site / "benchmarks").rglob("*.html")):
        for address in ADDRESS.findall(page.read_text()):
            path = address.partition("#")[0].partition("?")[0]
            if path and not re.match(r"\w+:", path):
                assert (page.parent / path).exists(), f"{page.name}: {address}"
    assert (site / "api" / "torchgco.html").exists()


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mkdocs") is None or find_spec("pdoc") is None, reason="no MkDocs or no pdoc")
def test_the_site_is_searched_and_loads_nothing_from_elsewhere(site: Path) -> None:
    index = (site / "search" / "search_index.json").read_text()
    assert all(word in index for word in ("quaternion", "linkages", "free_time.html", "CONTRIBUTING.html"))
    text = (site / "index.html").read_text()
    assert re.findall(r"<(?:script|img|link)[^>]*(?:src|href)=\"?(https?:[^\"\s>]+)", text) == []


def test_the_numbers_of_a_release_agree() -> None:
    number = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {number}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"torchgco-{number}-py3-none-any.whl" in (ROOT / "docs" / "releasing.md").read_text()
