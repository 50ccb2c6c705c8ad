"""How parallel kernels are launched: safely from several Python threads, the same result with any number of cores.

Numba picks the best threading layer that it finds (TBB, OpenMP, its own ``workqueue``) when the first parallel
kernel runs. ``workqueue`` aborts the process when two Python threads launch at once; with it launches take turns.

After the first launch with GNU OpenMP a process must not fork: worker processes are to be spawned.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import numba

# Reordering is allowed; assumptions about NaN and infinity are not, for the tests on them must hold.
FAST: Final = {"contract", "reassoc", "nsz", "arcp"}

_turn = threading.RLock()


def threading_layer() -> str:
    """Return the name of numba's threading layer, or "" as long as no parallel kernel has run."""
    try:
        return str(numba.threading_layer())
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
