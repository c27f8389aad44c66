"""Facts differ wherever code may compute otherwise, in whatever way it reaches what has changed."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.utils import parametrizations, parametrize

from tests.native.changes import D
from tests.tracing.changes_from_afar import FAR, Mode, Twice, Weighted
from torchgco.tracing import Facts, Unseen

V = torch.tensor([[1.0, -0.5]], dtype=D)


@pytest.fixture(autouse=True)
def usual() -> Iterator[None]:
    before = np.geterr()
    yield
    np.seterr(**before)
    torch.use_deterministic_algorithms(False)


def facts(thing: object) -> Facts | None:
    try:
        return Facts(thing)
    except Unseen:
        return None


@pytest.mark.parametrize("name", FAR)
def test_what_changes_from_afar_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    function, change = FAR[name](monkeypatch)
    before, again, first = facts(function), facts(function), function(V)
    assert (before is None) == (again is None)
    assert before is None or again is None or before.key == again.key
    change()
    assert not torch.equal(function(V), first)
    after = facts(function)
    assert before is None or after is None or before.key != after.key


def test_usual_code_is_seen_through() -> None:
    """Where it isn't, each solve traces it again."""
    net = nn.Linear(2, 2, dtype=D)
    parametrize.register_parametrization(net, "weight", Twice())
    parts = Weighted(), net, parametrizations.weight_norm(nn.Linear(2, 2, dtype=D)), Mode.SLOW, torch.func.vmap(net)
    layers = nn.Sequential(nn.LazyLinear(3, dtype=D), nn.Tanh(), nn.LayerNorm(3, dtype=D), nn.Dropout(0.1), nn.GELU())
    layers(V)
    for part in (*parts, layers, lambda v: torch.get_default_dtype(), lambda v: np.maximum(v, 0.0)):
        assert facts(part) is not None
