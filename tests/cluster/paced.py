"""A solver that takes its time, for jobs that meet their time limit."""

import time
from dataclasses import dataclass

from torchgco.baselines import Hold


@dataclass(frozen=True)
class Paced(Hold):
    """Hold, but each batch takes some seconds."""

    seconds: float = 10.0

    def solve(self, problem, U0, seed=0, ids=None, warm=None, callback=None):
        time.sleep(self.seconds)
        return super().solve(problem, U0, seed, ids, warm, callback)
