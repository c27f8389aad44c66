"""Flights of a study: alone, by worker processes, in shares of a study; their progress."""
