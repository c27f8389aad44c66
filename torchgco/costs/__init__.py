"""Costs of trajectories."""

from torchgco.costs.base import Cost as Cost
from torchgco.costs.function import FunctionCost as FunctionCost
from torchgco.costs.quadratic import QuadraticCost as QuadraticCost
