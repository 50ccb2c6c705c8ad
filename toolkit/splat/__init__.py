"""Gaussian splats: parameters, rasterizers, density control and training."""
