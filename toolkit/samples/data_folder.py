"""Data sets of the registry in folders of one's own, where captures are looked for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from toolkit.errors import RunError
from toolkit.files import disk_errors
from toolkit.progress import Progress, silent
from toolkit.samples.data_set import DataSet
from toolkit.samples.registry import fetch, locate

#: Hidden, so that half of a data set is never taken for a capture.
_FETCHING = ".fetching"


def locate_in(data_set: DataSet, roots: Sequence[Path]) -> Path | None:
    """Return where a data set is: whole in one of the folders, or where ``TOOLKIT_DATA`` says; None for nowhere.

    Raises
    ------
    DataError
        When ``TOOLKIT_DATA`` names no folder.
    """
    places = (locate(data_set, cache=root) for root in roots)
    return next((place for place in places if place is not None), None)


def fetch_into(
    data_set: DataSet, root: Path, *, allow_unverified: bool = False, progress: Progress = silent
) -> Path:
    """Return the folder of a data set, downloading it to ``root`` where it is not there.

    What is not complete yet lies in a hidden folder of ``root``; the next attempt goes on with it. Parameters and
    errors are those of :func:`toolkit.samples.registry.fetch`.
    """
    found = locate_in(data_set, [root])
    if found is not None:
        return found
    final = root / data_set.name
    if final.exists():
        raise RunError(f"{final} is in the way", expected="nothing there", todo="Move it away and fetch again")
    part = fetch(data_set, cache=root / _FETCHING, allow_unverified=allow_unverified, progress=progress)
    if part.parent.resolve() != (root / _FETCHING).resolve():
        return part
    with disk_errors(final, "finishing"):
        part.rename(final)
    return final
