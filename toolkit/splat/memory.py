"""How many Gaussians fit into the memory: asked before a training, so that it does not die in the middle."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from toolkit.errors import StageError
from toolkit.splat.train_settings import TrainSettings

MEMINFO = Path("/proc/meminfo")
# The rest is for pictures, the interpreter and what else runs on the machine.
SHARE: Final = 0.8

_FLOAT: Final = 4
# Parameters, their gradients, two moments, and one more while density control rearranges them. Measured at degree 3
# with small Gaussians: 1150 bytes in all; what is counted here is more, for larger ones touch more tiles.
_COPIES: Final = 5
# Of a projected Gaussian: centre, footprint, factors, radius; gradients; a record of one cache line; sort keys.
_PROJECTED: Final = _FLOAT * (15 + 10 + 16) + 32
# An entry and a gradient slot for each tile that a Gaussian touches; in trained scenes that is a few on average.
_TILES: Final = 8 * (8 + 10 * _FLOAT)


def bytes_per_gaussian(sh_degree: int) -> int:
    """Return about how much memory training takes for each Gaussian, with the cpu backend."""
    parameters = 3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2
    return _COPIES * _FLOAT * parameters + _PROJECTED + _TILES


def free_memory(meminfo: Path = MEMINFO) -> int | None:
    """Return how many bytes can be taken without swapping, or None where the system does not say (not Linux)."""
    try:
        lines = meminfo.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    for line in lines:
        name, _, rest = line.partition(":")
        if name == "MemAvailable":
            return 1024 * int(rest.split()[0])
    return None


def most_gaussians(settings: TrainSettings, points: int, free: int | None) -> int:
    """Return ``max_gaussians``, or how many fit into the memory where that is fewer.

    Parameters
    ----------
    settings:
        Of the training.
    points:
        From which it starts.
    free:
        As :func:`free_memory` says.

    Raises
    ------
    StageError
        Where not even the first Gaussians fit.
    """
    if free is None:
        return settings.max_gaussians
    fit = int(SHARE * free / bytes_per_gaussian(settings.sh_degree))
    first = min(points, settings.max_gaussians)
    if fit < first:
        raise StageError(
            "The memory does not hold the first Gaussians",
            expected=f"{first * bytes_per_gaussian(settings.sh_degree) / SHARE / 1e9:.1f} GB for {first} Gaussians",
            found=f"{free / 1e9:.1f} GB that are free",
            todo="Close other programs, or lower max_gaussians or sh_degree",
        )
    return min(settings.max_gaussians, fit)
