"""Measurements of torchgco. Not part of the package."""
