"""Phases: problems one after the other, each with its own model, and jumps between them."""

from torchgco.phases.jump import Jump
from torchgco.phases.phases import Phases
from torchgco.phases.solution import PhasesSolution

__all__ = ["Jump", "Phases", "PhasesSolution"]
