"""Batched local solvers: iLQR with the augmented Lagrangian around it, and an interior point.

`contracts.Solver` is what a solver is: `solve` opens a `session`, and `run` is the method itself.
`augmented_lagrangian` is the outer loop (Algorithm 4), `interior` the interior point; `ending` gives the statuses,
`timing` frees the time. It imports `kernels` and knows no search. Begin with `contracts.py`.
"""

from torchgco.ilqr.line_search import LineSearch as LineSearch
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian as AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR as ILQR
from torchgco.solvers.interior import InteriorPoint as InteriorPoint
from torchgco.solvers.memory import plan_batch as plan_batch
