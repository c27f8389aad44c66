"""Tables as one HTML file that needs no network: each sorted by a click on a head, filtered by words."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from html import escape
from pathlib import Path

STATIC = Path(__file__).parent / "static"


@dataclass(frozen=True)
class Cell:
    """A cell.

    Args:
        text: as it is shown, of any origin: the page escapes it.
        value: a number by which its column is sorted; NaN: unknown. None: by the text.
        link: an address that begins with https:// or http://; None: no link.
    """

    text: str
    value: float | None = None
    link: str | None = None


@dataclass(frozen=True)
class Board:
    """A table of a page: `heads` with what each says in words, and rows of as many cells.

    Args:
        keys: columns that say what a row is; the last of them stays in sight where the others are scrolled away.
    """

    title: str
    heads: Sequence[tuple[str, str]]
    rows: Sequence[Sequence[Cell]]
    keys: int = 1


def page(title: str, about: str, boards: Sequence[Board], notes: Sequence[str] = ()) -> str:
    """The text of the file. All texts are escaped, and its own policy lets no script run but that of the page."""
    script, style = (STATIC / "page.js").read_text(), (STATIC / "page.css").read_text()
    values = {
        "title": escape(title),
        "about": escape(about),
        "policy": f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'",
        "style": style,
        "script": script,
        "tables": "\n".join(_section(board) for board in boards),
        "notes": "\n".join(f"<p>{escape(note)}</p>" for note in notes),
    }
    template = (STATIC / "page.html").read_text()
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}"


def _section(board: Board) -> str:
    numeric = [any(row[i].value is not None for row in board.rows) for i in range(len(board.heads))]
    heads = "".join(_head(*head, number) for head, number in zip(board.heads, numeric, strict=True))
    rows = "\n".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in board.rows)
    return (
        f'<section><h2>{escape(board.title)}</h2>\n<p class="filter"><label>Rows with the words <input type="search">'
        f'</label> <span class="count"></span></p>\n<div class="room">'
        f'<table class="keys-{board.keys}"><thead><tr>{heads}</tr></thead>'
        f"<tbody>\n{rows}\n</tbody></table></div></section>"
    )


def _head(name: str, words: str, number: bool) -> str:
    kind = ' class="number"' if number else ""
    return f'<th scope="col" aria-sort="none"{kind}><button title="{escape(words)}">{escape(name)}</button></th>'


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    if cell.link is not None:
        text = f'<a href="{escape(cell.link)}" rel="noreferrer noopener">{text}</a>'
    if cell.value is None:
        return f"<td>{text}</td>"
    return f'<td class="number" data-sort="{"" if cell.value != cell.value else repr(float(cell.value))}">{text}</td>'
