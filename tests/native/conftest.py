"""An empty cache folder and no loaded library, for tests of compiling and keeping."""

from pathlib import Path

import pytest

from torchgco.native import compiler


@pytest.fixture
def cache(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setenv("TORCHGCO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(compiler, "_loaded", {})
    monkeypatch.setattr(compiler, "_objects", {})
    return tmp_path / "cache"
