"""The augmented Lagrangian, its expansion, rollouts, and how good a trajectory is."""
