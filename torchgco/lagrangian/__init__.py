"""The augmented Lagrangian, its expansion, and how good a trajectory is."""
