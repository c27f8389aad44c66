"""Why a solver misses where it misses."""
