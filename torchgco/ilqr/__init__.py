"""iLQR in PyTorch (Algorithm 2): an inner solve's options, backward pass, line search and one iteration."""
