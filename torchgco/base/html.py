"""A page in HTML, as notebooks show it and files hold it."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

from torchgco.base.files import write_whole

HEIGHT = 560  # pixels of a page in a notebook


@dataclass(frozen=True)
class HtmlPage:
    """A page; a notebook shows it, and `save` writes it into a file that needs neither notebook nor network.

    Args:
        html: the text of the whole page.
        title: in words, for readers that can't see it.
    """

    html: str
    title: str

    def _repr_html_(self) -> str:
        frame = f'width="100%" height="{HEIGHT}" style="border:0" title="{escape(self.title)}"'
        return f'<iframe srcdoc="{escape(self.html)}" {frame}></iframe>'

    def __repr__(self) -> str:
        return f"HtmlPage({self.title!r}, {len(self.html) / 1e6:.2f} MB; .save(path) writes it)"

    def save(self, path: str | Path) -> Path:
        """Write the page: all of it or, if interrupted, nothing. Raises OSError where the system refuses."""
        write_whole(path, lambda file: file.write(self.html.encode()))
        return Path(path)
