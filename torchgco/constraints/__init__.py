"""Constraints: a function, a sense, and the knots at which it holds.

`base.Constraint` is all that solvers, kernels, judge and explanations ask of one: rows, numbers, words, and what
becomes of it in other forms of a problem. A kind answers in its own file, and other rooms name none. `base.Distance`
is the interface of what keeps bodies apart. It imports `base`, `costs` and `dynamics`. Begin with `base.py`.
"""

from torchgco.constraints.base import Constraint as Constraint
from torchgco.constraints.base import FunctionConstraint as FunctionConstraint
from torchgco.constraints.between_knots import BetweenKnots as BetweenKnots
from torchgco.constraints.bounds import ControlBounds as ControlBounds
from torchgco.constraints.bounds import RateBounds as RateBounds
from torchgco.constraints.bounds import StateBounds as StateBounds
from torchgco.constraints.gates import Gates as Gates
from torchgco.constraints.link import Integral as Integral
from torchgco.constraints.link import Link as Link
from torchgco.constraints.norms import Cone as Cone
from torchgco.constraints.norms import NormBounds as NormBounds
from torchgco.constraints.separation import Separation as Separation
