"""Where runs of a sweep are worked on: processes of this machine, or a Dask cluster.

Both are a :class:`concurrent.futures.Executor`. Nothing heavy is imported here: a worker process sets its threads
before it loads what computes.
"""

from __future__ import annotations

import multiprocessing
import os
import secrets
import signal
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from toolkit.errors import RunError
from toolkit.files import disk_errors, write_text
from toolkit.optional import require

P = ParamSpec("P")
T = TypeVar("T")
#: Seconds that a scheduler has to answer.
PATIENCE = 10


class LocalWorkers(Executor):
    """Worker processes on this machine, each with its share of threads.

    One that dies takes nothing with it but what it worked on, whose future then raises ``BrokenProcessPool``;
    another takes its place. All end with the process that made them.
    """

    def __init__(self, workers: int, threads: int) -> None:
        self._threads = threads
        self._idle: list[ProcessPoolExecutor] = []
        self._guard = threading.Lock()
        self._hands = ThreadPoolExecutor(workers, thread_name_prefix="hand")

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Let the next free worker call ``fn``, which it imports by its name."""
        return self._hands.submit(partial(self._call, fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers when they are done."""
        self._hands.shutdown(wait, cancel_futures=cancel_futures)
        with self._guard:
            for worker in self._idle:
                worker.shutdown(wait)
            self._idle.clear()

    def _call(self, fn: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        with self._guard:
            worker = self._idle.pop() if self._idle else self._begin()
        try:
            result = worker.submit(fn, *args, **kwargs).result()
        except BrokenProcessPool:
            worker.shutdown(wait=False)
            raise
        except BaseException:
            self._free(worker)
            raise
        self._free(worker)
        return result

    def _free(self, worker: ProcessPoolExecutor) -> None:
        with self._guard:
            self._idle.append(worker)

    def _begin(self) -> ProcessPoolExecutor:
        # Spawned: a process that has loaded OpenMP must not fork.
        return ProcessPoolExecutor(
            1, multiprocessing.get_context("spawn"), initializer=_begin_worker, initargs=(self._threads,)
        )


def _begin_worker(count: int) -> None:
    """Prepare a worker process, before anything is loaded that reads these variables."""
    from toolkit.runs.threads import VARIABLES

    os.environ.update(dict.fromkeys(VARIABLES, str(count)))
    # Ctrl-C reaches all processes of a terminal. Who hands out runs decides how they end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, name="end with the sweep", daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the one that hands out runs is gone: its run counts as interrupted then."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


@contextmanager
def dask_cluster(address: str, folder: Path) -> Iterator[tuple[Executor, int]]:
    """Yield an executor on the workers of a Dask scheduler, and how many they are.

    Anyone who can reach a scheduler can run programs on its workers: use one on a network that is yours.

    Parameters
    ----------
    address:
        As ``tcp://host:8786``.
    folder:
        Which all workers must find under the same path as this process.

    Raises
    ------
    MissingDependencyError
        Where Dask is not installed.
    RunError
        Where no scheduler answers or it has no workers, they have more than one thread or cannot load the toolkit,
        and where they do not share the folder.
    """
    distributed = require("distributed")
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise RunError(
            "No Dask scheduler answers",
            expected=f"one at {address}",
            found=str(error) or type(error).__name__,
            todo="Start one with: dask scheduler; and workers with: dask worker ADDRESS --nthreads 1",
        ) from error
    try:
        _check_workers(client, address, folder)
        # Not entered: on leaving it would wait for tasks that no worker is there for any more.
        yield client.get_executor(pure=False, retries=0), len(_workers(client))
    finally:
        client.close(timeout=PATIENCE)


def _workers(client: Any) -> dict[str, Any]:
    """Return what the scheduler says of each worker, by address."""
    found: dict[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    return found


def _check_workers(client: Any, address: str, folder: Path) -> None:
    workers = _workers(client)
    if not workers:
        raise RunError(
            f"The scheduler at {address} has no workers",
            expected="at least one",
            todo=f"Start some: dask worker {address} --nthreads 1",
        )
    busy = [name for name, worker in workers.items() if worker["nthreads"] != 1]
    if busy:
        raise RunError(
            "A worker would work on several runs at a time in one process",
            expected="workers with one thread for tasks",
            found=f"{workers[busy[0]]['nthreads']} in {busy[0]}",
            todo=f"Start workers with: dask worker {address} --nthreads 1",
        )
    token, asked = secrets.token_hex(16), folder / f".asked-{uuid.uuid4().hex[:8]}"
    write_text(asked, token)
    answers: dict[str, str] = {}
    try:
        try:
            answers = client.run(answer, asked)
        except (ImportError, AttributeError) as error:
            raise RunError(
                "The workers cannot load the toolkit",
                expected="the same version of it in the Python of each",
                found=str(error),
            ) from error
        for worker, said in answers.items():
            if said != token or not _answer_file(asked, worker).is_file():
                raise _not_shared(worker, folder)
    finally:
        with disk_errors(folder, "writing"):
            for path in (asked, *folder.glob(f"{asked.name}.*")):
                path.unlink(missing_ok=True)


def _not_shared(worker: str, folder: Path) -> RunError:
    return RunError(
        "A worker does not share the folder of runs",
        expected=f"{folder} on a file system that all workers read and write under the same path",
        found=f"{worker}, which does not",
        todo="Put the runs on a shared disk, with --runs",
    )


def answer(asked: Path, dask_worker: Any = None) -> str:
    """Return what a file says to this worker, empty where it is not found, and leave a file beside it.

    Dask fills in ``dask_worker``.
    """
    try:
        said = asked.read_text(encoding="utf-8")
        write_text(_answer_file(asked, dask_worker.address), said)
    except (OSError, RunError):
        return ""
    return said


def _answer_file(asked: Path, worker: str) -> Path:
    return asked.with_name(f"{asked.name}.{''.join(char if char.isalnum() else '-' for char in worker)}")
