"""C as one text: a compiler needs no folder, and the bits of a library no file but its own."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

C = Path(__file__).parent / "c"
# A file includes others of its own by their places beside it, once each; these lines go.
_OWN = re.compile(r'^#(?:include "([^"]+)"( /\*.*\*/)?|pragma once)\n', re.MULTILINE)


def included(*names: str) -> str:
    """Lines that include these files."""
    return "".join(f'#include "{name}"\n' for name in names)


def joined(text: str, folder: Path = C, given: Mapping[str, str] | None = None) -> str:
    """A text with all files that it includes, and that these include, once each, in this order.

    Args:
        folder: where the text's own includes begin.
        given: texts that stand for files of these names.
    """
    texts, seen = dict(given or {}), set[Path]()

    def expanded(text: str, folder: Path) -> str:
        def once(line: re.Match[str]) -> str:
            path = (folder / line[1]).resolve() if line[1] else None
            if path is None or path in seen:
                return ""
            seen.add(path)
            return expanded(texts[line[1]] if line[1] in texts else path.read_text(), path.parent)

        return _OWN.sub(once, text)

    return expanded(text, folder)
