"""Families of layouts and of constrained problems: how often the goal is reached, and at what cost."""
