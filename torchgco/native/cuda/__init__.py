"""Kernels for GPUs: the solvers' own C as CUDA C++, a problem or a sample per thread.

`source` joins the files of `native/c` with those here, which say how memory and numbers are laid out; `compiler` has
NVRTC compile them; `launch` brings structures to the device and back; `engine` has libraries whose functions run there.
"""
