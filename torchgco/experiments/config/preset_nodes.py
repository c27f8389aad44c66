"""What conf/ takes from code: presets as nodes of Hydra's configuration store, and functions in interpolations.

The group `preset`, which conf/solver refers to, has the values of `torchgco.presets`. An option that differs between
the plane and space becomes an interpolation that chooses by `model.dimension`.
"""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from torchgco.experiments.config.hydra_versions import register_resolver
from torchgco.presets import PRESETS

BY_DIMENSION = "torchgco.by_dimension"
DRAWN = "torchgco.drawn"


def register() -> None:
    """Store all presets; to be called before Hydra composes anything."""
    register_resolver(BY_DIMENSION, _by_dimension)
    register_resolver(DRAWN, _drawn)
    for name, make in PRESETS.items():
        ConfigStore.instance().store(group="preset", name=name, node=_joined(_tree(make(2)), _tree(make(3))))


def _by_dimension(dimension: int, plane: Any, space: Any) -> Any:
    return space if dimension == 3 else plane


def _drawn(count: int, _root_: Any) -> int | None:
    """A number of layouts where they are drawn; None, all of them, where they come from a file."""
    scenario = _root_.get("scenario")
    return None if OmegaConf.is_dict(scenario) and "path" in scenario else count


def _tree(value: Any) -> Any:
    """A solver as nested containers that Hydra instantiates."""
    if is_dataclass(value) and not isinstance(value, type):
        target = f"{type(value).__module__}.{type(value).__qualname__}"
        return {"_target_": target} | {field.name: _tree(getattr(value, field.name)) for field in fields(value)}
    return [_tree(item) for item in value] if isinstance(value, (list, tuple)) else value


def _joined(plane: Any, space: Any) -> Any:
    """One tree for both: equal values as they are, others as interpolations."""
    if isinstance(plane, dict) and isinstance(space, dict) and list(plane) == list(space):
        return {key: _joined(plane[key], space[key]) for key in plane}
    if isinstance(plane, list) and isinstance(space, list) and len(plane) == len(space):
        pairs = [_joined(a, b) for a, b in zip(plane, space, strict=True)]
        if all(isinstance(item, dict) for item in plane):
            return pairs
    if plane == space:
        return plane
    return f"${{{BY_DIMENSION}:${{model.dimension}},{_literal(plane)},{_literal(space)}}}"


def _literal(value: Any) -> str:
    """A value in the grammar of interpolations."""
    if isinstance(value, list):
        return f"[{','.join(map(_literal, value))}]"
    return json.dumps(value)
