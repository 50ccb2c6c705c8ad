"""Vectors from and to arrays, as in :mod:`toolkit.geometry.simd_memory`."""

from toolkit.geometry.simd_memory import gather, load, prefetch, scatter, store, store_row

__all__ = ["gather", "load", "prefetch", "scatter", "store", "store_row"]
