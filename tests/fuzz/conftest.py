"""Settings of the random tests, and the counts of what they tried.

Every run draws the same examples; `--hypothesis-profile=search` draws new ones, ten times as many. With the variable
TORCHGCO_TALLY set to a path, the counts are added to that file at the end, for `make robustness`.
"""

import json
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.fuzz.tally import COUNTS

SHARED = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large]}
settings.register_profile("repeatable", derandomize=True, database=None, **SHARED)
settings.register_profile("search", print_blob=True, **SHARED)


def pytest_configure(config: pytest.Config) -> None:
    if not config.getoption("--hypothesis-profile", None):
        settings.load_profile("repeatable")


def pytest_sessionfinish() -> None:
    path = os.environ.get("TORCHGCO_TALLY")
    if path and COUNTS:
        worker = os.environ.get("PYTEST_XDIST_WORKER", "main")
        text = json.dumps([[*key, count] for key, count in COUNTS.items()])
        Path(f"{path}.{worker}.json").write_text(text)
