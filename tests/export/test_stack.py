"""The stack of a step: frames of the longest chain of calls, as gcc says them, are at most what the page says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks.export import car, linear, quadrotor
from tests.export.exported import STRICT, exported, needs, needs_compiler, said
from tests.export.kinds import KINDS
from tests.slow import mostly
from torchgco.export.files import SPARE

pytestmark = needs_compiler
INDIRECT, RETURN = "__indirect_call", 8  # calls of pointers; bytes of a return address on x86-64
ENTRIES = {"car_step", "car_init", "car_guess", "car_reset"}
PROBLEMS = {"car": car, "quadrotor": quadrotor, "linear": linear}
LONG = "an implicit step", "ellipsoids", "dense"  # kinds whose functions are long


def longest(graph: str, entry: str) -> int:
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
            bytes_of[name] = frames[name] + RETURN + below
        return bytes_of[name]

    return deepest(entry, ())


@pytest.mark.sampled(1)
@needs("gcc")
@pytest.mark.parametrize("kind", mostly([*PROBLEMS, *LONG], "linear", "ellipsoids", "dense"))
def test_a_step_takes_at_most_the_stack_that_the_page_says(kind: str, tmp_path: Path) -> None:
    """And a sample's stack suffices for long functions, too."""
    folder = exported({**PROBLEMS, **KINDS}[kind](), tmp_path)
    said_bytes = re.search(r"stack of a step \| ([\d,]+)", (folder / "README.md").read_text())
    assert said_bytes is not None
    limit = int(said_bytes[1].replace(",", "")) + (SPARE if kind in LONG else 0)
    for level in ("-Os", "-O2"):
        # Without merging equal functions, which leaves calls of names that have no node.
        graph = "-fcallgraph-info=su", "-fno-ipa-icf"
        words = *STRICT, level, "-mfma", *graph, "-c", "car.c", "-o", "car.o"
        said("gcc", *words, folder=folder)
        used = longest((folder / "car.ci").read_text(), "car_step")
        assert 0.5 * limit < used <= limit, (level, used)


def test_chains_are_added_up() -> None:
    graph = """
    node: { title: "car_step" label: "car_step\\ncar.c:1:1\\n100 bytes (static)" }
    node: { title: "car.c:a" label: "a\\ncar.c:2:1\\n10 bytes (static)" }
    node: { title: "car.c:b" label: "b\\ncar.c:3:1\\n70 bytes (dynamic,bounded)" }
    node: { title: "__indirect_call" label: "Indirect Call Placeholder" shape : ellipse }
    edge: { sourcename: "car_step" targetname: "car.c:a" label: "" }
    edge: { sourcename: "car.c:a" targetname: "__indirect_call" label: "" }
    """
    assert longest(graph, "car_step") == 100 + 10 + 70 + 4 * RETURN
    with pytest.raises(AssertionError, match="calls itself"):
        longest(graph + 'edge: { sourcename: "car.c:a" targetname: "car_step" label: "" }', "car_step")
