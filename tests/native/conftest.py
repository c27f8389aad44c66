"""Each test has an empty cache folder and no loaded library."""

from pathlib import Path

import pytest

from torchgco.native import compiler


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setenv("TORCHGCO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(compiler, "_loaded", {})
    return tmp_path / "cache"
