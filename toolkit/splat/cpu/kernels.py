"""How kernels are compiled and launched.

Numba picks the best threading layer that it finds (TBB, OpenMP, its own ``workqueue``) when the first parallel
kernel runs. ``workqueue`` aborts the process when two Python threads launch at once; with it launches take turns.

After the first launch with GNU OpenMP a process must not fork: worker processes are to be spawned.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba
from numba.np.ufunc import parallel

# Decorators. Types are left to numba: it knows the vectors of :mod:`toolkit.splat.cpu.simd`, Python does not.
kernel: Any = numba.njit(error_model="numpy", cache=True)
parallel_kernel: Any = numba.njit(error_model="numpy", cache=True, parallel=True)
inlined_kernel: Any = numba.njit(error_model="numpy", cache=True, forceinline=True)
# Reordering is allowed; assumptions about NaN and infinity are not, for the tests on them must hold.
_REORDER = {"contract", "reassoc", "nsz", "arcp"}
reordering_kernel: Any = numba.njit(error_model="numpy", cache=True, fastmath=_REORDER)
reordering_parallel_kernel: Any = numba.njit(error_model="numpy", cache=True, parallel=True, fastmath=_REORDER)

_turn = threading.RLock()


def threading_layer() -> str:
    """Return the name of numba's threading layer, or "" as long as no parallel kernel has run."""
    try:
        return str(parallel.threading_layer())
    except ValueError:
        return ""


@contextmanager
def launching() -> Iterator[None]:
    """Hold this around parallel kernels; lets others in at the same time only where the layer can bear it."""
    if threading_layer() in ("tbb", "omp"):
        yield
        return
    with _turn:
        yield
