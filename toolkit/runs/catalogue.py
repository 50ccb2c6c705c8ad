"""The rows of all runs, read file by file as files change, and kept in a disposable index between servers.

The truth are the run folders. ``<runs>/.index/runs.sqlite`` holds the rows of runs that rest, with the times and
sizes of the files that they were made from; where it is damaged, of another layout, locked for long or not to be
written, rows are read from the folders and kept in memory.
"""

from __future__ import annotations

import json
import math
import sqlite3
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from toolkit.errors import RunError
from toolkit.files import disk_errors, held_lock
from toolkit.runs.filters import number_names
from toolkit.runs.folder import RunFolder
from toolkit.runs.index import RunSummary, run_folders, summarise
from toolkit.runs.notes import notes_file

FOLDER, FILE = ".index", "runs.sqlite"
#: Of the rows in the file; another one is thrown away.
_LAYOUT = 1
#: Seconds to wait for another server that reads or writes the file.
_PATIENCE = 2.0
#: States that change without a file, or so often that keeping them is no use.
_RESTLESS = frozenset({"running", "queued"})

Stamp = tuple[int, ...]


class Catalogue:
    """All runs of a folder as rows; several pages and threads of a process may share one.

    Attributes
    ----------
    rows:
        What was read, by id in the order of ids (that of creation, to the second); another object after a change.
    unread:
        How many folders were not read yet, for want of time.
    remark:
        Why the index is not kept, empty where it is.
    looks, looked:
        How often the disk was looked at, and when it was last (:func:`time.monotonic`).
    """

    def __init__(self, runs_dir: Path) -> None:
        self.rows: Mapping[str, RunSummary] = {}
        self.unread = 0
        self.remark = ""
        self.looks = 0
        self.looked = -math.inf
        self._runs_dir = runs_dir
        self._stamps: dict[str, Stamp] = {}
        self._lock = threading.Lock()
        self._loaded = False
        self._numbers: tuple[Mapping[str, RunSummary], list[str]] = ({}, [])

    def refresh(self, *, within: float = math.inf, first: Iterable[str] = ()) -> bool:
        """Read what changed on the disk, the newest runs first; return whether any row did.

        Parameters
        ----------
        within:
            Seconds after which no further folder is read; the next call goes on.
        first:
            Ids of runs that are read whatever time it takes, where they are there.

        Raises
        ------
        RunError
            Where the folder may not be listed.
        """
        with self._lock:
            folders = run_folders(self._runs_dir)
            before = self.rows
            if not self._loaded and folders:
                self._load()
            self._read(folders, time.monotonic() + within, frozenset(first))
            self.looks, self.looked = self.looks + 1, time.monotonic()
            return self.rows is not before

    def numbers(self) -> list[str]:
        """Return the names of all measures and number settings (:func:`~toolkit.runs.filters.number_names`)."""
        rows = self.rows
        if self._numbers[0] is not rows:
            self._numbers = rows, number_names(rows.values())
        return self._numbers[1]

    def _read(self, folders: Sequence[RunFolder], until: float, first: frozenset[str]) -> None:
        rows: dict[str, RunSummary] = {}
        stamps: dict[str, Stamp] = {}
        fresh: list[str] = []
        unread = 0
        ordered = sorted(folders, key=lambda run: (run.id in first, run.id), reverse=True)
        for run in ordered:
            known, now = self.rows.get(run.id), file_stamp(run)
            if known is not None and self._stamps.get(run.id) == now and known.state != "running":
                rows[run.id], stamps[run.id] = known, now
            elif time.monotonic() < until or run.id in first:
                # A run that works may die without writing anything: whether its process lives is asked each time.
                rows[run.id], stamps[run.id] = summarise(run), now
                fresh.append(run.id)
            else:
                unread += 1
                if known is not None:  # older than its files, but better than none
                    rows[run.id], stamps[run.id] = known, self._stamps[run.id]
        rows = {run_id: rows[run_id] for run_id in sorted(rows)}
        removed = [run_id for run_id in self.rows if run_id not in rows]
        if rows != self.rows:  # those who look tell by the object whether anything did
            self.rows = rows
        self._stamps, self.unread = stamps, unread
        self._keep([run_id for run_id in fresh if rows[run_id].state not in _RESTLESS], removed)

    def _load(self) -> None:
        """Take what the index has. A file that cannot be used is thrown away."""
        self._loaded = True
        if not (self._runs_dir / FOLDER / FILE).is_file():
            return
        rows: dict[str, RunSummary] = {}
        stamps: dict[str, Stamp] = {}
        try:
            with self._index() as index:
                read = index.execute("SELECT id, stamp, content FROM runs").fetchall()
            for run_id, stamp, content in read:
                rows[run_id] = _row(RunFolder(self._runs_dir / run_id), json.loads(content))
                stamps[run_id] = tuple(json.loads(stamp))
        except (sqlite3.DatabaseError, ValueError, TypeError, KeyError, RecursionError) as error:
            if isinstance(error, sqlite3.DatabaseError) and not _is_damage(error):
                self.remark = _not_kept(error)
            else:
                self._throw_away()
        except (RunError, OSError) as error:
            self.remark = _not_kept(error)
        else:
            self.rows, self._stamps = rows, stamps

    def _keep(self, fresh: Sequence[str], removed: Sequence[str]) -> None:
        """Write rows into the index; where that fails they stay in memory, and :attr:`remark` says why."""
        if not fresh and not removed:
            return
        rows = [
            (run_id, json.dumps(self._stamps[run_id]), json.dumps(_content(self.rows[run_id]))) for run_id in fresh
        ]
        gone = [(run_id,) for run_id in removed]
        for last in (False, True):
            try:
                with self._index() as index:
                    index.executemany("INSERT OR REPLACE INTO runs VALUES (?, ?, ?)", rows)
                    index.executemany("DELETE FROM runs WHERE id = ?", gone)
                    index.commit()
            except sqlite3.DatabaseError as error:
                if _is_damage(error) and not last:
                    self._throw_away()
                    continue
                self.remark = _not_kept(error)
            except (RunError, OSError) as error:
                self.remark = _not_kept(error)
            else:
                self.remark = ""
            return

    @contextmanager
    def _index(self) -> Iterator[sqlite3.Connection]:
        """Open the index for this process alone, made anew where its layout is another."""
        folder = self._runs_dir / FOLDER
        with self._alone(folder), closing(sqlite3.connect(folder / FILE, timeout=_PATIENCE)) as index:
            (layout,) = index.execute("PRAGMA user_version").fetchone()
            if layout != _LAYOUT:
                index.execute("DROP TABLE IF EXISTS runs")
                index.execute("CREATE TABLE runs (id TEXT PRIMARY KEY, stamp TEXT NOT NULL, content TEXT NOT NULL)")
                index.execute(f"PRAGMA user_version = {_LAYOUT}")
                index.commit()
            yield index

    def _throw_away(self) -> None:
        folder = self._runs_dir / FOLDER
        try:
            with self._alone(folder):
                for name in (FILE, f"{FILE}-journal"):
                    (folder / name).unlink(missing_ok=True)
        except (RunError, OSError) as error:
            self.remark = f"The index of runs is damaged and stays: {error}"

    @contextmanager
    def _alone(self, folder: Path) -> Iterator[None]:
        with disk_errors(folder, "writing"):
            folder.mkdir(exist_ok=True)

        def refused() -> RunError:
            return RunError(f"The index {folder} is in use", found=f"a lock for {_PATIENCE:.0f} s")

        with held_lock(folder / "lock", refused, patience=_PATIENCE):
            yield


@lru_cache(maxsize=8)
def shared_catalogue(runs_dir: Path) -> Catalogue:
    """Return the catalogue that all pages of this process have of a folder (give its resolved path)."""
    return Catalogue(runs_dir)


def file_stamp(run: RunFolder) -> Stamp:
    """Return times and sizes of the files that a row is made of; zeros for those that are not there."""
    stamp: list[int] = []
    for path in (run.record_file, run.status_file, run.result_file, notes_file(run)):
        try:
            found = path.stat()
        except OSError:
            stamp += (0, 0)
        else:
            stamp += (found.st_mtime_ns, found.st_size)
    return tuple(stamp)


_FIELDS = tuple(name for name in RunSummary.__dataclass_fields__ if name != "run")
_KINDS: dict[str, tuple[type, ...]] = {
    **dict.fromkeys(("state", "name", "recipe", "data", "created", "device", "stage", "note", "error"), (str,)),
    **dict.fromkeys(("seed", "done"), (int,)),
    "total": (int, type(None)),
    "seconds": (float, int, type(None)),
    "metrics": (dict, type(None)),
    "settings": (dict,),
    "tags": (list,),
}


def _content(row: RunSummary) -> dict[str, Any]:
    return {name: getattr(row, name) for name in _FIELDS}


def _row(run: RunFolder, content: dict[str, Any]) -> RunSummary:
    """Return a row of the index. Raises TypeError and KeyError for what this version did not write."""
    for name, kinds in _KINDS.items():
        if not isinstance(content[name], kinds):
            raise TypeError(f"{name} of {run.id}")
    return RunSummary(run, **{**content, "tags": tuple(map(str, content["tags"]))})


def _is_damage(error: sqlite3.DatabaseError) -> bool:
    """Whether a file is none of ours or broken; others are full disks, locks and missing permission."""
    return not isinstance(error, sqlite3.OperationalError) or error.sqlite_errorcode == sqlite3.SQLITE_ERROR


def _not_kept(error: Exception) -> str:
    return f"The list of runs is kept in memory only: {str(error).rstrip('.')}."
