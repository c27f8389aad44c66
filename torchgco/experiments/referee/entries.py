"""A folder of entries: layouts, and for each entrant a card and files of controls; docs/referee.md has the rule."""

from __future__ import annotations

import datetime
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from torchgco.base.errors import InputError, first_line, shown
from torchgco.base.files import regular

CARD, LAYOUTS, ENTRIES = "entry.toml", "layouts", "entries"
CARD_BYTES, TEXT_LETTERS = 2**16, 1000  # of a card, and of one of its texts, at most
ENDINGS = (".npz", ".csv")


@dataclass(frozen=True)
class Entry:
    """The card of an entry: all texts of its own, which nothing confirms.

    Args:
        name: of the solver.
        authors: who enters it.
        method: what it is, in a sentence or two.
        hardware: processor and, where used, GPU; cores and threads.
        seeds: of all that is random, or "none"; how many were tried.
        time: what `seconds` count: wall or processor time, per layout or of a batch divided by its layouts, and what is
            left out.
        date: of the flights.
        version: of the code.
        link: of a paper or the code, https:// or http://.
        folder: of the entry.
    """

    name: str
    authors: str
    method: str
    hardware: str
    seeds: str
    time: str
    date: str
    version: str = ""
    link: str = ""
    folder: Path = Path()

    @property
    def id(self) -> str:
        return self.folder.name

    @classmethod
    def read(cls, folder: Path) -> Entry:
        """The entry in a folder; InputError where its card is missing, unreadable or lacks a text."""
        path = folder / CARD
        card = {field.name: field for field in fields(cls) if field.name != "folder"}
        values = {key: _text(path, key, value) for key, value in _toml(path).items()}
        for key in values:
            if key not in card:
                near = get_close_matches(key, card, n=1) or [", ".join(card)]
                raise InputError(str(path), f"a key of a card, such as {near[0]}", key)
        for key, field in card.items():
            if field.default != "" and not values.get(key):
                raise InputError(str(path), f"a text for {key}", "none")
        if (link := values.get("link", "")) and not link.startswith(("https://", "http://")):
            raise InputError(str(path), "a link that begins with https:// or http://", shown(link))
        return cls(**values, folder=folder)

    def files(self, layouts: list[str]) -> dict[str, Path]:
        """The files of controls by the names of their layouts.

        Raises:
            InputError: none, two for the same layouts, or one of no layouts of the board.
        """
        paths: dict[str, Path] = {}
        for path in sorted(self.folder.iterdir()):
            if path.suffix.lower() in ENDINGS:
                if path.stem not in layouts:
                    raise InputError(str(path), f"the name of layouts: {', '.join(layouts)}", path.stem)
                if path.stem in paths:
                    raise InputError(str(path), "one file for the same layouts", f"{paths[path.stem].name}, too")
                paths[path.stem] = path
        if not paths:
            raise InputError(str(self.folder), f"controls, such as {layouts[0]}.npz", "none")
        return paths


def entries_of(folder: Path) -> Iterator[Path]:
    """The folders of entries, by name.

    Raises:
        InputError: there is no such folder, or none in it.
    """
    inside = folder / ENTRIES
    folders = sorted(path for path in inside.iterdir() if path.is_dir()) if inside.is_dir() else []
    if not folders:
        raise InputError("--board", f"a folder with entries in {ENTRIES}, each with its {CARD}", folder)
    yield from folders


def layouts_of(folder: Path) -> list[Path]:
    """The files of layouts, by name; InputError where there is none."""
    files = sorted((folder / LAYOUTS).glob("*.npz"))
    if not files:
        raise InputError("--board", f"a folder with layouts in {LAYOUTS}, such as forest.npz", folder)
    return files


def _toml(path: Path) -> dict[str, Any]:
    try:
        with open(regular(path), "rb") as file:
            text = file.read(CARD_BYTES + 1)
        if len(text) > CARD_BYTES:
            raise ValueError(f"more than {CARD_BYTES} bytes")
        return tomllib.loads(text.decode())
    except FileNotFoundError:
        raise InputError(str(path), "the card of an entry", "none") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(str(path), "a readable TOML file", first_line(error)) from None


def _text(path: Path, key: str, value: Any) -> str:
    """A value of a card as one line of text."""
    if isinstance(value, bool) or not isinstance(value, str | int | float | datetime.date):
        raise InputError(str(path), f"a text for {key}", shown(value))
    text = " ".join(str(value).split())
    if len(text) > TEXT_LETTERS:
        raise InputError(str(path), f"at most {TEXT_LETTERS} letters for {key}", len(text))
    return text
