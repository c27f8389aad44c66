"""The paper's guidance: find where a trajectory is caught, sample a way past, and attract the trajectory to it."""

from torchgco.guidance.gco import GCO as GCO
from torchgco.guidance.mppi import MPPI as MPPI
