"""Data sets of solved trajectories: `command` makes them, `rows` writes and reads them, and says what they hold."""
