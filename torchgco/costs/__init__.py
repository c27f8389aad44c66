"""Costs of trajectories.

`base.Cost` is what a cost must say: `stage` and `terminal`; the rest has defaults. `quadratic` is the paper's, bound
to a problem's shapes, and the one that kernels read as numbers; `base.FunctionCost` holds users' functions. It
imports `base`.
"""

from torchgco.costs.base import Cost as Cost
from torchgco.costs.base import FunctionCost as FunctionCost
from torchgco.costs.quadratic import QuadraticCost as QuadraticCost
