"""Libraries are linked from units: those of the solver are compiled once, for all models."""

import ctypes
import multiprocessing
import os
from pathlib import Path

import pytest
import torch

import torchgco
from tests.native.test_compiler import compiled, disown, needs_compiler, next_process
from tests.problems import assert_same_bits, boxed_batch, planar_batch
from torchgco import FunctionConstraint, FunctionDynamics, Problem, QuadraticCost
from torchgco.native import compiler, store
from torchgco.native.codegen.source import INTERIOR, SAMPLER, SOLVER_LIBRARY
from torchgco.native.compiler import Unit, build
from torchgco.native.engine import Engine

__all__ = ["compiled"]  # a fixture
pytestmark = pytest.mark.usefixtures("cache")

SHARED = Unit("double tgco_factor(void);\ndouble tgco_times(double x) { return tgco_factor() * x; }")


def times(factor: int, x: float = 3.0) -> float:
    """factor * x, by a library linked from a unit of its own and a shared one."""
    own = Unit(f"double tgco_factor(void) {{ return {factor}.0; }}", own=True)
    function = build((own, SHARED)).tgco_times
    function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double]
    return function(x)


def objects(cache: Path) -> list[Path]:
    return list(cache.glob("*.o"))


@needs_compiler
def test_a_shared_unit_is_compiled_once(cache: Path, compiled: list[str]) -> None:
    assert times(2) == 6.0 and times(3) == 9.0 and len(compiled) == 3
    next_process()
    assert times(2) == 6.0 and len(compiled) == 3
    assert times(5) == 15.0 and len(compiled) == 4 and compiled.count(SHARED.source) == 1
    assert len(objects(cache)) == 1 and len(list(cache.glob("*.so"))) == 3


@needs_compiler
@pytest.mark.parametrize("harm", ["flipped", "truncated", "of another user", "open to others"])
def test_an_object_that_cannot_be_trusted_is_made_again(
    cache: Path, monkeypatch, compiled: list[str], harm: str
) -> None:
    monkeypatch.setattr(store, "_warned", set())
    times(2)
    (file,) = objects(cache)
    content = file.read_bytes()
    next_process()
    if harm == "of another user":
        disown(file, monkeypatch)
    elif harm == "open to others":
        file.chmod(0o646)
    else:
        file.write_bytes(content[:500] if harm == "truncated" else content[:500] + b"?" + content[501:])
    if "other" in harm:
        with pytest.warns(store.CacheWarning):
            assert times(3) == 9.0
    else:
        assert times(3) == 9.0
    assert compiled.count(SHARED.source) == 2


def at_once(barrier, results, factor: int) -> None:
    barrier.wait()
    results.put(times(factor))


@needs_compiler
def test_processes_that_make_one_object_at_once(cache: Path, compiled: list[str]) -> None:
    context = multiprocessing.get_context("fork")
    barrier, results = context.Barrier(4), context.Queue()
    processes = [context.Process(target=at_once, args=(barrier, results, 2 + i)) for i in range(4)]
    for process in processes:
        process.start()
    assert sorted(results.get(timeout=60) for _ in processes) == [6.0, 9.0, 12.0, 15.0]
    for process in processes:
        process.join()
    assert not list(cache.glob("*.part")) and objects(cache)
    assert times(7) == 21.0 and compiled.count(SHARED.source) == 0


@needs_compiler
def test_what_an_object_depends_on_is_in_its_key(monkeypatch, compiled: list[str]) -> None:
    times(2)
    monkeypatch.setenv("TORCHGCO_CFLAGS", "-O1")
    times(2)
    monkeypatch.setattr(compiler, "_processor", lambda: "another")
    times(3)
    assert compiled.count(SHARED.source) == 3


def test_kernels_displace_no_objects(cache: Path, monkeypatch) -> None:
    monkeypatch.setattr(store, "FILES", 3)
    monkeypatch.setattr(store, "OBJECTS", 2)
    for i, suffix in enumerate((".o", ".o", ".o", *[".so"] * 6)):
        path = store.save(store.key_of(("key", str(i))), suffix, b"%d" % i)
        assert path is not None
        os.utime(path, (1000.0 + i, 1000.0 + i))
    assert sorted(file.read_bytes() for file in objects(cache)) == [b"1", b"2"]
    assert sorted(file.read_bytes() for file in cache.glob("*.so")) == [b"6", b"7", b"8"]


def test_models_share_the_solvers_units() -> None:
    """Whatever their sizes, costs and constraints, if their positions lie alike."""
    plane, _ = planar_batch(B=1, N=3)
    body = FunctionDynamics(lambda x, u: torch.cat((x[..., 2:], u), dim=-1), 4, 2, 0.1, position=slice(0, 2))
    rows = FunctionConstraint(lambda x: x[..., :1] - 1.0)
    cost = QuadraticCost([1.0] * 4, [0.1] * 2, (torch.eye(4) + 1.0).double())
    forms = [
        Engine(one, compiles=False).form for one in (plane, Problem(body, cost, [rows], torch.zeros(1, 4).double(), 3))
    ]
    for library in (SOLVER_LIBRARY, INTERIOR, SAMPLER):
        (*own, shared), (*others, same) = (form.units(library) for form in forms)
        assert shared == same and not shared.own
        assert all(unit.own for unit in (*own, *others)) and own[0] != others[0]
    assert forms[0].units(SOLVER_LIBRARY)[0] == forms[0].units(INTERIOR)[0]  # compiled once for both
    boxed, _ = boxed_batch(2, B=1, N=3)
    assert Engine(boxed, compiles=False).form.units() == forms[0].units()  # no obstacles change the code


@pytest.mark.slow
@needs_compiler
def test_bits_are_those_of_any_level_of_optimisation(monkeypatch) -> None:
    """Products and sums are fused where the code says so: no optimisation and no division into units changes a bit."""
    problem, U0 = planar_batch(B=3, N=12, obstacles=2)
    found = []
    for flags in ("-Og", ""):
        monkeypatch.setenv("TORCHGCO_CFLAGS", flags)
        found.append([torchgco.solve(problem, U0, solver=name) for name in ("gco", "interior_point")])
    for quick, shipped in zip(*found, strict=True):
        assert_same_bits(quick, shipped)
        assert torch.equal(quick.X, shipped.X)
