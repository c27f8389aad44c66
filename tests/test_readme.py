"""What the README shows runs as it stands there."""

from pathlib import Path

import torch

from torchgco import Problem, Solution, Status, judge

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()


def test_the_python_example() -> None:
    block = README.split("## In Python")[1].split("## On the command line")[0]
    code = "\n".join(line[4:] for line in block.splitlines() if line.startswith("    "))
    names: dict[str, object] = {}
    exec(code, names)
    problem, solution = names["problem"], names["solution"]
    assert isinstance(problem, Problem) and isinstance(solution, Solution)
    assert solution.statuses == [Status.CONVERGED] * 2
    assert bool(judge(problem, solution.U, torch.tensor([1.0, 0.4], dtype=torch.float64), 0.3).sound.all())


def test_every_file_it_links_to_is_there() -> None:
    root = Path(__file__).resolve().parents[1]
    links = [part.split(")")[0] for part in README.split("](")[1:]]
    assert links and all((root / link).exists() for link in links if not link.startswith("http"))
