"""What is said of a compiler that fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.native.test_compiler import needs_compiler
from torchgco.native.compiler import NativeError, build

pytestmark = pytest.mark.usefixtures("cache")

# What gcc, clang and their tools say where a disk is full or a source is wrong, and the telling line.
SAID = {
    "gcc": (
        "kernels.c:7:1: fatal error: error writing to /tmp/ccX.s: No space left on device\ncompilation terminated.",
        "kernels.c:7:1: fatal error: error writing to /tmp/ccX.s: No space left on device",
    ),
    "ld": (
        "/usr/bin/ld: final link failed: No space left on device\ncollect2: error: ld returned 1 exit status",
        "/usr/bin/ld: final link failed: No space left on device",
    ),
    "as": (
        "/tmp/ccX.s: Assembler messages:\n/tmp/ccX.s: Fatal error: can't close /tmp/ccY.o: No space left on device",
        "/tmp/ccX.s: Fatal error: can't close /tmp/ccY.o: No space left on device",
    ),
    "clang": (
        "kernels.c:1:1: warning: unused\nkernels.c:2:1: error: unknown type name 'a'\n    2 | a error;\n      | ^\n"
        "1 warning and 1 error generated.",
        "kernels.c:2:1: error: unknown type name 'a'",
    ),
    "lld": (
        "ld.lld: error: cannot open output file: No space left on device\n"
        "clang: error: linker command failed with exit code 1 (use -v to see invocation)",
        "ld.lld: error: cannot open output file: No space left on device",
    ),
    "another": ("first\nlast words\n\n", "last words"),
}


@pytest.mark.parametrize("said", SAID)
def test_the_error_of_a_compiler_is_its_last_telling_line(said: str, tmp_path: Path, monkeypatch) -> None:
    text, expected = SAID[said]
    script = tmp_path / "cc"
    (tmp_path / "said").write_text(text)
    script.write_text(f'#!/bin/sh\ncase "$*" in *--version*) exit;; esac\ncat {tmp_path / "said"} >&2\nexit 1\n')
    script.chmod(0o755)
    monkeypatch.setenv("TORCHGCO_CC", str(script))
    with pytest.raises(NativeError) as caught:
        build("int tgco_one(void) { return 1; }")
    assert str(caught.value).splitlines()[0] == f"{script} failed: {expected}"


@needs_compiler
def test_errors_are_the_compilers_own(cache: Path) -> None:
    with pytest.raises(NativeError, match="no_such_type") as caught:
        build("no_such_type tgco_times;")
    assert len(str(caught.value).splitlines()) <= 6
    assert not cache.exists()
