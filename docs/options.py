"""docs/options.md from the presets and the docstrings of their classes: `make docs` writes it, beside the reference.

A preset is a tree of dataclasses: its leaves are the keys of the command line, and their meanings stand in the
docstrings. A test compares the page with what this makes.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

from torchgco import presets
from torchgco.base.options import _rules
from torchgco.search import Passes

PAGE = Path(__file__).parent / "options.md"
COMMAND = "python docs/reference.py"
HEAD = f"""# Options of all solvers

Every preset with its values in the plane and in space, then every class with the meaning of its options. On the command
line a key is `solver.KEY=VALUE` (`solver.passes.paths.num_paths=3`), and `~solver.passes.samples` leaves a pass out; in
Python `dataclasses.replace` and `passes.changed` do the same, see [options](choosing.md#options). Values for the plane
hold for all problems but those in space. `{COMMAND}` writes this page from the presets and their docstrings.

## Presets
"""
ENTRY = re.compile(r"^    ([\w, ]+?): (.*(?:\n     .*)*)", re.MULTILINE)
SAME = re.compile(r"as of `(\w+)`\.?(.*)", re.DOTALL)
BASE, VARIANTS = "gco", ("gco_fast", "gco_max", "gco_exact")  # a preset, and others that are shown by what differs


def text() -> str:
    """The page."""
    kinds = dict[type, None]()
    shown = [_preset(name, kinds) for name in presets.PRESETS]
    meanings = [_class(kind) for kind in sorted(kinds, key=lambda kind: kind.__name__) if _options(kind)]
    return "\n".join([HEAD, *shown, "## Meanings\n", *meanings]).rstrip() + "\n"


def _leaves(value: Any, path: str = "", owner: type | None = None) -> Iterator[tuple[str, Any, type | None]]:
    """Keys, values and the class that holds each; a part is its own leaf where it has no options."""
    if isinstance(value, Passes):
        for name, row in value.items():
            yield from _leaves(row, f"{path}.{name}", type(row))
    elif is_dataclass(value) and not isinstance(value, type) and _options(type(value)):
        for option in _options(type(value)):
            yield from _leaves(getattr(value, option), f"{path}.{option}" if path else option, type(value))
    elif isinstance(value, list | tuple) and value and all(is_dataclass(item) for item in value):
        for i, item in enumerate(value):
            yield from _leaves(item, f"{path}.{i}", type(item))
    else:
        yield path, value, owner


def _options(kind: type) -> list[str]:
    return [field.name for field in fields(kind) if field.init]


def _preset(name: str, kinds: dict[type, None]) -> str:
    """The section of a preset: all its keys, or those in which it differs from `gco`."""
    make = presets.PRESETS[name]
    plane, space = ({key: (value, kind) for key, value, kind in _leaves(make(d))} for d in (2, 3))
    kinds |= {kind: None for _, kind in (*plane.values(), *space.values()) if kind is not None}
    keys, said = list(dict.fromkeys([*plane, *space])), inspect.cleandoc(make.__doc__ or "").split("\n\n")[0]
    lines = [f"### {name}\n", " ".join(said.split()), ""]
    if name in VARIANTS:
        plain = [{key: value for key, value, _ in _leaves(presets.PRESETS[BASE](d))} for d in (2, 3)]
        parts = list(zip(plain, (plane, space), strict=True))
        equal = [key for key in keys if all(key in a and key in b and a[key] == b[key][0] for a, b in parts)]
        lines += [f"The other keys are those of [{BASE}](#{BASE}).", ""]
        keys = [key for key in keys if key not in equal]
    rows = []
    for key in keys:
        kind = (plane.get(key) or space[key])[1]
        values = [_shown(keys_of[key][0]) if key in keys_of else "-" for keys_of in (plane, space)]
        rows.append(f"| `{key}` | {values[0]} | {values[1]} | {_link(kind)} |")
    return "\n".join([*lines, "| key | plane | space | class |", "|---|---|---|---|", *rows, ""])


def _link(kind: type | None) -> str:
    return "" if kind is None or not _options(kind) else f"[{kind.__name__}](#options-of-{kind.__name__.lower()})"


def _class(kind: type) -> str:
    """The section of a class: what each option means, its range with the unit, and its default."""
    ranges, meanings = dict(_rules(kind)), meanings_of(kind)
    said = " ".join(inspect.cleandoc(kind.__doc__ or "").split("\n\n")[0].split())
    rows = []
    for field in fields(kind):
        if field.init:
            needed = field.default is MISSING and field.default_factory is MISSING
            default = "needed" if needed else _shown(_default(field))
            rule = ranges[field.name].one if field.name in ranges else ""
            rows.append(f"| `{field.name}` | {_cell(meanings.get(field.name, ''))} | {_cell(rule)} | {default} |")
    head = ["| option | meaning | value | default |", "|---|---|---|---|"]
    return "\n".join([f"### Options of {kind.__name__}\n", said, "", *head, *rows, ""])


def _default(field: Any) -> Any:
    return field.default if field.default is not MISSING else field.default_factory()


def meanings_of(kind: type) -> dict[str, str]:
    """What the docstring of a class, or one that it refers to, says of each option."""
    text = inspect.cleandoc(kind.__doc__ or "")
    inside = re.search(r"^Args:\n((?: {4}.*\n?|\n)+)", text, re.MULTILINE)
    texts: dict[str, str] = {}
    for names, words in ENTRY.findall(inside[1] if inside else ""):
        for name in names.split(", "):
            texts[name] = _resolved(name, " ".join(words.split()))
    return texts


def _resolved(name: str, words: str) -> str:
    """The words of another class in the place of a reference to it."""
    reference = SAME.fullmatch(words)
    if reference is None:
        return words
    kinds = {kind.__name__: kind for kind in _known()}
    kind, more = kinds.get(reference[1]), reference[2]
    meaning = meanings_of(kind).get(name, "") if kind else ""
    return f"{meaning}{more}" if meaning else words


def _known() -> Iterator[type]:
    """All classes of the search and the solvers."""
    import torchgco.search
    from torchgco.search import steps

    for module in (torchgco, torchgco.search, steps):
        yield from (value for value in vars(module).values() if isinstance(value, type) and is_dataclass(value))


def _shown(value: Any) -> str:
    """A value in the grammar of the command line."""
    if is_dataclass(value):
        return _link(type(value)) if _options(type(value)) else f"`{type(value).__name__}()`"
    if isinstance(value, list | tuple) and any(is_dataclass(item) for item in value):
        return ", ".join(dict.fromkeys(_shown(item) for item in value))
    return f"`{json.dumps(value)}`".replace("|", "\\|") if value != () else "`[]`"


def _cell(words: str) -> str:
    return words.replace("|", "\\|")
