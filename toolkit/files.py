"""Writing files so that a reader sees the old content or the new, never half of it."""

from __future__ import annotations

import errno
import json
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from toolkit.errors import DataError, RunError

_LEAST_FREE = 64 * 2**20
#: Seconds for which a refused rename is tried again: on Windows nothing takes the place of a file, or is moved,
#: while somebody reads it.
_PATIENCE = 2.0 if os.name == "nt" else 0.0


@contextmanager
def disk_errors(path: Path, doing: str) -> Iterator[None]:
    """Turn the operating system's refusals while ``doing`` something with ``path`` into a :class:`RunError`."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise _disk_full(path, doing, _free_bytes(path)) from error
        if error.errno in (errno.EACCES, errno.EROFS, errno.EPERM):
            raise RunError(
                f"Not allowed while {doing} {path}", found=str(error), todo="Choose a folder you may write to"
            ) from error
        if error.errno in (errno.EEXIST, errno.ENOTDIR, errno.EISDIR):
            raise RunError(
                f"Something is in the way while {doing} {path}",
                found=str(error),
                todo="Choose another folder, or move away what is there",
            ) from error
        raise


@contextmanager
def held_lock(path: Path, refused: Callable[[], RunError], *, patience: float = 0.0) -> Iterator[None]:
    """Hold a lock file for this process alone; the system lets go of it where the process dies.

    Parameters
    ----------
    path:
        Of the file, made where it is missing.
    refused:
        Returns what is raised where another process holds it.
    patience:
        Seconds to wait for that one.

    Raises
    ------
    RunError
        That of ``refused``, and where the disk refuses.
    """
    with disk_errors(path.parent, "locking"):
        lock = FileLock(path, timeout=patience)
        try:
            lock.acquire()
        except Timeout as error:
            raise refused() from error
    try:
        yield
    finally:
        lock.release()


def require_free_space(path: Path, doing: str) -> None:
    """Raise before the disk of ``path`` is full, for libraries that end the whole process when it is.

    Raises
    ------
    RunError
        When less than 64 MiB are free.
    """
    free = _free_bytes(path)
    if free < _LEAST_FREE:
        raise _disk_full(path, doing, free, expected=f"at least {_LEAST_FREE / 2**20:.0f} MiB free")


def _free_bytes(path: Path) -> int:
    return shutil.disk_usage(next(folder for folder in (path, *path.absolute().parents) if folder.exists())).free


def _disk_full(path: Path, doing: str, free: int, expected: str = "") -> RunError:
    return RunError(
        f"The disk is full while {doing} {path}",
        expected=expected,
        found=f"{free / 2**20:.1f} MiB free",
        todo="Free some space, or choose another folder, and resume. What was complete is kept",
    )


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; it takes the place of ``path`` when the block ends well.

    The file is flushed to the disk before it is renamed. When the block raises, the temporary file goes and
    ``path`` stays as it was.

    Raises
    ------
    RunError
        When the disk is full, the folder may not be written, or a file is where a folder is needed or the reverse.
    """
    with disk_errors(path, "writing"):
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.tmp{path.suffix}")
    try:
        with disk_errors(path, "writing"):
            yield temporary
            with temporary.open("rb+") as handle:
                os.fsync(handle.fileno())
            _patiently(lambda: temporary.replace(path))
    finally:
        # Where it cannot be removed either, the first error is the one to tell.
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a name beside ``path`` for a folder that becomes ``path`` when the block ends well, and else goes.

    Raises
    ------
    RunError
        When the disk is full or may not be written, or something is in the way.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with disk_errors(path, "writing"):
            yield temporary
            _patiently(lambda: temporary.rename(path))
    finally:
        if temporary.exists():
            shutil.rmtree(temporary)


def _patiently(rename: Callable[[], object]) -> None:
    until = time.monotonic() + _PATIENCE
    while True:
        try:
            rename()
            return
        except PermissionError:
            if time.monotonic() >= until:
                raise
            time.sleep(0.01)


def stand_in(source: Path, place: Path) -> None:
    """Let ``place`` stand for a file or folder that stays where it is, to be read only.

    By a symbolic link. Where the system refuses these, as Windows does unless its developer mode is on, by hard
    links, and where these cannot be had either by a copy.
    """
    try:
        place.symlink_to(source.resolve(), target_is_directory=source.is_dir())
    except OSError:
        if source.is_dir():
            shutil.copytree(source, place, copy_function=link_or_copy)
        else:
            link_or_copy(source, place)


def link_or_copy(source: str | Path, place: str | Path) -> None:
    """Let ``place`` be the same file on the disk as ``source``, or a copy on another disk or one without links."""
    try:
        os.link(source, place)
    except OSError:
        shutil.copy2(source, place)


def write_text(path: Path, text: str) -> None:
    """Replace the content of ``path`` by ``text`` (UTF-8) in one step."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Replace ``path`` by ``value`` as JSON in one step. NaN and infinities are refused with ValueError."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Return the value in a JSON file.

    Raises
    ------
    DataError
        When the file is missing, unreadable or not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="a JSON file") from error
    # ValueError: no Unicode, no JSON, or a number of more digits than Python converts.
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"Cannot read {path}", expected="a JSON file", found=str(error)) from error
