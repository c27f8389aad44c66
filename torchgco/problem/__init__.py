"""Problem: dynamics, cost, constraints and goal of a batch, joined and tried once."""
