"""Differences between the versions of Hydra and OmegaConf that are supported."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import hydra
import omegaconf
from omegaconf import OmegaConf


def _version(package: Any) -> tuple[int, ...]:
    return tuple(map(int, package.__version__.split(".")[:2]))


OLDER = _version(hydra) < (1, 4)
# Arguments of Hydra's entry points. Without them Hydra 1.3 would behave as 1.1 did; 1.4 warns of them.
ENTRY: dict[str, Any] = {"version_base": "1.3"} if OLDER else {}
# Arguments of `instantiate`. A configuration may name any class, such as a user's own solver; 1.4 wants that said.
ANY_CLASS: dict[str, Any] = (
    {} if OLDER else {"_execution_whitelist_": vars(hydra.utils)["UNSAFE_DISABLE_EXECUTION_CHECKS"]}
)


def register_resolver(name: str, resolver: Callable[..., Any]) -> None:
    """Let configurations call `resolver` as ${name:...}, also where that name has been registered before."""
    # OmegaConf 2.4 warns of the name that was the only one until then, and uses a name that was another function's.
    method = "register_resolver" if _version(omegaconf) >= (2, 4) else "register_new_resolver"
    getattr(OmegaConf, method)(name, resolver, replace=True)
