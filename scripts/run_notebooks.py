"""Execute the notebooks from top to bottom and keep them with their outputs: ``make notebooks``.

    python scripts/run_notebooks.py                  # full size, into runs/notebooks/full
    FAST=1 python scripts/run_notebooks.py 00_tour   # one of them, small, into runs/notebooks/fast
    python scripts/run_notebooks.py --missing        # small, and only what no executed notebook is there for

Each one starts in an empty folder, so that its time is that of a first run. ``times.json`` beside the notebooks has
seconds, date and machine of each.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

from toolkit.files import read_json, write_json

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ROOT / "notebooks"
EXECUTED = ROOT / "runs" / "notebooks"
TIMES = "times.json"
#: Seconds that one cell may take.
_PATIENCE = {"full": 3600, "fast": 600}


def main(argv: Sequence[str] | None = None) -> int:
    """Execute the notebooks that are asked for; return how many failed."""
    parser = argparse.ArgumentParser(description="Execute the notebooks and keep them with their outputs.")
    parser.add_argument("names", nargs="*", help="notebooks without their ending [all]")
    parser.add_argument("--missing", action="store_true", help="only those without an executed version, small")
    arguments = parser.parse_args(argv)
    size = "fast" if arguments.missing or os.environ.get("FAST") == "1" else "full"
    chosen = [path for path in notebooks() if not arguments.names or path.stem in arguments.names]
    unknown = set(arguments.names) - {path.stem for path in chosen}
    if unknown:
        parser.error(f"no notebook is named {', '.join(sorted(unknown))}")
    failed = 0
    for path in chosen:
        if arguments.missing and executed_version(path) is not None:
            continue
        print(f"{path.stem} ({size}) ...", flush=True)
        seconds, error = execute(path, size)
        print(f"{path.stem}: {seconds:.0f} s{f', failed: {error}' if error else ''}", flush=True)
        failed += bool(error)
    return failed


def notebooks() -> list[Path]:
    """Return the stored notebooks in their order."""
    return sorted(SOURCES.glob("*.ipynb"))


def execute(path: Path, size: str, *, executed: Path = EXECUTED) -> tuple[float, str]:
    """Execute a notebook and keep it; return the seconds it took and why it failed, if it did.

    Parameters
    ----------
    path:
        Of the stored notebook, which stays as it is.
    size:
        ``"full"`` or ``"fast"``.
    executed:
        Folder below which executed notebooks are kept.
    """
    notebook = nbformat.read(path, as_version=4)
    work = executed / size / "work" / path.stem
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    client = NotebookClient(
        notebook,
        timeout=_PATIENCE[size],
        kernel_name="python3",
        # Kernels tell every time that they listen on this machine.
        extra_arguments=["--IPKernelApp.log_level=ERROR"],
        resources={"metadata": {"path": str(work)}},
    )
    environment = {**os.environ, "FAST": "1" if size == "fast" else "0"}
    start, error = time.perf_counter(), ""
    try:
        client.execute(env=environment)
    except CellExecutionError as failure:
        error = f"{failure.ename}: {failure.evalue}"
    seconds = time.perf_counter() - start
    if not error:
        nbformat.write(notebook, executed / size / path.name)
        keep_time(executed / size, path.stem, seconds)
    shutil.rmtree(work, ignore_errors=True)
    return seconds, error


def keep_time(folder: Path, stem: str, seconds: float) -> None:
    """Write into ``times.json`` how long a notebook took, when and where."""
    times = read_json(folder / TIMES) if (folder / TIMES).is_file() else {}
    times[stem] = {
        "seconds": round(seconds, 1),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{platform.system()} {platform.machine()}",
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }
    write_json(folder / TIMES, times)


def executed_version(path: Path, *, executed: Path = EXECUTED) -> tuple[Any, str, dict[str, Any]] | None:
    """Return a notebook with its outputs, its size and the record of its time; None where there is none.

    That of full size is taken first. One whose cells are no longer those of the stored notebook does not count.
    """
    stored = _cells(nbformat.read(path, as_version=4))
    for size in ("full", "fast"):
        kept, times = executed / size / path.name, executed / size / TIMES
        if not (kept.is_file() and times.is_file()):
            continue
        notebook, record = nbformat.read(kept, as_version=4), read_json(times).get(path.stem)
        if record is not None and _cells(notebook) == stored:
            return notebook, size, record
    return None


def _cells(notebook: Any) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


if __name__ == "__main__":
    sys.exit(main())
