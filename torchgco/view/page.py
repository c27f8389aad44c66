"""The page: one HTML file with its style, its scripts, three.js and the data."""

from __future__ import annotations

import base64
import re
import zlib
from html import escape
from pathlib import Path

from torchgco.view.document import Document

HERE = Path(__file__).parent
STATIC, THREE = HERE / "static", HERE / "vendor" / "three"
# In the order in which each is loaded; a module imports only from those before it.
BUILT = {"three.core.min.js": THREE / "three.core.min.js", "three.module.min.js": THREE / "three.module.min.js"}
MODULES = (
    "data.js", "shapes.js", "camera.js", "vehicle.js", "tubes.js", "scenery.js", "missions.js", "flights.js",
    "searches.js", "hover.js", "panel.js", "main.js",
)  # fmt: skip
POLICY = "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; img-src data: blob:"


def page(document: Document) -> str:
    """The text of the file. It asks the network for nothing: its own policy forbids it, too."""
    built = {name: base64.b64encode(zlib.compress(path.read_bytes(), 9)) for name, path in BUILT.items()}
    scripts = [_text(name, content.decode(), "built") for name, content in built.items()]
    scripts += [_text(name, _inert((STATIC / name).read_text()), "module") for name in MODULES]
    data = [_text("head", document.head(), "data")]
    data += [_text(f"part-{i}", text, "data") for i, text in enumerate(document.parts)]
    data += [_text(f"map-{i}", text, "data") for i, text in enumerate(document.maps.values())]
    values = {
        "title": escape(document.title),
        "policy": POLICY,
        "licence": _inert((THREE / "LICENSE").read_text()).replace("--", "- -"),
        "three": (THREE / "VERSION").read_text().strip(),
        "style": (STATIC / "style.css").read_text(),
        "boot": _inert((STATIC / "boot.js").read_text()),
        "scripts": "\n".join((*scripts, *data)),
    }
    template = (STATIC / "page.html").read_text()
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


def _text(name: str, text: str, kind: str) -> str:
    """A script element that no browser runs, of a name and a kind that `boot.js` knows."""
    return f'<script type="text/plain" id="{name}" data-kind="{kind}">{text}</script>'


def _inert(text: str) -> str:
    """Text that can't end the script element that it stands in."""
    return re.sub(r"<(/script|!--)", r"<\\\1", text, flags=re.IGNORECASE)
