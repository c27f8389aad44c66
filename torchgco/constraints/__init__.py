"""Constraints: a function, a sense, and the knots at which it holds."""

from torchgco.constraints.base import Constraint as Constraint
from torchgco.constraints.base import FunctionConstraint as FunctionConstraint
from torchgco.constraints.bodies import CONTACT_FACTOR as CONTACT_FACTOR
from torchgco.constraints.bodies import Obstacles as Obstacles
from torchgco.constraints.bounds import ControlBounds as ControlBounds
from torchgco.constraints.bounds import StateBounds as StateBounds
from torchgco.constraints.boxes import Boxes as Boxes
from torchgco.constraints.capsules import Capsules as Capsules
from torchgco.constraints.equalities import FirstStepRates as FirstStepRates
from torchgco.constraints.equalities import ThrustSum as ThrustSum
from torchgco.constraints.obstacles import Spheres as Spheres
