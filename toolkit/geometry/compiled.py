"""How kernels are compiled and launched.

Numba picks the first threading layer that it finds (here OpenMP, TBB, its own ``workqueue``) when the first
parallel kernel runs. ``workqueue`` aborts the process when two Python threads launch at once; with it launches
take turns.

After the first launch with GNU OpenMP a process must not fork: worker processes are to be spawned.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba.np.ufunc import parallel

# Decorators. Types are left to numba: it knows the vectors of ``toolkit.geometry.simd``, Python does not.
# No fastmath: with reordered sums the code that a process compiles and the code that the next one finds in numba's
# cache round differently, and a resumed run would not equal the uninterrupted one.
kernel: Any = numba.njit(error_model="numpy", cache=True)
parallel_kernel: Any = numba.njit(error_model="numpy", cache=True, parallel=True)
inlined_kernel: Any = numba.njit(error_model="numpy", cache=True, forceinline=True)

_config: Any = numba.config
_turn = threading.RLock()


def threading_layer() -> str:
    """Return the name of numba's threading layer, or "" as long as no parallel kernel has run."""
    try:
        return str(parallel.threading_layer())
    except ValueError:
        return ""


def thread_count() -> int:
    """Return how many threads the kernels use. Numba chooses its threading layer by being asked."""
    _prefer_openmp()
    return int(numba.get_num_threads())


def _prefer_openmp() -> None:
    if not threading_layer():
        # Numba would try TBB first, and warn where another library (Open3D) has loaded one that is too old for it.
        _config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]


@contextmanager
def launching() -> Iterator[None]:
    """Hold this around parallel kernels; lets others in at the same time only where the layer can bear it."""
    _prefer_openmp()
    if threading_layer() in ("tbb", "omp"):
        yield
        return
    with _turn:
        yield
