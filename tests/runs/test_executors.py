"""Real worker processes, on this machine and behind a real Dask scheduler; some of them are killed."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from pathlib import Path

import fake_recipe
import pytest
from fake_recipe import RECIPE
from fake_sweeps import make_sweep, wait_for

from toolkit.errors import RunError
from toolkit.runs.executors import LocalWorkers, dask_cluster
from toolkit.runs.sweep import SweepPlaces
from toolkit.runs.sweep_record import SweepFolder
from toolkit.runs.sweep_run import work_on_sweep
from toolkit.runs.sweep_table import TrialRow

posix = pytest.mark.skipif(sys.platform == "win32", reason="kill -9 of POSIX")
SLOW_STEPS = {"loop.steps": 40, "pause": 0.05}


@posix
def test_a_worker_that_dies_takes_nothing_with_it_and_another_takes_its_place() -> None:
    with LocalWorkers(2, 1) as workers:
        first, second = workers.submit(os.getpid), workers.submit(time.sleep, 2.0)
        pid = first.result(timeout=60)
        assert pid != os.getpid()
        assert workers.submit(os.getenv, "OMP_NUM_THREADS").result(timeout=60) == "1"
        with pytest.raises(BrokenProcessPool):
            workers.submit(os.kill, pid, signal.SIGKILL).result(timeout=60)
        assert workers.submit(os.getpid).result(timeout=60) not in (pid, os.getpid())
        assert second.result(timeout=60) is None
        with pytest.raises(ZeroDivisionError):
            workers.submit(divmod, 1, 0).result(timeout=60)


@posix
def test_workers_end_with_the_process_that_made_them() -> None:
    program = (
        "import os, sys, time\n"
        "from toolkit.runs.executors import LocalWorkers\n"
        "if __name__ == '__main__':\n"
        "    workers = LocalWorkers(1, 1)\n"
        "    print(workers.submit(os.getpid).result(), flush=True)\n"
        "    workers.submit(time.sleep, 600)\n"
        "    sys.stdin.readline()\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        parent.kill()
        parent.wait()
    wait_for(lambda: not Path(f"/proc/{worker}").exists())


def kill_the_first_that_works(sweep: SweepFolder, killed: list[str]) -> None:
    """Kill the process of a run that has a checkpoint, once."""

    def begun() -> str:
        for trial in sweep.trials():
            run = sweep.run_of(trial)
            if (run.checkpoint / "state.json").exists() and run.status().state == "running":
                return trial.run
        return ""

    wait_for(lambda: bool(begun()))
    run_id = begun()
    process = next(sweep.run_of(trial) for trial in sweep.trials() if trial.run == run_id).status().process
    assert process is not None
    os.kill(process.pid, signal.SIGKILL)
    killed.append(run_id)


def worked_on_with_a_death(sweep: SweepFolder) -> tuple[list[TrialRow], str]:
    """Work on a sweep while one of its workers is killed; return its rows and the run that was hit."""
    killed: list[str] = []
    killer = threading.Thread(target=kill_the_first_that_works, args=(sweep, killed))
    killer.start()
    rows = work_on_sweep(sweep, recipe=RECIPE)
    killer.join()
    return rows, killed[0]


def check_nothing_was_lost(sweep: SweepFolder, rows: list[TrialRow], killed: str, runs_dir: Path) -> None:
    assert [row.state for row in rows] == ["finished"] * 4
    assert {row.run: row.handed for row in rows}[killed] == 2
    assert sum(row.handed for row in rows) == 5
    # A process that is just ending may still count as one that works.
    told = "its worker is gone, the run is (interrupted|running); it is handed out again"
    assert len(re.findall(told, sweep.log_file.read_text())) == 1
    assert "resumed; it was interrupted in stage 'train'" in (runs_dir / killed / "log.txt").read_text()


@posix
@pytest.mark.slow
def test_a_sweep_loses_no_run_to_a_killed_process(photos: Path, runs_dir: Path) -> None:
    places = SweepPlaces(workers=2, threads=1)
    sweep = make_sweep(photos, runs_dir, "grid", "loop.rate=1,2,3,4", base=SLOW_STEPS, places=places)
    rows, killed = worked_on_with_a_death(sweep)
    check_nothing_was_lost(sweep, rows, killed, runs_dir)


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """Start a scheduler without workers and return its address."""
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'sightline-toolkit[cluster]'")
    told = tmp_path / "scheduler.json"
    with Dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(told)):
        wait_for(lambda: told.exists() and told.read_text().strip().endswith("}"))
        yield json.loads(told.read_text())["address"]


class Dask:
    """A process of Dask's, for the time of a block."""

    def __init__(self, *arguments: str) -> None:
        tests = str(Path(fake_recipe.__file__).parent)
        environment = {**os.environ, "PYTHONPATH": tests, "OMP_WAIT_POLICY": "passive"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def __enter__(self) -> Dask:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.terminate()
        self._process.wait(timeout=30)


def worker(address: str, *more: str) -> Dask:
    return Dask("worker", address, "--no-dashboard", "--nworkers", "1", *(more or ("--nthreads", "1")))


def wait_for_workers(address: str, count: int) -> None:
    import distributed

    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(count, timeout=60)


@posix
@pytest.mark.slow
def test_a_cluster_gives_the_same_results_to_the_bit_and_loses_no_run_to_a_killed_worker(
    photos: Path, runs_dir: Path, tmp_path: Path, scheduler: str
) -> None:
    space, base = "loop.rate=1,2,3,4", SLOW_STEPS
    here = work_on_sweep(
        make_sweep(photos, tmp_path / "here", "grid", space, base=base, places=SweepPlaces(workers=2, threads=1)),
        recipe=RECIPE,
    )
    with ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(worker(scheduler))
        wait_for_workers(scheduler, 2)
        sweep = make_sweep(photos, runs_dir, "grid", space, base=base, places=SweepPlaces(cluster=scheduler))
        rows, killed = worked_on_with_a_death(sweep)
    check_nothing_was_lost(sweep, rows, killed, runs_dir)
    for mine, other in zip(rows, here, strict=True):
        one, two = (sweep.runs_dir / mine.run, tmp_path / "here" / other.run)
        assert mine.values == other.values
        # To the bit: JSON has all digits. Times differ, of course.
        metrics = [json.loads((run / "artifacts/result.json").read_text())["metrics"] for run in (one, two)]
        assert metrics[0] == metrics[1]


@posix
@pytest.mark.slow
def test_a_cluster_that_cannot_be_used_is_told(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        pytest.raises(RunError, match="has no workers; expected at least one.*dask worker tcp"),
        dask_cluster(scheduler, tmp_path),
    ):
        pytest.fail("it has none")
    with worker(scheduler, "--nthreads", "2"):
        wait_for_workers(scheduler, 1)
        with pytest.raises(RunError, match="expected workers with one thread for tasks; found 2 in"):
            dask_cluster(scheduler, tmp_path).__enter__()
    with worker(scheduler):
        wait_for_workers(scheduler, 1)
        with dask_cluster(scheduler, tmp_path) as (executor, size):
            assert size == 1
            assert executor.submit(divmod, 7, 2).result(timeout=60) == (3, 1)
        assert list(tmp_path.glob(".asked*")) == []
        # A folder that only one side sees: written here under one name, looked for there under another.
        from toolkit.runs import executors

        write = executors.write_text
        monkeypatch.setattr(executors, "write_text", lambda path, text: write(path.with_name("elsewhere"), text))
        with pytest.raises(RunError, match="does not share the folder of runs; .*Put the runs on a shared disk"):
            dask_cluster(scheduler, tmp_path).__enter__()


def test_a_scheduler_that_does_not_answer_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'sightline-toolkit[cluster]'")
    from toolkit.runs import executors

    monkeypatch.setattr(executors, "PATIENCE", 1)
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        with pytest.raises(RunError, match=f"No Dask scheduler answers; expected one at {address}"):
            dask_cluster(address, tmp_path).__enter__()


def test_workers_that_cannot_load_the_toolkit_are_told(tmp_path: Path) -> None:
    from toolkit.runs import executors

    class Client:
        def scheduler_info(self, **options: object) -> dict[str, object]:
            return {"workers": {"tcp://w": {"nthreads": 1}}}

        def run(self, *arguments: object) -> dict[str, str]:
            raise ModuleNotFoundError("No module named 'toolkit'")

    with pytest.raises(RunError, match="cannot load the toolkit; .* in the Python of each; found No module named"):
        executors._check_workers(Client(), "tcp://x", tmp_path)
    assert list(tmp_path.iterdir()) == []
