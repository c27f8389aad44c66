"""Phases: problems one after the other, each with its own model, and jumps between them."""

from torchgco.phases.phases import Jump, Phases
from torchgco.phases.solution import OfPhases, PhasesSolution

__all__ = ["Jump", "OfPhases", "Phases", "PhasesSolution"]
