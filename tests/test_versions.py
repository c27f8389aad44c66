"""The script `.ci/versions`: what it installs. The environments themselves take it many minutes."""

from __future__ import annotations

import sys
import tomllib
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def versions() -> ModuleType:
    loader = SourceFileLoader("versions", str(ROOT / ".ci" / "versions"))
    spec = spec_from_loader("versions", loader)
    assert spec is not None
    module = sys.modules["versions"] = module_from_spec(spec)  # dataclasses look their module up
    loader.exec_module(module)
    return module


def test_the_oldest_line_has_every_lower_bound(versions) -> None:
    found = versions.requirements(versions.LINES["oldest"], Path("/wheels/torchgco.whl"), PROJECT)
    assert found[0] == "torchgco @ file:///wheels/torchgco.whl"
    for requirement in PROJECT["dependencies"]:
        name, _, bound = requirement.partition(">=")
        assert f"{name}=={bound.split(',')[0]}" in found
    assert "pytest==8" in found and "hydra-core==1.3.6" in found


def test_other_lines_have_the_newest_versions(versions) -> None:
    lines = {name: line for name, line in versions.LINES.items() if not line.oldest}
    assert {line.python for line in lines.values()} == {"3.11", "3.12", "3.13"}
    for line in lines.values():
        found = versions.requirements(line, Path("/wheels/torchgco.whl"), PROJECT)
        assert found[0].startswith("torchgco[plants,maps] @ ") and not any("==" in requirement for requirement in found)
