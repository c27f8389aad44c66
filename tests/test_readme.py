"""What the README shows runs as it stands there."""

from pathlib import Path

import torch

from torchgco import Solution

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()


def test_the_python_example() -> None:
    block = README.split("## In Python")[1].split("## On the command line")[0]
    code = "\n".join(line[4:] for line in block.splitlines() if line.startswith("    "))
    names: dict[str, object] = {}
    exec(code.replace("N=60", "N=25"), names)
    solution = names["solution"]
    assert isinstance(solution, Solution) and bool(torch.isfinite(solution.cost).all())


def test_every_file_it_links_to_is_there() -> None:
    root = Path(__file__).resolve().parents[1]
    links = [part.split(")")[0] for part in README.split("](")[1:]]
    assert links and all((root / link).exists() for link in links if not link.startswith("http"))
