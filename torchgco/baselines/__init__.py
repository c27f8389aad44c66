"""The solvers that `gco` is compared with."""

from torchgco.baselines.casadi import CasADiSolver as CasADiSolver
from torchgco.baselines.guided import GuidedCasADi as GuidedCasADi
from torchgco.baselines.hold import Hold as Hold
from torchgco.baselines.mppi import IteratedMPPI as IteratedMPPI
from torchgco.baselines.pursuit import PathPursuit as PathPursuit
