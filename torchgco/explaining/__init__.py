"""What happened in a solve, in words: `Solution.explain`, and what it is told from."""
