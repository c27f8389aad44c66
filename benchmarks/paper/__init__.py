"""The paper's figures, tables and missions, by our solvers: benchmarks/results/paper.md."""
