"""python notebooks/store.py [NAME ...]: run the notebooks, and store what they show, without times or versions."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent
SECONDS = 600  # at most, per cell


def main(names: Sequence[str]) -> int:
    """Run the notebooks of these names, or all, each in a process of its own; a cell that fails ends this."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and path.stem not in names:
            continue
        print(f"running {path.name}", flush=True)
        notebook = nbformat.read(path, as_version=4)
        place = {"metadata": {"path": str(FOLDER)}}
        NotebookClient(notebook, timeout=SECONDS, record_timing=False, resources=place).execute()
        notebook.metadata.pop("language_info", None)  # the version of Python
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)  # times, which nbmake and editors leave
        nbformat.write(notebook, path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
