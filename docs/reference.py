"""The API reference from the docstrings: `make docs`, into docs/api; and docs/options.md, the options of solvers.

The first page has what `torchgco` itself names; others have the packages that users import from besides. All else is
inside, and documented in the source.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import get_type_hints

import options
import pdoc

import torchgco

FOLDER = Path(__file__).parent / "api"
PAGES = (
    "torchgco", "torchgco.scenarios", "torchgco.missions", "torchgco.plotting", "torchgco.baselines",
    "torchgco.constraints", "torchgco.obstacles", "torchgco.solvers.contracts", "torchgco.lagrangian.penalties",
    "torchgco.base.draws", "torchgco.base.shapes",
)  # fmt: skip


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=FOLDER, help="elsewhere the reference alone is made")
    output = parser.parse_args(words).output
    for name in ("compose", "read", "read_dataset"):  # imported lazily: pdoc looks for them in the module
        vars(torchgco)[name] = getattr(torchgco, name)
    for page in pdoc.extract.walk_specs(PAGES):
        pdoc.extract.load_module(page)
    for kind in _classes():
        _resolve(kind)
    pdoc.render.configure(docformat="google")
    pdoc.pdoc(*PAGES, output_directory=output)
    if output == FOLDER:
        options.PAGE.write_text(options.text())
    return 0


def _classes() -> Iterator[type]:
    """All classes of the package that are loaded."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] == "torchgco":
            yield from (kind for kind in vars(module).values() if isinstance(kind, type) and kind.__module__ == name)


def _resolve(kind: type) -> None:
    """Give a generated constructor types instead of their names: pdoc would look those up in the wrong module.

    It looks for the names of inherited fields in the module of the subclass.
    """
    try:
        hints = get_type_hints(kind, include_extras=True)
    except NameError:  # imported for type checkers alone: pdoc itself looks there
        return
    if is_dataclass(kind):
        names = kind.__init__.__annotations__
        kind.__init__.__annotations__ = {name: hints.get(name, names[name]) for name in names}
    elif issubclass(kind, tuple) and hasattr(kind, "_fields"):
        kind.__new__.__annotations__ = hints


if __name__ == "__main__":
    sys.exit(main())
