"""The part of `torchgco --help` that lists what is there: the groups of conf/ and their options."""

from __future__ import annotations

import textwrap
from typing import Any

from hydra.core.global_hydra import GlobalHydra

from torchgco.experiments.config.hydra_versions import register_resolver

INTERNAL = ("hydra", "preset")  # groups that other groups are made of
WIDTH = 100


def register() -> None:
    """Let the template of the page in conf/config.yaml call `options`."""
    register_resolver("torchgco.base.options", options)


def options(_root_: Any) -> str:
    """A line, or several, per group: its name and options, `*` behind the one that the command has chosen."""
    loader, chosen = GlobalHydra.instance().config_loader(), _root_.hydra.runtime.choices
    groups = (group for group in loader.list_groups("") if group not in INTERNAL)
    lines = []
    for group in [*sorted(groups), "hydra/launcher"]:
        names = sorted(loader.get_group_options(group))
        shown = ", ".join(f"{name}*" if name == chosen.get(group) else name for name in names)
        lines += textwrap.wrap(f"{group:<16}{shown}", WIDTH, initial_indent="  ", subsequent_indent=" " * 18)
    return "\n".join(lines)
