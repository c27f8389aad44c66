"""Links and names of files lead somewhere, Python runs, and commands are accepted by the programs they call.

All Python blocks of a page share one namespace and run in order; no two pages share one.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import shlex
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from torch import Tensor

import torchgco
from benchmarks.families import oracle, quality
from benchmarks.lib.command import Command
from benchmarks.speed import __main__ as speed
from tests.slow import mostly
from torchgco import Problem, presets
from torchgco.constraints import Constraint
from torchgco.experiments.config.build import compose_config
from torchgco.experiments.dataset import command as dataset
from torchgco.experiments.ending import RunParser
from torchgco.experiments.referee import judge
from torchgco.experiments.reports import export, identify, report, view
from torchgco.kernels import EagerWarning
from torchgco.native import store
from torchgco.native.compiler import find_compiler

ROOT = Path(__file__).resolve().parents[1]
GENERATED = ROOT / "docs" / "api"
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
PAGES += [
    page
    for folder in ("docs", "benchmarks")
    for page in sorted((ROOT / folder).rglob("*.md"))
    if GENERATED not in page.parents
]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?<=\n\n)(?:    .*\n)+")
PYTHON, SHELL = "python", "sh"
INSTALLS = ("pip install -e .", "pip install 'torchgco[cluster]'", "pip install 'torchgco[ray]'")
TARGETS = {"quality": quality, "ladder": quality, "oracle": oracle, "benchmark": speed, "benchmark-gpu": speed}


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Language and text of the code blocks of a page; an indented block is Python where it begins with an import."""
    text = page.read_text()
    yield from FENCE.findall(text)
    for block in INDENTED.findall(FENCE.sub("", text)):
        lines = [line[4:] for line in block.splitlines()]
        yield PYTHON if lines[0].startswith(("import ", "from ")) else SHELL, "\n".join(lines)


def commands(page: Path) -> list[str]:
    text = "\n".join(text for language, text in blocks(page) if language == SHELL).replace("\\\n", " ")
    return [line for line in text.splitlines() if re.match(r"(make|python|torchgco\S*|pip)( |$)", line)]


def links(page: Path) -> list[str]:
    """Targets of the links and images of a page, code left out."""
    text = re.sub(r"`[^`\n]*`", "", FENCE.sub("", page.read_text()))
    return re.findall(r"\]\(([^)\s]+)\)", text)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings."""
    names = (
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")
        for heading in re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    )
    found: dict[str, int] = {}
    for name in names:
        found[name] = found.get(name, 0) + 1
    return {name if i == 0 else f"{name}-{i}" for name, count in found.items() for i in range(count)}


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


REPORTS: dict[str, Callable[[list[str]], Any]] = {
    f"torchgco-{module.__name__.rpartition('.')[2]}": module.main for module in (report, view, export, identify, judge)
} | {"torchgco-dataset": dataset.main}


def accept(command: str) -> None:
    """Raise, or exit, unless the program accepts the command's arguments; runs nothing."""
    program, *words = shlex.split(command, comments=True)
    if program == "torchgco" and words[:1] == ["new"]:
        assert len(words) == 2
    elif program == "torchgco":
        accept_overrides([word for word in words if word not in ("--help", "--version")])
    elif program in REPORTS:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RunParser, "run", lambda parser, arguments, work: parser.parse_intermixed_args(arguments))
            options = REPORTS[program](words)
        assert program != "torchgco-report" or options.folders or options.power
        accept_overrides(getattr(options, "words", []))
    elif program == "make":
        accept_make(words)
    elif program == "python":
        accept_python(words)
    else:
        assert command.split(" #")[0].strip() in INSTALLS


def accept_make(words: list[str]) -> None:
    rules = (ROOT / "Makefile").read_text()
    arguments = shlex.split(" ".join(word.removeprefix("ARGS=") for word in words if word.startswith("ARGS=")))
    for target in (word for word in words if "=" not in word):
        assert re.search(rf"^{target}:", rules, re.MULTILINE), target
        if target in TARGETS:
            TARGETS[target]._parser().parse_args(arguments)
        elif target == "study":
            accept_overrides(arguments)


def accept_overrides(words: list[str]) -> None:
    """Every combination of a sweep composes."""
    given = OverridesParser.create().parse_overrides([word for word in words if word != "-m"])
    if "-m" not in words:
        assert not any(override.is_sweep_override() for override in given)
    (jobs,) = BasicSweeper.split_arguments(given, None)
    for overrides in jobs:
        compose_config([word for word in overrides if not word.startswith("hydra.")])


def accept_python(words: list[str]) -> None:
    if words[0] != "-m":
        assert (ROOT / words[0]).is_file()
        return
    module = importlib.util.find_spec(words[1])
    assert module is not None and module.origin is not None
    imported = importlib.import_module(words[1])
    if isinstance(getattr(imported, "main", None), Command):
        imported.main.parser.parse_args(words[2:])
    elif hasattr(imported, "_parser"):
        imported._parser().parse_args(words[2:])
    else:
        text = Path(module.origin).read_text()
        assert all(f'"{word}"' in text for word in words[2:] if word.startswith("--"))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in links(page):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_the_manual_lists_its_pages() -> None:
    contents = ROOT / "docs" / "README.md"
    assert {page.name for page in contents.parent.glob("*.md")} - {contents.name} <= set(links(contents))


MANUAL = [page for page in PAGES if page.parent != ROOT / "benchmarks" / "results" and page.name != "CHANGELOG.md"]


@pytest.mark.parametrize("page", MANUAL, ids=name_of)
def test_every_file_that_is_named_exists(page: Path) -> None:
    for name in re.findall(r"`((?:torchgco|tests|conf|docs)/[\w./-]+)`", page.read_text()):
        assert "NAME" in name or name == "docs/api" or (ROOT / name).exists(), name


def test_every_variable_of_the_environment_has_its_line() -> None:
    text = (ROOT / "docs" / "environment.md").read_text()
    sources = [path.read_text() for path in (ROOT / "torchgco").rglob("*.py")]
    read = {name for source in sources for name in re.findall(r"\bTORCHGCO_[A-Z]+\b", source)}
    assert read == set(re.findall(r"^\| `(TORCHGCO_\w+)`", text, re.MULTILINE)) and len(read) == 4
    assert f"at most {store.FILES} files" in text and f"{store.KIN} files of each kind" in text


def test_where_is_what_names_what_is_there() -> None:
    text = (ROOT / "docs" / "extending.md").read_text()
    rows = re.findall(r"^\| (?!question).*\|$", text[text.index("\n## Where is what\n") :], re.MULTILINE)
    assert len(rows) > 10
    for row in rows:
        _, files, names = row.strip("| ").split(" | ")
        sources = [(ROOT / name).read_text() for name in re.findall(r"`([^`]+)`", files)]
        for name in re.findall(r"`([^`]+)`", names):
            made = rf"(?:def|class|void|int) {name}\b|\b{name}(?::| =)"
            assert any(re.search(made, source) for source in sources), row


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=name_of)
def test_every_command_is_accepted(page: Path) -> None:
    for command in commands(page):
        accept(command)


def help_lines() -> list[str]:
    """The commands and keys that `torchgco --help` shows, without what it says of them."""
    held: Any = OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / "config.yaml"), resolve=False)
    template: str = held["hydra"]["help"]["template"]
    examples = template[template.index("Examples") :]
    return re.findall(r"^ {2,4}(torchgco\S*(?: \S+)*|[\w./]+=\S+(?: [\w./]+=\S+)*)(?: {2,}|$)", examples, re.MULTILINE)


def test_every_command_and_key_of_the_help_page_is_accepted() -> None:
    lines = help_lines()
    assert len([line for line in lines if line.startswith("torchgco")]) >= 8 and len(lines) >= 20
    for line in lines:
        if line.startswith("torchgco"):
            accept(line)
    keys = [word for line in lines if not line.startswith(("torchgco", "mission=null")) for word in shlex.split(line)]
    closed_loop = [word for word in keys if word.startswith(("mission.", "plant."))]
    experiments = [word for word in keys if word.startswith("experiment=")]
    accept_overrides([word for word in keys if word not in (*closed_loop, *experiments)])
    for words in ([experiments[0], *closed_loop], experiments[1:], ["mission=null", "plant=null"]):
        accept_overrides(words)


def run(page: Path) -> dict[str, object]:
    """Run the Python blocks of a page in order, in one namespace; returns that namespace."""
    names: dict[str, object] = {"__name__": page.name}
    for language, text in blocks(page):
        if language == PYTHON:
            # A reader's file lacks this file's future statement.
            exec(compile(text, page.name, "exec", dont_inherit=True), names)
    return names


RUN = [page for page in PAGES if any(language == PYTHON for language, _ in blocks(page))]


@pytest.mark.parametrize("page", mostly(RUN, *(page for page in RUN if page.name == "free_time.md")), ids=name_of)
def test_every_python_block_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if page.name in ("receding.md", "gradients.md") and find_compiler() is None:
        pytest.skip("no C compiler, which compiled problems and forward_ad.dual_level need")
    if page.name == "gym.md":
        pytest.importorskip("gymnasium")
    monkeypatch.chdir(tmp_path)  # where a page may write
    with warnings.catch_warnings():
        if find_compiler() is not None:
            warnings.simplefilter("error", EagerWarning)
        names = run(page)
    for problem in names.values():
        for part in problem.constraints if isinstance(problem, Problem) else ():
            if type(part).__module__ == page.name:  # native kernels do not call `accumulate`
                check_expansion(problem, part)


def check_expansion(problem: Problem, part: Constraint) -> None:
    """`accumulate` against autodiff of `value`."""
    B, N, n = problem.B, problem.N, problem.n
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=problem.x0.dtype)

    X, U = normal(B, N + 1, n), normal(B, N, problem.m)
    c = part.value(X, U)
    g, h = normal(*c.shape), normal(*c.shape)
    H = X.new_zeros(B, N + 1, n + 1 + problem.m, n + 1 + problem.m)
    part.accumulate(X, U, g, h, H)
    slopes = torch.autograd.functional.jacobian(lambda X, U: part.value(X, U).sum(0), (X, U))  # (K, p, B, N+1, n), ...
    z = torch.zeros(*c.shape[1:], B, N + 1, n + 1 + problem.m, dtype=X.dtype)
    z[..., :n], z[..., :-1, n + 1 :] = slopes
    gradient, product = torch.einsum("bkp,kpbts->bts", g, z), torch.einsum("bkp,kpbts,kpbtr->btsr", h, z, z)
    product[..., n] += gradient
    product[..., n, :] += gradient
    torch.testing.assert_close(H, product)


def test_every_extension_is_shown() -> None:
    parts = (ROOT / "docs" / "extending.md").read_text().split("\n## ")[1:]
    shown = {part.splitlines()[0]: part.count("```python\n") for part in parts}
    kinds = ("A model", "A cost", "A constraint", "A kind of obstacle", "A guidance", "A solver", "A scenario")
    assert shown == dict.fromkeys(kinds, 1) | {"Where is what": 0}


def program(name: str) -> Any:
    """A program of the manual, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_options_is_that_of_the_presets_and_their_docstrings() -> None:
    options = program("options")
    assert options.PAGE.read_text() == options.text(), "`make docs` writes it again"
    lines = options.text().splitlines()
    for name in presets.PRESETS:
        assert f"### {name}" in lines
    meanings = [line for line in lines[lines.index("## Meanings") :] if line.startswith("| `")]
    assert len(meanings) > 90 and not [line for line in meanings if "` |  |" in line or "as of `" in line]
    for option in ("| `passes.paths.num_paths` | `6` | `6` |", "| `passes.samples.redraws` | `2` | `3` |"):
        assert any(line.startswith(option) for line in lines), option
    assert any("`max_gap`" in line and "or null" in line and "twice as many paths" in line for line in meanings)


@pytest.mark.skipif(find_compiler() is None, reason="the figures watch native kernels")
def test_the_figures_of_the_algorithm_are_drawn(tmp_path: Path) -> None:
    page, figures = ROOT / "docs" / "algorithm.md", program("figures")
    before = page.read_text()
    assert figures.main(["--output", str(tmp_path)]) == 0
    assert page.read_text() == before, "`make figures` brings the page up to date"
    shown = [link for link in links(page) if link.startswith("figures/")]
    assert shown == [f"figures/{path.name}" for path in sorted(tmp_path.iterdir())]


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="studies in PyTorch alone take minutes")
def test_the_pictures_of_studies_are_drawn_and_small(tmp_path: Path) -> None:
    assert program("study_figures").main(["--output", str(tmp_path), "--layouts", "2", "2"]) == 0
    shown = {link for link in links(ROOT / "docs" / "studies.md") if link.startswith("figures/")}
    drawn = {f"figures/{path.name}" for path in tmp_path.iterdir()}
    assert drawn | {"figures/study-page.png"} == shown, "the page where there is a Chromium"
    for link in shown:
        assert (ROOT / "docs" / link).stat().st_size < 150e3, link


@pytest.mark.slow
def test_the_api_reference_opens_with_the_public_names(tmp_path: Path) -> None:
    """Without a warning of pdoc, such as one of a type that it doesn't find."""
    command = [sys.executable, str(ROOT / "docs" / "reference.py"), "--output", str(tmp_path)]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr, done.stderr
    shown = set(re.findall(r'<section id="(\w+)">', (tmp_path / "torchgco.html").read_text()))
    assert set(torchgco.__all__) - {"presets", "judge"} <= shown
    assert not list(tmp_path.rglob("native*"))
    for name in ("presets", "scenarios", "missions", "plotting"):
        assert (tmp_path / "torchgco" / f"{name}.html").is_file()


def test_every_public_name_exists() -> None:
    assert len(set(torchgco.__all__)) == len(torchgco.__all__)
    held = vars(torchgco).items()
    public = {name for name, value in held if getattr(value, "__module__", "").startswith("torchgco.")}
    assert public | {"compose", "presets", "read", "read_dataset"} == set(torchgco.__all__)
    for name in torchgco.__all__:
        assert getattr(torchgco, name) is not None


def test_a_wrong_command_is_not_accepted() -> None:
    wrong = ("make quantity", "torchgco solver=none", "pip install torchgco", 'make quality ARGS="--solver"')
    for command in (*wrong, "torchgco-report --verify", "torchgco-report outputs --power 1"):
        with pytest.raises((AssertionError, SystemExit, ValueError)):
            accept(command)
