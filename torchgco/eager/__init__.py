"""The interior point in PyTorch's kernels: any device, any dtype, any code that PyTorch can differentiate."""
