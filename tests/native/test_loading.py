"""What is loaded is what was read from the cache, from wherever libraries can be loaded."""

from __future__ import annotations

import ctypes
from pathlib import Path

import pytest

from tests.native.test_compiler import needs_compiler, next_process, times
from torchgco.native import compiler

pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture
def compilations(monkeypatch) -> list[str]:
    """The lines that announce them."""
    seen: list[str] = []
    monkeypatch.setattr(compiler, "notice", lambda text, brief=False: seen.append(text))
    return seen


@needs_compiler
def test_the_library_that_was_read_is_loaded(cache: Path, monkeypatch, compilations: list[str]) -> None:
    """Also where another one lies in its place by then: others may write to a folder above."""
    times(2)
    (file,) = cache.rename(place := cache.with_name("moved")).iterdir()  # the system knows libraries by their paths
    monkeypatch.setenv("TORCHGCO_CACHE", str(place))
    next_process()
    plain = ctypes.CDLL

    def swapping(name: str) -> ctypes.CDLL:
        file.unlink(missing_ok=True)
        file.write_bytes(b"of somebody else")
        return plain(name)

    monkeypatch.setattr(compiler.ctypes, "CDLL", swapping)
    assert times(2) == 6.0 and len(compilations) == 1


@needs_compiler
def test_a_folder_of_temporary_files_that_libraries_cannot_be_loaded_from(
    cache: Path, monkeypatch, compilations: list[str]
) -> None:
    times(2)
    next_process()
    plain = ctypes.CDLL

    def forbidding(name: str) -> ctypes.CDLL:
        if not name.startswith(str(cache)):
            raise OSError("failed to map segment from shared object")
        return plain(name)

    monkeypatch.setattr(compiler.ctypes, "CDLL", forbidding)
    assert times(2) == 6.0 and len(compilations) == 1
