"""C from a traced model, cost or constraint, and the file of a whole form of problems."""
