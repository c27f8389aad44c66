"""The fixture that runs torchgco in this process."""

from tests.experiments.conftest import run as run
