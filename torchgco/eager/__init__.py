"""The interior point and MPPI's rounds in PyTorch: any device, any dtype, any code that PyTorch can differentiate.

`loop` is the interior point of `native/c/interior.c` for what can't be traced: `kkt` gives its steps, and the filter of
`search` accepts them. `sampling` are MPPI's rounds. It imports `ilqr` and `lagrangian`. Begin with `loop.py`.
"""
