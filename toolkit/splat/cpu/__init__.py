"""The rasterizer for CPUs: numba kernels with gradients by hand, float32, on all cores."""

from toolkit.splat.cpu.autograd import rasterize_cpu

__all__ = ["rasterize_cpu"]
