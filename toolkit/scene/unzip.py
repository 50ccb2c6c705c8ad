"""Captures from an archive of unknown origin: what is odd in it is refused before anything is written."""

from __future__ import annotations

import stat
import struct
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from toolkit.errors import DataError
from toolkit.files import atomic_folder, require_free_space
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene.capture_folders import find_captures
from toolkit.scene.capture_paths import require_pictures_below
from toolkit.scene.dataset import open_capture

_STAGE = "data.unzip"
_CHUNK = 1 << 20
_ENCRYPTED = 1
# Others are rare, and some take much memory for few bytes.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Of a part of a path in bytes, and of the parts: what file systems everywhere take.
_LONGEST_PART, _DEEPEST = 200, 12
_TODO = "Make the zip again from the folder with the pictures"


@dataclass(frozen=True, slots=True)
class ZipLimits:
    """What an archive may hold at most.

    Attributes
    ----------
    total_bytes:
        Of all files when they are unpacked.
    files:
        Their number.
    """

    total_bytes: int = 8 * 10**9
    files: int = 20_000


@dataclass(frozen=True, slots=True)
class _Member:
    info: zipfile.ZipInfo
    path: PurePosixPath


def unzip_captures(
    archive: Path, folder: Path, *, limits: ZipLimits | None = None, progress: Progress = silent
) -> tuple[Path, ...]:
    """Unpack an archive into a new folder and return the captures in it.

    Everything goes into a hidden folder beside it first; it gets its name when all is unpacked and each capture in
    it opens, with pictures that lie inside. Hidden files and ``__MACOSX`` are left out.

    Parameters
    ----------
    archive:
        A zip file.
    folder:
        Must not be there; see :func:`toolkit.scene.new_folder.new_folder`.
    limits:
        What may be in it, by default 8 GB in 20,000 files.
    progress:
        Told of bytes; cancels by raising.

    Raises
    ------
    DataError
        Where the archive is no zip file, is damaged or encrypted; names a path that is absolute, has ``..``, a
        backslash, a colon or control characters, or is too long; holds links or devices, two files of one name (on
        systems that do not tell capitals apart, too), more bytes or files than the limits; or where what it holds
        is no capture that opens.
    RunError
        Where the disk is full or may not be written.
    """
    bounds = limits or ZipLimits()
    try:
        with zipfile.ZipFile(archive) as opened:
            members = _checked(opened.infolist(), bounds)
            with atomic_folder(folder) as temporary:
                temporary.mkdir(parents=True)
                _unpack(opened, members, temporary, bounds, progress)
                inside = _openable(temporary, progress)
    # What zipfile raises for files that lie about their content.
    except (zipfile.BadZipFile, zlib.error, EOFError, struct.error, NotImplementedError, ValueError) as error:
        raise DataError(
            "The zip is damaged, or none", expected="a whole zip file", found=str(error)[:200], todo=_TODO
        ) from error
    return tuple(folder / path for path in inside)


def _checked(infos: Sequence[zipfile.ZipInfo], limits: ZipLimits) -> list[_Member]:
    """Return the files to unpack; refuse the archive for any that is not as it should be."""
    if len(infos) > limits.files:
        raise _too_much(f"at most {limits.files:,} files", f"{len(infos):,}")
    members: list[_Member] = []
    seen: dict[str, str] = {}
    for info in infos:
        path = _safe_path(info)
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise _refused(info, "files and folders", "a link" if stat.S_ISLNK(kind) else "a device or a pipe")
        if info.flag_bits & _ENCRYPTED:
            raise _refused(info, "files without a password", "an encrypted one")
        if info.compress_type not in _METHODS:
            raise _refused(info, "files that are stored or deflated", f"method {info.compress_type}")
        if info.is_dir() or any(part.startswith(".") or part == "__MACOSX" for part in path.parts):
            continue
        key = str(path).casefold()
        if key in seen:
            raise _refused(info, "each name once, capitals or not", f"{seen[key]} too")
        seen[key] = str(path)
        members.append(_Member(info, path))
    folders = {str(above).casefold() for member in members for above in member.path.parents}
    for member in members:
        if str(member.path).casefold() in folders:
            raise _refused(member.info, "a file or a folder", "both of this name")
    declared = sum(member.info.file_size for member in members)
    if declared > limits.total_bytes:
        raise _too_much(f"at most {limits.total_bytes / 1e6:,.0f} MB unpacked", f"{declared / 1e6:,.0f} MB")
    if not members:
        raise DataError("The zip is empty", expected="pictures", todo=_TODO)
    return members


def _safe_path(info: zipfile.ZipInfo) -> PurePosixPath:
    """Return where a file goes, relative to the folder."""
    # Names are cut at a zero and backslashes become slashes on some systems: what was written counts.
    name = info.orig_filename
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name:
        raise _refused(info, "paths inside the folder, with '/'", repr(name[:80]))
    if not name.isprintable():
        raise _refused(info, "names without control characters", repr(name[:80]))
    long = len(path.parts) > _DEEPEST or any(len(part.encode()) > _LONGEST_PART for part in path.parts)
    if long or not (path.parts or info.is_dir()):
        raise _refused(info, f"1 to {_DEEPEST} folders, each name up to {_LONGEST_PART} bytes", repr(name[:80]))
    return path


def _unpack(
    opened: zipfile.ZipFile, members: Sequence[_Member], folder: Path, limits: ZipLimits, progress: Progress
) -> None:
    """Write the files. What comes out counts, not what the archive says of itself."""
    total = sum(member.info.file_size for member in members)
    done = 0
    progress(ProgressEvent(_STAGE, 0, total))
    for member in members:
        require_free_space(folder, "unpacking into")
        target = folder / member.path
        target.parent.mkdir(parents=True, exist_ok=True)
        # "x": a name that the system takes for another one's is an error, not an overwritten file.
        with opened.open(member.info) as packed, target.open("xb") as handle:
            while block := packed.read(_CHUNK):
                done += len(block)
                if done > limits.total_bytes:
                    raise _too_much(f"at most {limits.total_bytes / 1e6:,.0f} MB unpacked", "more")
                handle.write(block)
                progress(ProgressEvent(_STAGE, done, total, str(member.path)))


def _openable(folder: Path, progress: Progress) -> list[Path]:
    """Return the captures in a folder, relative to it, after opening each."""
    found = find_captures([folder])
    if not found:
        names = ", ".join(sorted(path.name for path in folder.iterdir())[:5])
        raise DataError(
            "The zip holds no capture",
            expected="photos (.jpg, .png, .tif), or a scene.json or transforms.json with its pictures",
            found=names[:200],
        )
    for capture in found:
        require_pictures_below(open_capture(capture.path, check=False, progress=progress), [folder])
    return [capture.path.relative_to(folder.resolve()) for capture in found]


def _refused(info: zipfile.ZipInfo, expected: str, found: str) -> DataError:
    name = ascii(info.orig_filename[:80])
    return DataError(f"The zip was refused for {name}", expected=expected, found=found, todo=_TODO)


def _too_much(expected: str, found: str) -> DataError:
    return DataError("The zip holds too much", expected=expected, found=found, todo="Send it in parts")
