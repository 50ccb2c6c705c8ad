"""The laptops that a bundle is for: system, processor and Python, as pip and environment markers name them."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from packaging.tags import Tag, compatible_tags, cpython_tags, mac_platforms

from scripts.workshop.laptop.kit.here import key_of
from toolkit.errors import SettingsError

#: Newest glibc that a Linux wheel may ask for: that of Ubuntu 22.04.
_GLIBC: Final = 35
#: Oldest macOS on which PyTorch's wheels run.
_MACOS: Final = (14, 0)
#: The first Python that the toolkit runs on.
OLDEST: Final = (3, 11)
#: Patch release that wheels may ask for: 3.11.9 and 3.12.10 are the last ones with installers at python.org.
_PATCH: Final = {(3, 11): 9, (3, 12): 10}
_USUAL_PATCH: Final = 5


@dataclass(frozen=True, slots=True)
class System:
    """An operating system on one kind of processor.

    Attributes
    ----------
    machine:
        Processor as the system itself calls it.
    platforms:
        Tags of wheels that run on it, the best first.
    os_name, sys_platform, platform_system:
        What Python says of it.
    """

    machine: str
    platforms: tuple[str, ...]
    os_name: str
    sys_platform: str
    platform_system: str


def _linux_platforms(machine: str) -> tuple[str, ...]:
    manylinux = [f"manylinux_2_{minor}_{machine}" for minor in range(_GLIBC, 4, -1)]
    older = [f"manylinux{name}_{machine}" for name in ("2014", "2010", "1")]
    return (*manylinux, *older, f"linux_{machine}")


SYSTEMS: Final = {
    "linux": System("x86_64", _linux_platforms("x86_64"), "posix", "linux", "Linux"),
    "windows": System("AMD64", ("win_amd64",), "nt", "win32", "Windows"),
    "macos": System("arm64", tuple(mac_platforms(_MACOS, "arm64")), "posix", "darwin", "Darwin"),
}


@dataclass(frozen=True)
class Target:
    """One kind of laptop.

    Attributes
    ----------
    system:
        Name in :data:`SYSTEMS`.
    python:
        Major and minor version.
    """

    system: str
    python: tuple[int, int]

    @property
    def key(self) -> str:
        """Its name in the bundle, as ``linux-x86_64-cp311``."""
        found = SYSTEMS[self.system]
        return key_of(found.platform_system, found.machine, self.python)

    @property
    def newest(self) -> str:
        """Newest release of its Python that its wheels may ask for."""
        return f"{self.python[0]}.{self.python[1]}.{_PATCH.get(self.python, _USUAL_PATCH)}"

    @cached_property
    def tags(self) -> tuple[Tag, ...]:
        """Tags of wheels that it installs, the best first."""
        platforms = SYSTEMS[self.system].platforms
        return (
            *cpython_tags(self.python, platforms=platforms),
            *compatible_tags(self.python, f"cp{self.python[0]}{self.python[1]}", platforms),
        )

    @property
    def markers(self) -> dict[str, str]:
        """What environment markers such as ``sys_platform == 'win32'`` are judged by there."""
        found = SYSTEMS[self.system]
        version = ".".join(map(str, self.python))
        return {
            "implementation_name": "cpython",
            "implementation_version": self.newest,
            "os_name": found.os_name,
            "platform_machine": found.machine,
            "platform_python_implementation": "CPython",
            "platform_release": "",
            "platform_system": found.platform_system,
            "platform_version": "",
            "python_full_version": self.newest,
            "python_version": version,
            "sys_platform": found.sys_platform,
        }

    @property
    def pip_flags(self) -> list[str]:
        """Options by which pip looks for wheels of this target, on any machine."""
        abi = f"cp{self.python[0]}{self.python[1]}"
        flags = ["--implementation", "cp", "--python-version", self.newest]
        for value in (abi, "abi3", "none"):
            flags += ["--abi", value]
        for value in SYSTEMS[self.system].platforms:
            flags += ["--platform", value]
        return flags


def this_system() -> str:
    """Return the name of this machine's system.

    Raises
    ------
    SettingsError
        For one that no bundle can be made for.
    """
    for name, system in SYSTEMS.items():
        if (platform.system(), platform.machine()) == (system.platform_system, system.machine):
            return name
    raise SettingsError(
        "No bundle can be made for this kind of machine",
        expected=", ".join(f"{name} on {system.machine}" for name, system in SYSTEMS.items()),
        found=f"{platform.system()} on {platform.machine()}",
        todo="Name the participants' systems by --platforms",
    )


def targets_of(systems: list[str], pythons: list[str]) -> list[Target]:
    """Return every system with every version of Python; ``this`` stands for this machine's.

    Raises
    ------
    SettingsError
        For an unknown system, what is no version, and one that is too old.
    """
    found = []
    for name in systems:
        system = this_system() if name == "this" else name
        if system not in SYSTEMS:
            raise SettingsError(f"Unknown platform '{name}'", expected="one of this, " + ", ".join(SYSTEMS))
        for text in pythons:
            found.append(Target(system, _version(text)))
    return list(dict.fromkeys(found))


def _version(text: str) -> tuple[int, int]:
    if text == "this":
        return sys.version_info[:2]
    parts = text.split(".")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        raise SettingsError(f"'{text}' is no version of Python", expected="as 3.11, or this")
    version = (int(parts[0]), int(parts[1]))
    if version < OLDEST:
        raise SettingsError(f"Python {text} is too old for the toolkit", expected="3.11 or newer", found=text)
    return version
