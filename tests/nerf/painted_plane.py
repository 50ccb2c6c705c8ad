"""The plane that radiance fields learn in tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def colours(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the plane's colours (n, 3), 0 to 1, at places (n, 2)."""
    return 0.5 + 0.4 * np.stack([np.sin(5 * xy[:, 0]), np.cos(4 * xy[:, 1]), np.sin(3 * xy.sum(axis=1))], axis=1)
