"""The stack of a step: frames of the longest chain of calls, as gcc says them, and what an emulated Cortex-M7 uses."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.export import car, linear, quadrotor
from tests.export.exported import ARM, M7, STRICT, exported, needs, needs_compiler, on_board, said
from tests.export.kinds import KINDS
from tests.slow import mostly
from torchgco.export.files import SPARE, STACK

pytestmark = needs_compiler
INDIRECT = "__indirect_call"  # calls of pointers
ENTRIES = {"car_step", "car_init", "car_guess", "car_reset"}
PROBLEMS = {"car": car, "quadrotor": quadrotor, "linear": linear}
LONG = "an implicit step", "ellipsoids", "dense"  # kinds whose functions are long
# Compilers with their options, and bytes of a return address that a call leaves on the stack.
BOARD = "arm-none-eabi-gcc", M7, 0
DESKTOP = "gcc", (*STRICT, "-mfma"), 8
# Printing takes more stack than a step, and comes after.
PAINTED = """
#define main compared
#include "car_test.c"
#undef main
#include "paint.h"
int main(void) {
    double u[car_NU];
    car_init(&workspace);
    paint();
    for (int k = 0; k < PERIODS; k++) car_step(&workspace, states + k * car_NX, k ? car_STAGES : 0, INFINITY, u);
    printf("%d bytes\\n", used());
    return 0;
}
"""


def longest(graph: str, entry: str, back: int) -> int:
    """Bytes of the longest chain of calls, of gcc's graph; a pointer may lead to what nothing else calls."""
    nodes = re.findall(r'node: \{ title: "([^"]+)" label: "([^"]*)"', graph)
    sizes = [(name, re.search(r"(\d+) bytes \((.+?)\)", label)) for name, label in nodes]
    assert all(size is None or size[2] in ("static", "dynamic,bounded") for _, size in sizes)
    frames = {name: int(size[1]) if size else 0 for name, size in sizes}
    calls: dict[str, set[str]] = {name: set() for name in frames}
    for caller, callee in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', graph):
        calls[caller].add(callee)
    calls[INDIRECT] = set(frames) - ENTRIES - set().union(*calls.values())
    bytes_of = dict[str, int]()

    def deepest(name: str, callers: tuple[str, ...]) -> int:
        assert name not in callers, f"{name} calls itself"
        if name not in bytes_of:
            below = max((deepest(callee, (*callers, name)) for callee in calls[name]), default=0)
            bytes_of[name] = frames[name] + back + below
        return bytes_of[name]

    return deepest(entry, ())


def frames(folder: Path, level: str, compiler: tuple[str, tuple[str, ...], int]) -> int:
    """Bytes of a step's frames."""
    gcc, options, back = compiler
    # Without merging equal functions, which leaves calls of names that have no node.
    said(gcc, *options, level, "-fcallgraph-info=su", "-fno-ipa-icf", "-c", "car.c", "-o", "car.o", folder=folder)
    return longest((folder / "car.ci").read_text(), "car_step", back)


@pytest.mark.sampled(1)
@needs("gcc")
@pytest.mark.parametrize("kind", mostly([*PROBLEMS, *LONG], "linear", "ellipsoids", "dense"))
def test_a_step_takes_at_most_the_stack_that_the_page_says(kind: str, tmp_path: Path) -> None:
    """And a sample's stack suffices for long functions, too."""
    folder = exported({**PROBLEMS, **KINDS}[kind](), tmp_path)
    assert f"stack of a step | {STACK:,}, on a Cortex-M" in (folder / "README.md").read_text()
    limit = STACK + (SPARE if kind in LONG else 0)
    used = frames(folder, "-Os", DESKTOP)
    assert 0.4 * limit < used <= limit, used


@pytest.mark.slow
@needs("arm-none-eabi-gcc")
@pytest.mark.parametrize("level", ["-Os", "-O2"])
@pytest.mark.parametrize("kind", PROBLEMS)
def test_frames_on_a_cortex_m7(kind: str, level: str, tmp_path: Path) -> None:
    used = frames(exported(PROBLEMS[kind](), tmp_path), level, BOARD)
    assert used <= STACK, used


@pytest.mark.sampled(1)
@needs("arm-none-eabi-gcc", "qemu-system-arm")
@pytest.mark.parametrize("kind", ["car", "quadrotor"])
def test_painted_stack_on_a_cortex_m7(kind: str, tmp_path: Path) -> None:
    """With what libm takes: bytes below a step's caller that 40 periods have changed."""
    folder = exported(PROBLEMS[kind](), tmp_path)
    (folder / "painted.c").write_text(PAINTED)
    files = f"-I{ARM}", "car.c", "painted.c"
    used = int(on_board(M7, "-O2", *files, folder=folder, program=tmp_path / "run").split()[0])
    assert 1000 < used <= STACK, used


def test_chains_are_added_up() -> None:
    graph = """
    node: { title: "car_step" label: "car_step\\ncar.c:1:1\\n100 bytes (static)" }
    node: { title: "car.c:a" label: "a\\ncar.c:2:1\\n10 bytes (static)" }
    node: { title: "car.c:b" label: "b\\ncar.c:3:1\\n70 bytes (dynamic,bounded)" }
    node: { title: "__indirect_call" label: "Indirect Call Placeholder" shape : ellipse }
    edge: { sourcename: "car_step" targetname: "car.c:a" label: "" }
    edge: { sourcename: "car.c:a" targetname: "__indirect_call" label: "" }
    """
    assert longest(graph, "car_step", 8) == 100 + 10 + 70 + 4 * 8
    with pytest.raises(AssertionError, match="calls itself"):
        longest(graph + 'edge: { sourcename: "car.c:a" targetname: "car_step" label: "" }', "car_step", 8)
