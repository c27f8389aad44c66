"""The interior point and MPPI's rounds in PyTorch: any device, any dtype, any code that PyTorch can differentiate."""
