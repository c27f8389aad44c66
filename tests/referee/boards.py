"""A folder of entries, written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchgco import Layouts

DATA = Path(__file__).parents[2] / "benchmarks" / "data"
CARD = {
    "name": "Rest",
    "authors": "A. Body",
    "method": "It stays where it is.",
    "hardware": "one core of a processor",
    "seeds": "none",
    "time": "none is taken",
    "date": "2026-11-30",
}
NAMES = ("planar_trap", "walls")
SHAPES = {"planar_trap": (2, 200, 2), "walls": (2, 160, 4)}
HOSTILE = "<script>document.title='seen'</script><img src=x onerror=\"document.title='seen'\">"


def board(folder: Path) -> Path:
    """Two files of two layouts each, and no entry."""
    for name in NAMES:
        (folder / "layouts").mkdir(parents=True, exist_ok=True)
        Layouts.load(DATA / f"{name}.npz").take([0, 1]).save(folder / "layouts" / f"{name}.npz")
    return folder


def enter(folder: Path, entry: str, *names: str, U: np.ndarray | None = None, **card: Any) -> Path:
    """An entry in a folder, at rest in layouts of some names unless controls are given."""
    place = folder / "entries" / entry
    place.mkdir(parents=True)
    texts = {key: f"'''{value}'''" if isinstance(value, str) else value for key, value in (CARD | card).items()}
    lines = [f"{key} = {text}" for key, text in texts.items()]
    (place / "entry.toml").write_text("\n".join(lines))
    for name in names:
        np.savez(place / f"{name}.npz", U=np.zeros(SHAPES[name]) if U is None else U)
    return place
