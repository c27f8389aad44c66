"""Guidance: find where a trajectory is caught, and a region to pass through."""

from torchgco.guidance.detour import Detour as Detour
from torchgco.guidance.gco import GCO as GCO
from torchgco.guidance.mppi import MPPI as MPPI
from torchgco.guidance.roadmap import Roadmap as Roadmap
