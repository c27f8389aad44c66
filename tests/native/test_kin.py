"""What the cache keeps of code that differs in numbers alone, and bits at several levels of optimisation."""

import ctypes
import os
from collections import Counter
from pathlib import Path

import pytest
import torch

from torchgco import FunctionConstraint, FunctionDynamics, Problem, QuadraticCost
from torchgco.native import compiler, engine, interior, store
from torchgco.native.compiler import build, find_compiler
from torchgco.native.includes import joined

pytestmark = pytest.mark.usefixtures("cache")

WEIGHTS = torch.tensor([0.3, -0.7], dtype=torch.float64)
needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def test_a_kin_displaces_its_own_oldest_files(cache: Path, monkeypatch) -> None:
    monkeypatch.setattr(store, "KIN", 3)
    others = [store.key_of(("other", str(i)), *(("another kin",) if i > 2 else ())) for i in range(5)]
    kin = [store.key_of(("model", str(i)), "a model") for i in range(8)]
    assert len({key[:8] for key in kin}) == 1 and len(set(kin)) == 8
    for i, key in enumerate((*others, *kin)):
        path = store.save(key, ".json", b"%d" % i)
        os.utime(path, (1000.0 + i, 1000.0 + i))
    assert all(store.read(key, ".json") for key in others)
    assert [store.read(key, ".json") is not None for key in kin] == [False] * 5 + [True] * 3


@needs_compiler
def test_models_that_differ_in_numbers_alone_are_of_one_kin(cache: Path, monkeypatch) -> None:
    """As those of a loop that trains: all files of a solve, the generated ones and the libraries."""
    found, keys = find_compiler(), []
    monkeypatch.setattr(engine, "build", lambda source, *_: keys.append(compiler._key(found, source, ())))
    for factor in (0.25, -1.5e-3, 3e5):
        model = FunctionDynamics(lambda x, u, f=factor: f * u.expand_as(x) + x * WEIGHTS * f, 2, 1, 0.1)
        rows = FunctionConstraint(lambda x, f=factor: f * x[..., :1] - 1.0)
        problem = Problem(model, QuadraticCost([1, 1], [1], [1, 1]), [rows], [[0.1, 0.2]], 5)
        interior.InteriorEngine(engine.Engine(problem))
    assert len(set(keys)) == 6
    kinds = Counter(key[:8] for key in (*keys, *(path.name for path in cache.iterdir())))
    assert len(kinds) == 6 and set(kinds.values()) == {3}


SINES = """
#define REAL double
#define LANES 4
#include "functions.h"
void tgco_both(const double *x, double *y) {
    V v, s, t;
    for (int i = 0; i < LANES; i++) v[i] = x[i];
    s = tgco_sin(v), t = tgco_exp(v) * s + v;
    for (int i = 0; i < LANES; i++) y[i] = s[i], y[LANES + i] = t[i];
}
"""


@needs_compiler
def test_levels_of_optimisation_have_the_same_bits(monkeypatch) -> None:
    monkeypatch.delenv("TORCHGCO_CFLAGS", raising=False)
    x, source = torch.linspace(-3.0, 3.0, 400, dtype=torch.float64), joined(SINES)
    found = []
    for level in ("-Og", "-O1", "-O3"):
        both, y = build(source, (level,)).tgco_both, torch.empty(100, 8, dtype=torch.float64)
        for i in range(100):
            both(ctypes.c_void_p(x[4 * i :].data_ptr()), ctypes.c_void_p(y[i].data_ptr()))
        found.append(y)
    torch.testing.assert_close(found[0][:, :4].flatten(), x.sin(), rtol=0, atol=1e-15)
    assert torch.equal(found[0], found[1]) and torch.equal(found[1], found[2])
