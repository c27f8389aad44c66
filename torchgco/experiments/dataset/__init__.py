"""Data sets of solved trajectories: `command` makes them, `rows` writes and reads them, `card` says what they hold."""
