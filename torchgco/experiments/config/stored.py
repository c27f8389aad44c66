"""What a study's files may make: a run folder comes from anybody, and a `_target_` is code that runs."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from torchgco.base.errors import InputError
from torchgco.experiments.config.groups import classes_of

TARGET = "_target_"
PARTIAL = "_partial_"  # of missions: their planner and plant are put in later


def check_stored(tree: Any, group: str, field: str) -> None:
    """Check that a node of a study's file, in plain containers, makes nothing but classes of a group's own options.

    Their arguments are numbers, texts, lists and further classes of the group, by name too: no interpolations, which
    could read the environment, and no free mappings, which are options of other libraries.

    Args:
        group: of `conf`: model, solver, mission or plant.
        field: where the node lies, for errors.

    Raises:
        InputError: the node makes anything else.
    """
    if not isinstance(tree, Mapping) or TARGET not in tree:
        raise _refused(field, f"a node with a {TARGET}", tree)
    _check(tree, classes_of(group), group, field)


def _check(value: Any, known: frozenset[type], group: str, field: str) -> None:
    if isinstance(value, str) and "${" in value:
        raise _refused(field, "a text without interpolations", value)
    if isinstance(value, list):
        for i, item in enumerate(value):
            _check(item, known, group, f"{field}.{i}")
    if not isinstance(value, Mapping):
        return
    if TARGET not in value:
        if not value or not all(isinstance(item, Mapping) and TARGET in item for item in value.values()):
            raise _refused(field, "a number, a text, a list, a class or classes by name", value)
        for name, item in value.items():
            _check(item, known, group, f"{field}.{name}")
        return
    if not _is_known(value[TARGET], known):
        raise _refused(f"{field}.{TARGET}", f"a class that torchgco's own options of {group} make", value[TARGET])
    for key, item in value.items():
        if key.startswith("_") and key != TARGET and not (key == PARTIAL and group == "mission"):
            raise _refused(field, f"fields of {value[TARGET]}", key)
        _check(item, known, group, f"{field}.{key}")


def _is_known(target: Any, known: frozenset[type]) -> bool:
    """Whether a path names one of the classes. Nothing is imported: modules of the classes are by now."""
    module, _, name = target.rpartition(".") if isinstance(target, str) else ("", "", "")
    attribute = vars(sys.modules[module]).get(name) if module in sys.modules else None
    return any(attribute is kind for kind in known)


def _refused(field: str, expected: str, got: Any) -> InputError:
    return InputError(field, f"{expected} (--trust admits any, and its code runs)", got)
