"""Newton steps on the active rows of a solution."""
