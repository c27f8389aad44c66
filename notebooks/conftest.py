"""Notebooks that fly for long are run with the slow tests."""

import pytest

# 20 to 75 s of processor time each; what they show is tested elsewhere, too
LONG = ("learning.ipynb", "maps.ipynb", "missions.ipynb", "paper.ipynb")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.parent.name == "notebooks" and item.path.name in LONG:
            item.add_marker(pytest.mark.slow)
