"""Batched local solvers: iLQR with the augmented Lagrangian around it, and an interior point."""

from torchgco.ilqr.line_search import LineSearch as LineSearch
from torchgco.solvers.augmented_lagrangian import AugmentedLagrangian as AugmentedLagrangian
from torchgco.solvers.ilqr import ILQR as ILQR
from torchgco.solvers.interior import InteriorPoint as InteriorPoint
from torchgco.solvers.memory import plan_batch as plan_batch
