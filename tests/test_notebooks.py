"""The notebooks as they are committed: with outputs that a reader sees without running them. nbmake runs them too."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST = 400_000  # bytes
# A warning, a progress bar, an error, a place on the machine where it ran.
UNWANTED = re.compile(r"Warning|Traceback|it/s|\d%\||/(?:home|root|tmp|usr|work|Users|opt|var)/|[A-Z]:\\")


def cells(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text())["cells"]


def source(path: Path) -> str:
    return "\n".join("".join(cell["source"]) for cell in cells(path))


def outputs(path: Path) -> list[dict[str, Any]]:
    return [output for cell in cells(path) for output in cell.get("outputs", [])]


def text(output: dict[str, Any]) -> str:
    held = output.get("text", output.get("data", {}).get("text/plain", ""))
    return held if isinstance(held, str) else "".join(held)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stored_and_show_a_picture(path: Path) -> None:
    code = [cell for cell in cells(path) if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1)), "run once, in order"
    assert code[-1]["outputs"] and any("image/png" in output.get("data", {}) for output in outputs(path))
    assert path.stat().st_size < LARGEST
    assert not any("execution" in cell["metadata"] for cell in code), "times change with every run"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_hold_no_warning_and_no_path(path: Path) -> None:
    for output in outputs(path):
        assert output["output_type"] != "error" and output.get("name") != "stderr"
        assert not UNWANTED.search(text(output)), text(output)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_code_needs_no_file_of_the_repository(path: Path) -> None:
    """A notebook may be copied elsewhere."""
    for cell in cells(path):
        code = "".join(cell["source"]) if cell["cell_type"] == "code" else ""
        assert "../" not in code and "benchmarks" not in code, code


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_has_an_id_of_its_own(path: Path) -> None:
    ids = [cell.get("id") for cell in cells(path)]
    assert None not in ids and len(set(ids)) == len(ids)


def test_the_quickstart_shows_that_the_default_solver_arrives() -> None:
    path = ROOT / "notebooks" / "quickstart.ipynb"
    assert "stages=" not in source(path), "a shorter horizon leaves no time to arrive"
    table = next(text(output) for output in outputs(path) if "al_ilqr" in text(output))
    head, *rows = (line.split() for line in table.splitlines()[:3])
    assert head[:2] == ["feasible", "reached"]
    assert {name: values[:2] for name, *values in rows} == {"gco": ["4.0", "4.0"], "al_ilqr": ["0.0", "0.0"]}
    assert sum("clearance" in text(output) and "reached" in text(output) for output in outputs(path)) >= 3
