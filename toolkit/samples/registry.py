"""The registry of real public data sets: what there is, where it is, and how to get it.

The entries are in ``registry.json`` beside this file. Their hashes are those of the public originals at a fixed
commit; a copy in the folder that ``TOOLKIT_DATA`` names may be smaller and is used as it is. A download is verified
file by file, and is there whole or not at all.
"""

from __future__ import annotations

import difflib
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import filelock
import pooch

from toolkit.errors import DataError, RunError, SettingsError
from toolkit.files import disk_errors, read_json, require_free_space, write_json
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.samples.data_set import MARKER, DataFile, DataSet, read_registry

_REGISTRY = Path(__file__).with_name("registry.json")
_STAGE = "data.fetch"
_TIMEOUT = 30.0
"""Seconds without an answer after which a server counts as silent."""
_CHUNK = 64 * 1024
"""Bytes after which progress is told, and a cancelled download stops."""


def data_sets() -> dict[str, DataSet]:
    """Return every entry of the registry that comes with the toolkit, by name."""
    return read_registry(_REGISTRY)


def find_data_set(name: str) -> DataSet:
    """Return the entry called ``name``.

    Raises
    ------
    SettingsError
        When there is none; the message names the closest ones.
    """
    sets = data_sets()
    if name not in sets:
        close = difflib.get_close_matches(name, sets, n=3)
        raise SettingsError(
            f"There is no data set '{name}'",
            expected=f"one of {', '.join(sorted(sets))}",
            todo=f"Did you mean {' or '.join(close)}?" if close else "",
        )
    return sets[name]


def default_cache() -> Path:
    """Return the folder that fetched sets go to: ``TOOLKIT_CACHE``, or the user's cache folder."""
    named = os.environ.get("TOOLKIT_CACHE")
    return Path(named) if named else Path(pooch.os_cache("sightline-toolkit"))


def locate(name: str | DataSet, *, cache: Path | None = None) -> Path | None:
    """Return the folder of a data set that is on this machine, or None.

    Looks below the folder that the environment variable ``TOOLKIT_DATA`` names, then for a whole download in
    ``cache`` (see :func:`default_cache`).

    Raises
    ------
    SettingsError
        When there is no such data set.
    DataError
        When ``TOOLKIT_DATA`` names no folder.
    """
    data_set = name if isinstance(name, DataSet) else find_data_set(name)
    named = os.environ.get("TOOLKIT_DATA")
    if named and data_set.local is not None:
        if not Path(named).is_dir():
            raise DataError(
                "TOOLKIT_DATA names no folder",
                expected="the folder that holds the data sets",
                found=named,
                todo="Correct it, or unset it to use the cache",
            )
        folder = Path(named) / data_set.local
        if folder.is_dir():
            return folder
    fetched = (cache if cache is not None else default_cache()) / data_set.name
    return fetched if _is_whole(fetched, data_set) else None


def _is_whole(folder: Path, data_set: DataSet) -> bool:
    """Return whether ``folder`` is a finished download of just these files of ``data_set``."""
    marker = folder / MARKER
    if not marker.is_file():
        return False
    record = read_json(marker)
    return isinstance(record, dict) and record.get("content") == data_set.content()


def fetch(
    name: str | DataSet, *, cache: Path | None = None, allow_unverified: bool = False, progress: Progress = silent
) -> Path:
    """Return the folder of a data set, downloading it where it is not on this machine.

    Files arrive in ``<cache>/<name>.part``; when all are there and verified the folder gets its marker
    ``data_set.json`` and its name. What a cancelled or failed download had complete is used by the next one.

    Parameters
    ----------
    name:
        Name in the registry, or an entry of one's own.
    cache:
        Folder that holds one folder a data set; by default ``TOOLKIT_CACHE`` or the user's cache folder.
    allow_unverified:
        Also fetch files whose hash the registry does not know. Nobody then says that they are what they seem.
    progress:
        Gets the bytes done; the total is None where a size is not known. Cancels by raising.

    Raises
    ------
    SettingsError
        When there is no such data set.
    DataError
        When the set can only be had by hand, a hash is not known or wrong, or the download fails.
    RunError
        When the disk is full, the folder may not be written or another process fetches the same set.
    """
    data_set = name if isinstance(name, DataSet) else find_data_set(name)
    root = cache if cache is not None else default_cache()
    found = locate(data_set, cache=root)
    if found is not None:
        return found
    _refuse(data_set, allow_unverified)
    require_free_space(root, "fetching into")
    with disk_errors(root, "preparing"):
        root.mkdir(parents=True, exist_ok=True)
    try:
        with filelock.FileLock(root / f".{data_set.name}.lock", timeout=0), _quiet_pooch():
            return _fetch_all(data_set, root, progress)
    except filelock.Timeout as error:
        raise RunError(
            f"Another process is fetching '{data_set.name}' into {root}", todo="Wait until it has finished"
        ) from error


def _refuse(data_set: DataSet, allow_unverified: bool) -> None:
    if data_set.by_hand:
        raise DataError(
            f"Data set '{data_set.name}' is not on this machine and cannot be downloaded",
            expected=f"a folder {data_set.local} below the one that TOOLKIT_DATA names",
            todo=data_set.how_to_get,
        )
    if data_set.unverified and not allow_unverified:
        raise DataError(
            f"Data set '{data_set.name}' cannot be verified",
            expected="a known hash for every file",
            found=f"none for {len(data_set.unverified)} of {len(data_set.files)}, the first being "
            f"{data_set.unverified[0]}",
            todo="Pass allow_unverified=True to fetch them all the same, or let TOOLKIT_DATA point to a copy that "
            "you trust",
        )


def _fetch_all(data_set: DataSet, root: Path, progress: Progress) -> Path:
    target, part = root / data_set.name, root / f"{data_set.name}.part"
    if _is_whole(target, data_set):
        return target
    if (target / MARKER).is_file() and not part.exists():
        # The registry has changed since: what is still right is not downloaded again.
        target.rename(part)
        (part / MARKER).unlink()
    if target.exists():
        raise RunError(
            f"{target} is in the way",
            expected="nothing, or a finished download",
            todo="Move it away and fetch again",
        )
    with disk_errors(part, "preparing"):
        part.mkdir(exist_ok=True)
    before = 0
    for path, file in data_set.files.items():
        require_free_space(root, "fetching into")
        report = _Report(path, before, file.size, data_set.size, progress)
        report.update(0)
        _fetch_file(data_set, path, file, part, report)
        before += (part / path).stat().st_size
    progress(ProgressEvent(_STAGE, before, data_set.size, f"{data_set.name} is complete"))
    _remove_leftovers(part, data_set)
    write_json(
        part / MARKER,
        {
            "name": data_set.name,
            "title": data_set.title,
            "source": data_set.source,
            "commit": data_set.commit,
            "licence": data_set.licence,
            "citation": data_set.citation,
            "notes": data_set.notes,
            "unverified": list(data_set.unverified),
            "content": data_set.content(),
        },
    )
    with disk_errors(target, "finishing"):
        part.rename(target)
    return target


def _fetch_file(data_set: DataSet, path: str, file: DataFile, folder: Path, report: _Report) -> None:
    """Download one file unless it is there with the right hash."""
    where = f"{path} of data set '{data_set.name}'"
    todo = "Fetch again: what is complete is kept. Or let TOOLKIT_DATA point to a folder that holds a copy" + (
        f" as {data_set.local}" if data_set.local else ""
    )
    target = folder / path
    try:
        with disk_errors(target, "fetching"):
            pooch.retrieve(
                file.url,
                known_hash=None if file.sha256 is None else f"sha256:{file.sha256}",
                fname=target.name,
                path=target.parent,
                downloader=pooch.HTTPDownloader(progressbar=report, chunk_size=_CHUNK, timeout=_TIMEOUT),
            )
    except OSError as error:
        # requests' errors (no network, HTTP status, timeout, truncated body) all derive from OSError.
        raise DataError(f"Cannot download {where}", expected=file.url, found=str(error), todo=todo) from error
    except ValueError as error:
        found = str(error).rpartition("but got ")[2].split(".")[0].strip("'\" ")
        raise DataError(
            f"{where} is not what the registry lists", expected=f"SHA-256 {file.sha256}", found=found, todo=todo
        ) from error


def _remove_leftovers(folder: Path, data_set: DataSet) -> None:
    """Delete the temporary files of downloads that were killed."""
    for stray in folder.rglob("tmp*"):
        if stray.is_file() and stray.relative_to(folder).as_posix() not in data_set.files:
            stray.unlink()


class _Report:
    """What pooch takes for a progress bar: turns its updates into events about the whole set."""

    def __init__(self, path: str, before: int, size: int | None, whole: int | None, progress: Progress) -> None:
        self.total = 0
        self._done = 0
        self._path, self._before, self._size, self._whole = path, before, size, whole
        self._progress = progress

    def update(self, count: int) -> None:
        """Add ``count`` bytes; pooch counts whole chunks, so the sum is held to the size of the file."""
        self._done += count
        limit = self._size if self._size is not None else max(self.total, self._done)
        self._progress(ProgressEvent(_STAGE, self._before + min(self._done, limit), self._whole, self._path))

    def reset(self) -> None:
        """Start again; pooch does so before it says that all has arrived."""
        self._done = 0

    def close(self) -> None:
        """There is nothing to close."""


@contextmanager
def _quiet_pooch() -> Iterator[None]:
    """Keep pooch from writing a line for every file to standard error."""
    logger = pooch.get_logger()
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
