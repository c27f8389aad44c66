"""The paper's guidance: find where a trajectory is caught, sample a path past the obstacles, and attract it there."""

from torchgco.guidance.gco import GCO as GCO
from torchgco.guidance.mppi import MPPI as MPPI
