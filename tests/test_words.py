"""Words that the glossary has retired stand in no page and no docstring."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GLOSSARY = ROOT / "docs" / "words.md"
LISTED = GLOSSARY.read_text().partition("\n## Retired words\n")[2]
RETIRED = [word for row in re.findall(r"^\| ((?!retired|-).*?) \|", LISTED, re.MULTILINE) for word in row.split(", ")]
FOUND = re.compile(rf"\b(?:{'|'.join(map(re.escape, RETIRED))})\b", re.IGNORECASE)


def texts() -> Iterator[tuple[Path, str]]:
    """Pages, without the list itself, and docstrings; code between backticks may have any name."""
    for page in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "benchmarks").rglob("*.md")):
        if "api" not in page.parts:
            yield page, page.read_text().removesuffix(LISTED) if page == GLOSSARY else page.read_text()
    for file in (path for folder in ("torchgco", "benchmarks") for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                yield file, ast.get_docstring(node, clean=False) or ""


def retired(text: str) -> list[str]:
    return FOUND.findall(re.sub(r"`[^`\n]*`", "", text))


def test_no_retired_word_is_used() -> None:
    found = {str(path.relative_to(ROOT)): words for path, text in texts() if (words := retired(text))}
    assert not found, f"docs/words.md says what to write instead: {found}"


@pytest.mark.parametrize("text", ["It was Mended.", "one's own loop"])
def test_a_retired_word_is_found(text: str) -> None:
    assert len(RETIRED) > 10 and retired(text) and not retired("`mended` is a name; amended")
