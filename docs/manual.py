"""The manual as a site: `make site`, into build/site, with version, API reference, and a search that needs a server.

Made by MkDocs and its theme Material from README.md, the pages of docs/, benchmarks/ and the top level, which keep
their places beside each other, so that their links hold; and by pdoc (docs/reference.py). A link that leads nowhere is
an error.
"""

from __future__ import annotations

import argparse
import logging
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import reference
from mkdocs.commands.build import build
from mkdocs.config.defaults import MkDocsConfig
from pymdownx.slugs import slugify

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "site"
KINDS = {".md", ".png", ".gif", ".jpg", ".svg", ".csv", ".ipynb", ".py", ".cff", ".html"}
LINK = re.compile(r"\[([^\]]*)\]\(([^)#\s]+)\)")
SECTION = re.compile(r"^## (.+)$", re.MULTILINE)
ENTRY = re.compile(r"^- \[([^\]]+)\]\((\w+\.md)\)", re.MULTILINE)


def main(words: list[str] | None = None) -> int:
    """Make the site; the status is that of the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--output", type=Path, default=FOLDER)
    output = parser.parse_args(words).output.resolve()
    pages = output.parent / f"{output.name}-pages"
    shutil.rmtree(pages, ignore_errors=True)
    _gather(pages)
    reference.main(["--output", str(pages / "api")])
    number = version("torchgco")
    config: dict[str, Any] = {
        "site_name": f"torchgco {number}", "docs_dir": str(pages), "site_dir": str(output), "strict": True,
        "use_directory_urls": False, "theme": _theme(), "nav": _contents(), "plugins": ["search"],
        "markdown_extensions": [
            {"toc": {"slugify": slugify(case="lower"), "permalink": True}}, "tables", "admonition", "attr_list",
            "pymdownx.superfences", {"pymdownx.highlight": {"use_pygments": True}}, "md_in_html",
        ],
        "validation": {"nav": {"omitted_files": "ignore", "not_found": "ignore"}, "links": {"anchors": "warn"}},
    }  # fmt: skip
    logging.basicConfig(format="%(message)s", level=logging.WARNING)  # which link, where the site isn't made
    site = MkDocsConfig(config_file_path=str(ROOT / "mkdocs.yml"))
    site.load_dict(config)
    errors, warnings = site.validate()
    if errors or warnings:
        raise SystemExit(f"{errors or warnings}")
    site.plugins.on_startup(command="build", dirty=False)
    build(site)
    shutil.rmtree(pages)
    print(f"wrote {output / 'index.html'}")
    return 0


def _theme() -> dict[str, Any]:
    """Light or dark as the reader's system is; nothing is loaded from elsewhere."""
    schemes = [("(prefers-color-scheme: light)", "default"), ("(prefers-color-scheme: dark)", "slate")]
    palette = [{"media": media, "scheme": scheme, "primary": "indigo"} for media, scheme in schemes]
    return {"name": "material", "font": False, "palette": palette, "features": ["navigation.sections", "toc.follow"]}


def _contents() -> list[dict[str, Any]]:
    """The pages in the sections of docs/README.md, which lists all of them."""
    text = (ROOT / "docs" / "README.md").read_text()
    titles = list(SECTION.finditer(text))
    contents: list[dict[str, Any]] = [{"torchgco": "README.md"}, {"Contents and index": "docs/README.md"}]
    for title, after in zip(titles, [*titles[1:], None], strict=True):
        pages = ENTRY.findall(text[title.end() : after.start() if after else None])
        if pages:
            contents.append({title[1]: [{name.replace("`", ""): f"docs/{page}"} for name, page in pages]})
    api = {"API": "api/index.html"}
    return [*contents, api, {"Benchmarks": "benchmarks/README.md"}, {"Changes": "CHANGELOG.md"}]


def _gather(pages: Path) -> None:
    """Copy what git tracks of pages and what they show."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in map(Path, listed.splitlines()):
        if name.suffix not in KINDS or name.parts[0] in ("torchgco", "tests", "conf"):
            continue
        (pages / name).parent.mkdir(parents=True, exist_ok=True)
        if name.suffix == ".md":
            (pages / name).write_text(_without_folders(ROOT / name))
        else:
            shutil.copyfile(ROOT / name, pages / name)


def _without_folders(page: Path) -> str:
    """The text of a page, with words in place of links to folders, for which a site has no page."""
    return LINK.sub(lambda link: link[1] if (page.parent / link[2]).is_dir() else link[0], page.read_text())


if __name__ == "__main__":
    sys.exit(main())
