"""Costs of trajectories."""

from torchgco.costs.base import Cost as Cost
from torchgco.costs.quadratic import QuadraticCost as QuadraticCost
