"""Missions solve a problem in every period: their kernels are worth the time of a better compilation."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="package", autouse=True)
def often_solved() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHGCO_CFLAGS", "-O1")
        yield
