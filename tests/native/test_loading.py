"""What is loaded is what was read from the cache, from wherever libraries can be loaded."""

from __future__ import annotations

import ctypes
import gc
from pathlib import Path

import pytest

from tests.native.test_compiler import needs_compiler, next_process, source, times
from torchgco.base.memory import trim
from torchgco.native import compiler
from torchgco.native.compiler import build

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


@needs_compiler
def test_libraries_that_nobody_uses_any_more_are_closed(monkeypatch) -> None:
    """A loop over models maps no more and more memory; functions of a library keep it."""
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("no list of what this process has mapped")
    monkeypatch.setattr(compiler, "_KEPT", 1)
    gc.collect()
    mapped = lambda: maps.read_text().count("kernels.so")
    before = mapped()
    function = build(source(2)).tgco_times
    function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double]
    one = mapped() - before
    for factor in range(3, 7):
        assert times(factor) == 3.0 * factor
    gc.collect()
    assert mapped() == before + 2 * one and function(4.0) == 8.0
    assert len(compiler._loaded) == 1


def test_the_first_entries_are_dropped() -> None:
    kept = {name: size for size, name in enumerate("abcdef")}
    trim(kept, 4)
    assert list(kept) == ["c", "d", "e", "f"]
    trim(kept, 4, 9.0, float)
    assert list(kept) == ["e", "f"]
    trim(kept, 4, 1.0, float)
    assert list(kept) == ["f"]  # the last one stays, however large
