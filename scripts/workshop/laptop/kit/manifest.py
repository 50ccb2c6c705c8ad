"""The list of the bundle's files with their sizes and hashes, and whether they are all there."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from .here import Refused

NAME = "manifest.json"
FORMAT = 1
_BLOCK = 1 << 20
#: As many files are named in a message; the rest is counted.
_NAMED = 5
COPY_AGAIN = "Copy the bundle again, from another stick if need be, and start install.py again."


@dataclass(frozen=True)
class Entry:
    """A file: its size in bytes, and its SHA-256 in hexadecimal digits."""

    size: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """What a bundle says of itself.

    Attributes
    ----------
    toolkit:
        Version of the toolkit.
    made:
        Day on which it was built.
    least_python:
        Oldest release of Python, by kind of laptop (``linux-x86_64-cp311``): ``3.11.5``.
    least_system:
        Oldest glibc on Linux, and oldest macOS, that the wheels run on, ``2.35``; empty for Windows.
    longest_path:
        Characters of the longest path below the virtual environment, by kind of laptop.
    unpacked:
        Bytes that the installed wheels take, by kind of laptop.
    files:
        By path below the bundle's folder, with ``/``.
    """

    toolkit: str
    made: str
    least_python: dict[str, str]
    least_system: dict[str, str]
    longest_path: dict[str, int]
    unpacked: dict[str, int]
    files: dict[str, Entry] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return it as it stands in the file."""
        return {
            "format": FORMAT,
            "toolkit": self.toolkit,
            "made": self.made,
            "least_python": self.least_python,
            "least_system": self.least_system,
            "longest_path": self.longest_path,
            "unpacked": self.unpacked,
            "files": {name: {"size": entry.size, "sha256": entry.sha256} for name, entry in self.files.items()},
        }


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of the bundle in ``folder``.

    Raises
    ------
    Refused
        Where it is missing, damaged, of another format, or names a file outside of the folder.
    """
    path = folder / NAME
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise Refused(f"{path} is missing: this is no whole bundle. {COPY_AGAIN}") from None
    except (OSError, ValueError) as error:
        raise Refused(f"{path} cannot be read: {error}. {COPY_AGAIN}") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise Refused(f"{path} is not of format {FORMAT}, which this installer reads. {COPY_AGAIN}")
    try:
        files = {
            _inside(str(name), path): Entry(int(entry["size"]), str(entry["sha256"]))
            for name, entry in found["files"].items()
        }
        return Manifest(
            str(found["toolkit"]),
            str(found["made"]),
            dict(found["least_python"]),
            dict(found["least_system"]),
            dict(found["longest_path"]),
            dict(found["unpacked"]),
            files,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise Refused(f"{path} is damaged: {type(error).__name__} {error}. {COPY_AGAIN}") from None


def _inside(name: str, path: Path) -> str:
    """Return a file's name where it can only lie in the bundle."""
    plain = PurePosixPath(name)
    windows = PureWindowsPath(name)
    wrong = not name or plain.is_absolute() or windows.is_absolute() or windows.drive or "\\" in name
    if wrong or not set(plain.parts).isdisjoint({"..", "."}) or str(plain) != name:
        raise Refused(f"{path} names {name!r}, which does not lie in the bundle: do not use this bundle.")
    return name


def sample_folders(manifest: Manifest, runs: str) -> list[str]:
    """Return the folders of the samples that came with the bundle, as ``runs/tour/town``.

    Parameters
    ----------
    runs:
        Folder of the runs that were made beforehand, which holds none.
    """
    below = (PurePosixPath(name).parts for name in manifest.files)
    found = {"/".join(parts[:3]) for parts in below if parts[0] == "runs" and len(parts) > 3}
    return sorted(name for name in found if not name.startswith(f"{runs}/"))


def check_files(folder: Path, files: dict[str, Entry]) -> list[str]:
    """Return what is wrong with the files, a line each: missing, too short or long, or changed."""
    wrong = []
    for name, entry in files.items():
        path = folder / name
        try:
            size = path.stat().st_size
            if size != entry.size:
                wrong.append(f"{name}: {size} bytes in the place of {entry.size}")
            elif sha256_of(path) != entry.sha256:
                wrong.append(f"{name}: its content is another than when the bundle was made")
        except FileNotFoundError:
            wrong.append(f"{name}: missing")
        except OSError as error:
            wrong.append(f"{name}: cannot be read ({error})")
    return wrong


def told(wrong: list[str]) -> str:
    """Return the first lines and how many more there are."""
    more = len(wrong) - _NAMED
    return "\n".join(f"  {line}" for line in wrong[:_NAMED]) + (f"\n  and {more} more" if more > 0 else "")


def sha256_of(path: Path) -> str:
    """Return a file's hash."""
    found = hashlib.sha256()
    with path.open("rb") as handle:
        while block := handle.read(_BLOCK):
            found.update(block)
    return found.hexdigest()


def entries_of(folder: Path, paths: Iterable[Path]) -> dict[str, Entry]:
    """Return the entries of files below ``folder``, by their names in it."""
    return {
        path.relative_to(folder).as_posix(): Entry(path.stat().st_size, sha256_of(path)) for path in sorted(paths)
    }
