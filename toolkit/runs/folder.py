"""The run folder: what is where in it, and who holds it."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from toolkit.errors import DataError, RunError
from toolkit.files import disk_errors, held_lock, read_json, write_json, write_text
from toolkit.runs.curves import Curves, read_curves
from toolkit.runs.names import is_run_id
from toolkit.runs.record import RunRecord
from toolkit.runs.result import RESULT, SCENE, SPLAT, TRAJECTORY, StoredResult, read_result
from toolkit.runs.status import RunStatus, read_status, write_status


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A run by its folder. Nothing is read before it is asked for."""

    path: Path

    @property
    def id(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def record_file(self) -> Path:
        """What the run is made from."""
        return self.path / "run.json"

    @property
    def status_file(self) -> Path:
        """Where the run is."""
        return self.path / "status.json"

    @property
    def metrics_file(self) -> Path:
        """Measurements over time."""
        return self.path / "metrics.csv"

    @property
    def log_file(self) -> Path:
        """What happened, line by line."""
        return self.path / "log.txt"

    @property
    def checkpoint(self) -> Path:
        """Folder from which a resumed run goes on."""
        return self.path / "checkpoint"

    @property
    def artifacts(self) -> Path:
        """Folder of what a person looks at."""
        return self.path / "artifacts"

    @property
    def result_file(self) -> Path:
        """Measures, times and reports."""
        return self.artifacts / RESULT

    @property
    def scene_folder(self) -> Path:
        """The scene with the poses that were found, as a COLMAP folder with scene.json."""
        return self.artifacts / SCENE

    @property
    def trajectory_file(self) -> Path:
        """Found and true camera poses, for plots."""
        return self.artifacts / TRAJECTORY

    @property
    def splat_file(self) -> Path:
        """The trained splat; absent for recipes without one."""
        return self.artifacts / SPLAT

    def record(self) -> RunRecord:
        """Return what run.json says. Raises :class:`DataError` where it is damaged."""
        return RunRecord.from_dict(read_json(self.record_file), self.record_file)

    def status(self) -> RunStatus:
        """Return where the run is, judged by whether its process lives. Raises :class:`DataError`."""
        return read_status(self.status_file).judged()

    def curves(self) -> Curves:
        """Return the measurements over time. Raises :class:`DataError` where they are damaged."""
        return read_curves(self.metrics_file)

    def result(self) -> StoredResult:
        """Return what the run measured.

        Raises
        ------
        RunError
            Where it has no result yet.
        DataError
            Where result.json is damaged or names pictures outside the run.
        """
        if not self.result_file.is_file():
            raise RunError(
                f"Run {self.id} has no result", expected="a finished run", todo="toolkit show tells how far it came"
            )
        return read_result(self.artifacts)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the folder for this process alone.

        Raises
        ------
        RunError
            Where another process holds it; the message names it.
        """

        def refused() -> RunError:
            return RunError(
                f"Run {self.id} is in use",
                found=self._holder(),
                todo="Wait until it ends, or stop that process and resume the run",
            )

        with held_lock(self.path / ".lock", refused):
            yield

    def _holder(self) -> str:
        """Say who works on the run, as far as its status tells."""
        try:
            status = self.status()
        except DataError:
            return "a process that did not leave its number"
        if status.state != "running" or status.process is None:
            return "a process that has not written its status yet"
        return f"process {status.process.pid} on {status.process.host}, at work since {status.started}"


def open_run(path: Path) -> RunFolder:
    """Return the run in a folder. Raises :class:`RunError` where there is none."""
    if not (path / "run.json").is_file():
        raise RunError(f"{path} is no run", expected="a folder with run.json", found="no such file in it")
    return RunFolder(path)


def make_folder(runs_dir: Path, run_id: str, record: RunRecord) -> RunFolder:
    """Create a queued run, whole or not at all.

    Raises
    ------
    RunError
        When the disk is full or may not be written, or the folder is there already.
    """
    if not is_run_id(run_id):
        raise RunError(f"{run_id!r} is no run id", expected="<yyyymmdd-hhmmss>-<recipe>-<4 hex>")
    final = runs_dir / run_id
    with disk_errors(runs_dir, "creating a run in"):
        runs_dir.mkdir(parents=True, exist_ok=True)
        temporary = RunFolder(runs_dir / f".{run_id}.{uuid.uuid4().hex[:8]}.tmp")
        try:
            temporary.path.mkdir()
            temporary.checkpoint.mkdir()
            temporary.artifacts.mkdir()
            write_json(temporary.record_file, record.to_dict())
            write_status(temporary.status_file, RunStatus("queued"))
            write_text(temporary.log_file, "")
            if final.exists():
                raise RunError(f"{final} is there already", todo="Start the run again: it gets another id")
            temporary.path.rename(final)
        finally:
            if temporary.path.exists():
                shutil.rmtree(temporary.path)
    return RunFolder(final)
