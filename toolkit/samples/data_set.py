"""What an entry of the registry of data sets says, read from JSON and checked."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from urllib.parse import urljoin, urlsplit

from toolkit.errors import DataError
from toolkit.files import read_json
from toolkit.workspace import fingerprint

MARKER = "data_set.json"
"""Written last into a fetched folder: what has it is whole."""

_FORMAT = 1
_TEXTS = ("name", "title", "source", "licence", "citation", "how_to_get", "notes")


@dataclass(frozen=True, slots=True)
class DataFile:
    """One file of a data set.

    Attributes
    ----------
    url:
        Where it is downloaded from; https (http only from 127.0.0.1, for tests).
    sha256:
        Hexadecimal hash of the public original; None where it is not known.
    size:
        Bytes; None where it is not known.
    """

    url: str
    sha256: str | None
    size: int | None


@dataclass(frozen=True, slots=True)
class DataSet:
    """One entry of the registry.

    Attributes
    ----------
    name:
        Short name, also that of its folder in the cache.
    title:
        What it is, in one line.
    source, commit:
        Where it is published (or described), and the commit that is fetched.
    licence, citation:
        As stated at the source.
    files:
        Path inside the folder (with ``/``) to file. Empty for a set that is only to be had by hand.
    how_to_get:
        For those: whom to ask, where to put it and in what layout.
    local:
        Name of its folder below the one that ``TOOLKIT_DATA`` names; None where there is none.
    notes:
        What one must know before one trusts the data.
    """

    name: str
    title: str
    source: str
    commit: str | None
    licence: str
    citation: str
    files: Mapping[str, DataFile]
    how_to_get: str = ""
    local: str | None = None
    notes: str = ""

    def __post_init__(self) -> None:
        where = f"Data set '{self.name}'"
        for what, folder in (("name", self.name), ("local", self.local)):
            if folder is not None and re.fullmatch(r"[a-z0-9][a-z0-9_]*", folder) is None:
                raise DataError(
                    f"{where}: '{what}' is no plain folder name",
                    expected="lower-case letters, digits and _",
                    found=repr(folder),
                )
        if not self.files and not self.how_to_get:
            raise DataError(f"{where} cannot be had", expected="files, or how_to_get", found="neither")
        for path, file in self.files.items():
            _check_file(f"{where}, file '{path}'", path, file)

    @property
    def by_hand(self) -> bool:
        """Whether it cannot be downloaded by :func:`toolkit.samples.registry.fetch`."""
        return not self.files

    @property
    def size(self) -> int | None:
        """Bytes of the whole download; None where a file's size is not known or there is none."""
        sizes = [file.size for file in self.files.values()]
        known = [size for size in sizes if size is not None]
        return sum(known) if sizes and len(known) == len(sizes) else None

    @property
    def unverified(self) -> tuple[str, ...]:
        """Paths of the files whose hash is not known."""
        return tuple(path for path, file in self.files.items() if file.sha256 is None)

    def content(self) -> str:
        """Return a hash of what a whole download holds: the paths and the hashes of its files."""
        return fingerprint({path: file.sha256 for path, file in self.files.items()})


def read_registry(path: Path) -> dict[str, DataSet]:
    """Read a registry in the format of ``registry.json``.

    A file's ``url`` may be relative to its entry's ``base``.

    Raises
    ------
    DataError
        When the file is damaged, two entries share a name, a path leaves its folder, a hash is no SHA-256 or an
        address is not https.
    """
    record = read_json(path)
    if (
        not isinstance(record, dict)
        or record.get("format") != _FORMAT
        or not isinstance(record.get("data_sets"), list)
    ):
        raise DataError(f"{path} is no registry of data sets", expected=f"format {_FORMAT} and a list 'data_sets'")
    sets: dict[str, DataSet] = {}
    for number, entry in enumerate(record["data_sets"], start=1):
        data_set = _read_entry(f"{path}, entry {number}", entry)
        if data_set.name in sets:
            raise DataError(f"{path} lists '{data_set.name}' twice", expected="one entry a name")
        sets[data_set.name] = data_set
    return sets


def _read_entry(where: str, entry: object) -> DataSet:
    if not isinstance(entry, dict):
        raise DataError(f"{where} is no object")
    for key in _TEXTS:
        if not isinstance(entry.get(key), str):
            raise DataError(f"{where}: '{key}' is missing", expected="a text", found=repr(entry.get(key)))
    files = entry.get("files")
    if not isinstance(files, dict):
        raise DataError(f"{where}: 'files' is missing", expected="an object of path and file")
    base = entry.get("base") or ""
    return DataSet(
        **{key: entry[key] for key in _TEXTS},
        commit=entry.get("commit"),
        local=entry.get("local"),
        files={path: _read_file(f"{where}, file '{path}'", base, file) for path, file in files.items()},
    )


def _read_file(where: str, base: str, file: object) -> DataFile:
    if not isinstance(file, dict) or not isinstance(file.get("url"), str):
        raise DataError(f"{where} has no address", expected="an object with url, sha256 and size")
    return DataFile(urljoin(base, file["url"]), file.get("sha256"), file.get("size"))


def _check_file(where: str, path: str, file: DataFile) -> None:
    parts = PurePosixPath(path).parts
    plain = parts and "\\" not in path and ":" not in path and str(PurePosixPath(path)) == path
    if not plain or path.startswith("/") or ".." in parts or path == MARKER:
        raise DataError(
            f"{where} is not inside the data set's folder", expected="a relative path without ..", found=repr(path)
        )
    if file.sha256 is not None and re.fullmatch(r"[0-9a-f]{64}", str(file.sha256)) is None:
        raise DataError(f"{where}: no SHA-256", expected="64 hexadecimal digits, or null", found=repr(file.sha256))
    if file.size is not None and (type(file.size) is not int or file.size < 0):
        raise DataError(f"{where}: no size", expected="a number of bytes, or null", found=repr(file.size))
    address = urlsplit(file.url)
    if address.scheme != "https" and (address.scheme, address.hostname) != ("http", "127.0.0.1"):
        raise DataError(f"{where}: the address is not safe", expected="https://...", found=file.url)
