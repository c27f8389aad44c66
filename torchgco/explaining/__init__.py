"""What happened in a solve, in words: `Solution.explain`, and the facts that it rests on."""
