"""Any value for any key of the configuration is accepted, or refused in one clear line."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.tally import accepted_or_refused, examples
from torchgco.experiments.config.build import Setup, compose, compose_config
from torchgco.experiments.flying.flight import plan_of
from torchgco.experiments.results.identity import flat

pytestmark = pytest.mark.slow

BASES = {
    "space": ("solver=gco",),
    "plane": ("model=planar", "scenario=planar_random", "solver=gco"),
    "trap": ("model=planar", "scenario=planar_trap", "solver=multistart"),
    "yard": ("model=unicycle", "scenario=yard", "solver=gco"),
    "walls": ("scenario=walls", "solver=gco_paper"),
    "moving": ("scenario=forest_moving", "solver=mppi"),
    "peers": ("solver=fatrop_guided",),
    "missions": ("mission=default", "plant=rotors"),
}
# Values as a user writes them on a command line: right and wrong types, extremes, things that are no values.
ATOMS = st.one_of(
    st.sampled_from(["null", "true", "nan", "inf", "-inf", "abc", "''", "'a b'", "1e400", "1e308", "-1e-320"]),
    st.sampled_from(["[]", "{}"]),
    st.integers(-3, 5).map(str),
    st.sampled_from([2**31, 2**53 + 1, 2**63, 10**24, -(10**24)]).map(str),
    st.floats(-4, 4).map(repr),
)
VALUES = st.one_of(
    ATOMS,
    st.lists(ATOMS, min_size=1, max_size=4).map(lambda items: f"[{','.join(items)}]"),
    ATOMS.map(lambda item: f"{{a: {item}}}"),
    ATOMS.map(lambda item: f"[[{item},{item}]]"),
)
# Large values of these are no mistakes: they are slow, and a user may wait.
SLOW = ("scenario.num_obstacles", "scenario.num_discs", "scenario.num_boxes", "study.layouts")


@cache
def keys(base: str) -> list[str]:
    found = flat(compose_config(BASES[base]))
    return [key for key in found if not key.endswith(("_target_", "_partial_")) and key not in SLOW]


def flown_setup(words: tuple[str, ...]) -> Setup:
    """Build everything that a study builds before it flies."""
    setup = compose(words)
    plan_of(setup)
    task = setup.vehicle.task(setup.layouts(2))
    if setup.mission is not None:
        setup.mission.check(task.problem.dynamics)
    return setup


@pytest.mark.parametrize("base", BASES)
@settings(max_examples=examples(60))
@given(data=st.data())
def test_any_value_of_a_key(base: str, data: st.DataObject) -> None:
    words: Any = [f"{data.draw(st.sampled_from(keys(base)))}={data.draw(VALUES)}"]
    accepted_or_refused("values of configuration keys", lambda: flown_setup((*BASES[base], *words)))


@settings(max_examples=examples(150))
@given(data=st.data())
def test_any_two_values(data: st.DataObject) -> None:
    base = data.draw(st.sampled_from(list(BASES)))
    two = data.draw(st.lists(st.sampled_from(keys(base)), min_size=2, max_size=2, unique=True))
    words = [f"{key}={data.draw(VALUES)}" for key in two]
    accepted_or_refused("pairs of configuration values", lambda: flown_setup((*BASES[base], *words)))


WORDS = st.text(st.sampled_from("aseln=.,+~-[]{}'\"\\:/ @!#$%01"), min_size=1, max_size=16)


@settings(max_examples=examples(250))
@given(st.lists(WORDS, min_size=1, max_size=3))
def test_any_words(words: list[str]) -> None:
    """Words that are no overrides, groups that don't exist, half a list."""
    accepted_or_refused("words on the command line", lambda: compose(words))
