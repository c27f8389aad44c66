"""Families of layouts and of ordinary problems: how often the goal is reached, and at what cost."""
