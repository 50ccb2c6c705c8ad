"""What a run was made with: machine, libraries, threads and the toolkit's own code."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from ctypes.util import find_library
from functools import cache
from importlib import metadata
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import toolkit
from toolkit.errors import RunError
from toolkit.optional import MATCHERS, RECIPES
from toolkit.workspace import code_version, source_version

_LIBRARIES = ("numpy", "scipy", "torch", "torchvision", "numba", "pycolmap", "gsplat")


def describe_machine(device: str) -> dict[str, Any]:
    """Return processor, cores, memory in GiB, system, Python and library versions, and the GPU on ``cuda``."""
    described: dict[str, Any] = {
        "cpu": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": _memory_gib(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "libraries": {name: version for name in _LIBRARIES if (version := _version(name)) is not None},
    }
    if device == "cuda":
        import torch

        described["gpu"] = torch.cuda.get_device_name()
    return described


@cache
def devices_here() -> tuple[str, ...]:
    """Return the devices on which a run can work: ``cpu``, and ``cuda`` where PyTorch finds a GPU."""
    # Without NVIDIA's driver there is none: told without importing PyTorch, which takes half a gigabyte.
    if find_library("cuda") is None and find_library("nvcuda") is None:
        return ("cpu",)
    import torch

    return ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)


def describe_threads() -> dict[str, Any]:
    """Return how many threads the kernels use: results are only the same to the bit with the same numbers."""
    import torch

    from toolkit.geometry.compiled import thread_count

    return {
        "torch": torch.get_num_threads(),
        "numba": thread_count(),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS"),
    }


@cache
def threads_elsewhere() -> dict[str, Any]:
    """Return :func:`describe_threads` of a new process, such as those that work off the queue.

    A server asks this instead of importing PyTorch for the answer, half a gigabyte. It takes some seconds, once.

    Raises
    ------
    RunError
        Where no process can be started.
    """
    command = (
        "import json; from toolkit.runs.machine import describe_threads; print(json.dumps(describe_threads()))"
    )
    try:
        said = subprocess.run([sys.executable, "-c", command], check=True, capture_output=True, text=True)
    except (OSError, subprocess.SubprocessError) as error:
        raise RunError(
            "No process can be started to ask for its threads", expected="a Python process", found=str(error)
        ) from error
    described: dict[str, Any] = json.loads(said.stdout)
    return described


@cache
def describe_code() -> dict[str, Any]:
    """Return the toolkit's version, a hash of its sources and, in a checkout, the git commit.

    ``changed`` says whether the checkout differed from that commit. Where other packages add recipes or matchers,
    ``added`` has the version of each with a hash of its sources.
    """
    described: dict[str, Any] = {"version": toolkit.__version__, "sources": code_version(toolkit)}
    added = _added_packages()
    if added:
        described["added"] = added
    assert toolkit.__file__ is not None
    root = Path(toolkit.__file__).parent.parent
    # An installed package may lie below a checkout of something else: its commit would be the wrong one.
    top = _git(root, "rev-parse", "--show-toplevel")
    commit = _git(root, "rev-parse", "HEAD")
    if commit and top and Path(top) == root.resolve():
        described["commit"] = commit
        described["changed"] = bool(_git(root, "status", "--porcelain", "--", "toolkit"))
    return described


def _added_packages() -> dict[str, str]:
    """Return version and hash of the packages that add to the toolkit, without importing them."""
    found = {}
    for point in (*entry_points(group=RECIPES), *entry_points(group=MATCHERS)):
        module = point.module.partition(".")[0]
        spec = find_spec(module)
        # A package of names alone or one in a compiled file has no source to hash.
        origin = Path(spec.origin) if spec is not None and spec.origin else None
        sources = source_version(origin) if origin is not None and origin.suffix == ".py" else "unknown"
        name, version = (point.dist.name, point.dist.version) if point.dist is not None else (module, "unknown")
        found[name] = f"{version}, sources {sources}"
    return found


def _git(root: Path, *arguments: str) -> str:
    """Return what git says, empty where there is no git or no checkout."""
    try:
        answer = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(root), *arguments],
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""


def _processor() -> str:
    """Return the processor's name."""
    information = Path("/proc/cpuinfo")
    if information.is_file():
        for line in information.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory_gib() -> float | None:
    """Return the machine's memory in GiB, None where the system does not tell."""
    if not hasattr(os, "sysconf"):
        return None
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError):
        return None


def _version(package: str) -> str | None:
    """Return the version of an installed package without importing it."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
