"""How many threads this process computes with: workers beside each other share the machine's cores."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from toolkit.errors import SettingsError

#: What libraries ask for when they are loaded.
VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Return on how many cores this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_threads(count: int) -> None:
    """Let PyTorch, the kernels, and libraries that are loaded from now on, compute with ``count`` threads.

    Raises
    ------
    SettingsError
        For more threads than there are cores.
    """
    if not 1 <= count <= cores():
        raise SettingsError("Cannot compute with so many threads", expected=f"1 to {cores()}", found=str(count))
    for name in VARIABLES:
        os.environ[name] = str(count)
    import numba
    import torch

    from toolkit.geometry.compiled import thread_count

    torch.set_num_threads(count)
    thread_count()  # numba chooses its threading layer by being asked: ours first
    # Fewer where numba was told so by its own variable before it was loaded.
    numba.set_num_threads(min(count, int(vars(numba.config)["NUMBA_NUM_THREADS"])))


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Compute with ``count`` threads, then with as many as before. Raises as :func:`use_threads`."""
    import numba
    import torch

    from toolkit.geometry.compiled import thread_count

    before = {name: os.environ.get(name) for name in VARIABLES}
    torch_before, numba_before = torch.get_num_threads(), thread_count()
    try:
        use_threads(count)
        yield
    finally:
        torch.set_num_threads(torch_before)
        numba.set_num_threads(numba_before)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
