"""The parts of the bundle, each of which is only made where it is missing, and its manifest."""

from __future__ import annotations

import datetime
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from packaging.metadata import parse_email
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name, parse_wheel_filename

import toolkit
from scripts.workshop.laptop.kit.here import VENV
from scripts.workshop.laptop.kit.installing import REQUIREMENTS, RUNS, WHEELS
from scripts.workshop.laptop.kit.manifest import NAME, Manifest, entries_of, sha256_of
from scripts.workshop.targets import Target
from toolkit.errors import RunError, SettingsError, StageError
from toolkit.files import disk_errors, write_json, write_text

ROOT: Final = Path(__file__).parents[2]
LAPTOP: Final = Path(__file__).parent / "laptop"
#: Of the toolkit's sources, what the wheel does not need.
_NO_SOURCES: Final = ("__pycache__", "node_modules", "*.egg-info")
#: Longest part of a path that Python itself adds below a virtual environment for Windows: the folder of packages,
#: and of compiled files their folder and ending.
_PACKAGES, _COMPILED = len("Lib\\site-packages\\"), len("__pycache__\\") + len(".cpython-311.pyc") - len(".py")


@dataclass(frozen=True, slots=True)
class Bundle:
    """Where everything goes.

    Attributes
    ----------
    folder:
        What participants get.
    """

    folder: Path

    @property
    def teacher(self) -> Path:
        """What only the teacher gets: solutions and the guide."""
        return self.folder.with_name(f"{self.folder.name}-teacher")

    @property
    def work(self) -> Path:
        """Where runs are made, with what later runs can use again."""
        return self.folder.with_name(f"{self.folder.name}-work")


def begin(bundle: Bundle) -> None:
    """Make the folder, or take the one of an earlier call.

    Raises
    ------
    SettingsError
        Where it holds something else, which would be mixed with the bundle.
    RunError
        Where it cannot be written.
    """
    folder = bundle.folder
    if folder.exists() and any(folder.iterdir()) and not (folder / WHEELS).is_dir():
        raise SettingsError(
            f"{folder} holds something else", expected="a bundle, or a new folder", todo="Choose another --out"
        )
    with disk_errors(folder, "writing"):
        (folder / WHEELS).mkdir(parents=True, exist_ok=True)


def toolkit_wheel(wheels: Path) -> Path:
    """Build the toolkit's own wheel from this checkout and return it; an older one goes.

    Raises
    ------
    StageError
        Where pip cannot build it.
    """
    with tempfile.TemporaryDirectory(prefix="workshop-") as place:
        # Of a copy: building leaves files beside the sources, and takes old ones from there.
        sources, built = Path(place) / "sources", Path(place) / "built"
        shutil.copytree(ROOT / "toolkit", sources / "toolkit", ignore=shutil.ignore_patterns(*_NO_SOURCES))
        for name in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy2(ROOT / name, sources / name)
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
        answer = subprocess.run(
            [*command, "--wheel-dir", str(built), str(sources)], capture_output=True, text=True, check=False
        )
        found = sorted(built.glob("*.whl")) if built.is_dir() else []
        if answer.returncode or len(found) != 1:
            raise StageError("pip did not build the toolkit's wheel", found=answer.stderr.strip()[-500:])
        name = parse_wheel_filename(found[0].name)[0]
        for old in wheels.glob("*.whl"):
            if parse_wheel_filename(old.name)[0] == name:
                old.unlink()
        return Path(shutil.move(found[0], wheels / found[0].name))


def write_requirements(bundle: Bundle, chosen: Mapping[Target, Mapping[str, Path]]) -> None:
    """Write what each kind of laptop installs, with hashes, and remove wheels that none does."""
    for target, wheels in chosen.items():
        lines = [_pinned(path) for _, path in sorted(wheels.items())]
        write_text(bundle.folder / REQUIREMENTS / f"{target.key}.txt", "\n".join(lines) + "\n")
    wanted = {path for wheels in chosen.values() for path in wheels.values()}
    for path in (bundle.folder / WHEELS).iterdir():
        if path not in wanted:
            path.unlink()
    keys = {f"{target.key}.txt" for target in chosen}
    for path in (bundle.folder / REQUIREMENTS).iterdir():
        if path.name not in keys:
            path.unlink()


def _pinned(wheel: Path) -> str:
    name, version, _, _ = parse_wheel_filename(wheel.name)
    return f"{name}=={version} --hash=sha256:{sha256_of(wheel)}"


def copy_texts(bundle: Bundle) -> None:
    """Copy notebooks, handouts and the kit, and for the teacher solutions and guide; what was there before goes."""
    folder = bundle.folder
    plain = shutil.ignore_patterns("__pycache__", "solutions", ".ipynb_checkpoints")
    for name, source in (
        ("notebooks", ROOT / "notebooks"),
        ("handouts", ROOT / "docs" / "handouts"),
        ("kit", LAPTOP / "kit"),
    ):
        shutil.rmtree(folder / name, ignore_errors=True)
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=plain)
    for name in ("install.py", "start.py", "START-HERE.md"):
        shutil.copy2(LAPTOP / name, folder / name)
    shutil.copy2(ROOT / "LICENSE", folder / "LICENSE")
    shutil.copy2(ROOT / "scripts" / "jupyter_config.py", folder / "kit" / "jupyter_config.py")
    shutil.rmtree(bundle.teacher, ignore_errors=True)
    shutil.copytree(
        ROOT / "notebooks" / "solutions", bundle.teacher / "solutions", ignore=shutil.ignore_patterns("__pycache__")
    )
    shutil.copy2(ROOT / "docs" / "instructor.md", bundle.teacher / "instructor.md")


def write_manifest(bundle: Bundle, chosen: Mapping[Target, Mapping[str, Path]]) -> Manifest:
    """Write the list of all files of the bundle with their hashes, and return it."""
    files = [
        path for path in bundle.folder.rglob("*") if path.is_file() and _listed(path.relative_to(bundle.folder))
    ]
    manifest = Manifest(
        toolkit=toolkit.__version__,
        made=datetime.datetime.now(datetime.UTC).date().isoformat(),
        least_python={target.key: least_python(target, list(wheels.values())) for target, wheels in chosen.items()},
        least_system={target.key: least_system(target, list(wheels.values())) for target, wheels in chosen.items()},
        longest_path={target.key: longest_path(list(wheels.values())) for target, wheels in chosen.items()},
        unpacked={target.key: unpacked_size(list(wheels.values())) for target, wheels in chosen.items()},
        files=entries_of(bundle.folder, files),
    )
    write_json(bundle.folder / NAME, manifest.to_dict())
    return manifest


def _listed(path: Path) -> bool:
    """Say whether a file is the bundle's: not the manifest, nor what an installation in it left."""
    return path.as_posix() != NAME and path.parts[0] != VENV and "__pycache__" not in path.parts


def least_python(target: Target, wheels: Sequence[Path]) -> str:
    """Return the oldest patch release of the target's Python that all wheels take.

    Raises
    ------
    StageError
        Where there is none up to the target's newest.
    """
    wanted = SpecifierSet()
    for wheel in wheels:
        wanted &= SpecifierSet(_metadata(wheel).get("requires_python") or "")
    major_minor, _, newest = target.newest.rpartition(".")
    for patch in range(int(newest) + 1):
        if wanted.contains(f"{major_minor}.{patch}"):
            return f"{major_minor}.{patch}"
    raise StageError(f"No release of Python fits all wheels for {target.key}", expected=str(wanted))


def least_system(target: Target, wheels: Sequence[Path]) -> str:
    """Return the oldest glibc, or macOS, that all wheels run on; empty where none of them asks for one."""
    needed = [_system_of(target, wheel) for wheel in wheels]
    return ".".join(map(str, max(needed))) if any(needed) else ""


def _system_of(target: Target, wheel: Path) -> tuple[int, ...]:
    """Return the version that a wheel asks for by that of its tags which asks for least."""
    tags = parse_wheel_filename(wheel.name)[3] & set(target.tags)
    return min((_asked_by(tag.platform) for tag in tags), default=())


def _asked_by(platform: str) -> tuple[int, ...]:
    old = {"manylinux2014": (2, 17), "manylinux2010": (2, 12), "manylinux1": (2, 5)}
    name, *rest = platform.split("_")
    if name in ("manylinux", "macosx"):
        return (int(rest[0]), int(rest[1]))
    return old.get(name, ())


def _metadata(wheel: Path) -> Mapping[str, str]:
    with zipfile.ZipFile(wheel) as archive:
        (entry,) = (
            name for name in archive.namelist() if name.endswith(".dist-info/METADATA") and name.count("/") == 1
        )
        raw, _ = parse_email(archive.read(entry))
    return {name: value for name, value in raw.items() if isinstance(value, str)}


def longest_path(wheels: Sequence[Path]) -> int:
    """Return the characters of the longest path that the wheels make below a virtual environment on Windows."""
    longest = 0
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            for name in archive.namelist():
                longest = max(longest, _PACKAGES + len(name) + (_COMPILED if name.endswith(".py") else 0))
    return longest


def unpacked_size(wheels: Sequence[Path]) -> int:
    """Return about how many bytes the wheels take when they are installed; Python files are there compiled, too."""
    size = 0
    for wheel in wheels:
        with zipfile.ZipFile(wheel) as archive:
            size += sum(info.file_size * (2 if info.filename.endswith(".py") else 1) for info in archive.infolist())
    return size


def sizes(bundle: Bundle) -> dict[str, int]:
    """Return the bytes of each part of the bundle, by the part's name."""
    parts: dict[str, int] = {}
    for path in bundle.folder.rglob("*"):
        inner = path.relative_to(bundle.folder)
        if path.is_file() and _listed(inner):
            part = inner.parts[0] if len(inner.parts) > 1 else "scripts and texts"
            part = "runs made beforehand" if inner.is_relative_to(RUNS) else {"runs": "samples"}.get(part, part)
            parts[part] = parts.get(part, 0) + path.stat().st_size
    return parts


def require_room(bundle: Bundle, needed: int) -> None:
    """Raise :class:`RunError` where the disk has less than ``needed`` bytes free beside what is there already."""
    there = next(place for place in (bundle.folder, *bundle.folder.absolute().parents) if place.exists())
    left = max(0, needed - sum(sizes(bundle).values())) if bundle.folder.exists() else needed
    free = shutil.disk_usage(there).free
    if free < left:
        raise RunError(
            f"The disk of {bundle.folder} is too full for the bundle",
            expected=f"{left / 1e9:.1f} GB",
            found=f"{free / 1e9:.1f} GB free",
            todo="Free some, choose another --out, or fewer --platforms and --pythons",
        )


def zip_bundle(bundle: Bundle) -> Path:
    """Return a zip of the bundle beside it; wheels and pictures are stored as they are."""
    path = bundle.folder.with_name(f"{bundle.folder.name}.zip")
    with disk_errors(path, "writing"), zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for each in sorted(bundle.folder.rglob("*")):
            inner = each.relative_to(bundle.folder)
            if each.is_file() and (_listed(inner) or inner.as_posix() == NAME):
                archive.write(each, Path(bundle.folder.name) / inner)
    return path


def own_name() -> str:
    """Return the toolkit's name as a package."""
    return canonicalize_name("sightline-toolkit")
