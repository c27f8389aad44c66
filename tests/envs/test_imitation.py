"""The example that imitates the planner, with few flights: it runs, and the planner reaches its goals."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("gymnasium")
EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "imitation.py"


@pytest.mark.slow
def test_the_example_trains_a_policy() -> None:
    small = ["--envs", "4", "--steps", "40", "--rounds", "2", "--epochs", "10", "--layouts", "4"]
    done = subprocess.run([sys.executable, str(EXAMPLE), *small], capture_output=True, text=True, check=True)
    reached = dict(re.findall(r"^(planner|policy): (\d) of 4 reached", done.stdout, re.MULTILINE))
    assert reached.keys() == {"planner", "policy"} and reached["planner"] == "4", done.stdout
