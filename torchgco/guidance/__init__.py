"""The paper's guidance: find where a trajectory is caught, sample a path past the obstacles, and attract it there.

`gco.GCO` is the plug-in of the outer loop (Algorithm 4), which `AugmentedLagrangian` asks for a penalty; `mppi.MPPI`
is the sampler (Algorithm 3). It imports `solvers`. Begin with `gco.py`.
"""

from torchgco.guidance.gco import GCO as GCO
from torchgco.guidance.mppi import MPPI as MPPI
