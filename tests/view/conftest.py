"""One headless Chromium for all tests of the page."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from tests.view.browser import Tab, browser, found


@pytest.fixture(scope="session")
def chromium() -> Iterator[Callable[[], Tab]]:
    """Opens tabs; where there is no Chromium, the test is skipped."""
    program = found()
    if program is None:
        pytest.skip("there is no Chromium")
    with browser(program) as new:
        yield new
