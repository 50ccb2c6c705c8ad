"""Which kind of laptop this is, and where its virtual environment keeps things."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

#: Folder of the virtual environment in the workshop's own.
VENV = ".venv"
_SYSTEMS = {"Linux": "linux", "Windows": "windows", "Darwin": "macos"}
_MACHINES = {"amd64": "x86_64", "aarch64": "arm64"}


class Refused(Exception):
    """What cannot be done, said so that a participant knows what to do."""


def key_of(system: str, machine: str, python: tuple[int, int]) -> str:
    """Return the name of a kind of laptop, as ``windows-x86_64-cp312``, from what Python's ``platform`` says."""
    lower = machine.lower()
    name = _SYSTEMS.get(system, system.lower() or "unknown")
    return f"{name}-{_MACHINES.get(lower, lower)}-cp{python[0]}{python[1]}"


def this_key() -> str:
    """Return the name of this laptop's kind, by the Python that runs."""
    return key_of(platform.system(), platform.machine(), sys.version_info[:2])


def system_version() -> str:
    """Return the version that wheels ask for: of glibc on Linux, of macOS; empty where it is not told."""
    if platform.system() == "Linux":
        return platform.libc_ver()[1]
    return platform.mac_ver()[0]


def older(version: str, least: str) -> bool:
    """Say whether a version, as ``2.31`` or ``14.2.1``, is older than another; one that is not told is not."""
    if not version or not least:
        return False
    return [int(part) for part in version.split(".")] < [int(part) for part in least.split(".")]


def on_windows() -> bool:
    """Say whether this is Windows."""
    return os.name == "nt"


def venv_python(folder: Path) -> Path:
    """Return where the Python of the workshop in ``folder`` lies, whether it is there or not."""
    if on_windows():
        return folder / VENV / "Scripts" / "python.exe"
    return folder / VENV / "bin" / "python"
