"""The solvers that `gco` is compared with.

`casadi.CasADiSolver` hands a problem to IPOPT or FATROP by the program of `nlp`, in a process with a time limit
(`limited`); `mppi`, `pursuit` and `hold` are simpler methods. It imports `solvers`, CasADi where it is asked for.
"""

from torchgco.baselines.casadi import CasADiSolver as CasADiSolver
from torchgco.baselines.guided import GuidedCasADi as GuidedCasADi
from torchgco.baselines.hold import Hold as Hold
from torchgco.baselines.mppi import IteratedMPPI as IteratedMPPI
from torchgco.baselines.pursuit import PathPursuit as PathPursuit
