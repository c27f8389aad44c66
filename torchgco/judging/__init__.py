"""What a trajectory is worth, by code that no solver shares: judge, certificate, contact."""
