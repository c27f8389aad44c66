"""Constraints: a function, a sense, and the knots at which it holds."""

from torchgco.constraints.base import Constraint as Constraint
from torchgco.constraints.base import FunctionConstraint as FunctionConstraint
from torchgco.constraints.bounds import ControlBounds as ControlBounds
from torchgco.constraints.bounds import RateBounds as RateBounds
from torchgco.constraints.bounds import StateBounds as StateBounds
from torchgco.constraints.gates import Gates as Gates
from torchgco.constraints.link import Link as Link
from torchgco.constraints.norms import Cone as Cone
from torchgco.constraints.norms import NormBounds as NormBounds
from torchgco.constraints.separation import Separation as Separation
