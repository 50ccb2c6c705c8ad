"""How the rasterizer's kernels are compiled and launched: as all are, see :mod:`toolkit.geometry.compiled`."""

from toolkit.geometry.compiled import (
    inlined_kernel,
    kernel,
    launching,
    parallel_kernel,
    thread_count,
    threading_layer,
)

__all__ = ["inlined_kernel", "kernel", "launching", "parallel_kernel", "thread_count", "threading_layer"]
