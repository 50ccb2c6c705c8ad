"""Installing the workshop from the bundle's wheels, without any network."""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from .here import VENV, Refused, older, on_windows, system_version, this_key, venv_python
from .manifest import COPY_AGAIN, NAME, Manifest, check_files, read_manifest, sha256_of, told

#: Written into the virtual environment when all of it is there.
MARK = "workshop.json"
WHEELS, REQUIREMENTS = "wheels", "requirements"
#: Runs made beforehand; their data are named relative to the bundle until they are installed.
RUNS = "runs/workshop"
#: Longest path that Windows takes unless it was told otherwise.
_WINDOWS_PATH = 259
#: What Open3D's wheel for Linux links against and a bare system may lack, and Debian's packages with it.
LIBRARIES = "libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libX11.so.6 libudev.so.1 libidn2.so.0 libgomp.so.1"
PACKAGES = "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libidn2-0 libgomp1"
#: What PyTorch and numba link against on Windows, and Python does not bring.
RUNTIME = "msvcp140.dll vcruntime140_1.dll"


def main(arguments: Sequence[str], bundle: Path | None = None) -> int:
    """Install and return the exit code: 0, or 2 where something is in the way, which is printed."""
    parser = argparse.ArgumentParser(prog="install.py", description=__doc__)
    parser.add_argument(
        "--to",
        type=Path,
        metavar="FOLDER",
        help="copy notebooks, samples and runs to this folder and install there, as from a stick [here]",
    )
    parser.add_argument("--again", action="store_true", help="install again where it was installed before")
    given = parser.parse_args(arguments)
    source = bundle or Path(__file__).resolve().parent.parent
    try:
        install(source, (given.to or source).resolve(), again=given.again)
    except Refused as refused:
        print(f"\nNot installed. {refused}", file=sys.stderr)
        return 2
    return 0


def install(bundle: Path, folder: Path, *, again: bool = False) -> None:
    """Install the workshop into ``folder``, which may be the bundle itself.

    Raises
    ------
    Refused
        Where the bundle is not for this laptop or is damaged, and where the laptop lacks what is needed.
    """
    manifest = read_manifest(bundle)
    key = this_key()
    requirements = bundle / REQUIREMENTS / f"{key}.txt"
    _check_laptop(manifest, key)
    mark = folder / VENV / MARK
    if not again and _is_installed(mark, bundle):
        print(f"The workshop is installed in {folder} already.")
    else:
        _check_room(manifest, key, bundle, folder)
        _check_libraries()
        _check_bundle(bundle, manifest, whole=not mark.exists())
        if folder != bundle:
            _copy(bundle, folder, manifest)
        _make_venv(folder)
        _install_wheels(folder, bundle / WHEELS, requirements)
        place_runs(folder)
        mark.write_text(json.dumps({"manifest": sha256_of(bundle / NAME)}), encoding="utf-8")
    print(next_steps(folder))


def next_steps(folder: Path) -> str:
    """Return what to type next."""
    python = "py" if on_windows() else "python3"
    return f"""
Installed. Next, in a terminal:

  cd "{folder}"
  {python} start.py check       one or two minutes: does all of it work here?
  {python} start.py lab         the notebooks, in the browser (Ctrl-C ends it)
  {python} start.py dashboard   the page of runs, in the browser (Ctrl-C ends it)
"""


def _check_laptop(manifest: Manifest, key: str) -> None:
    least = manifest.least_python.get(key)
    if least is None:
        there = ", ".join(sorted(manifest.least_python))
        raise Refused(
            f"This bundle has no wheels for this Python, {key}; it has them for: {there}. "
            "Start install.py with one of these Pythons (cp311 is Python 3.11), or ask for a bundle with yours."
        )
    if older(".".join(map(str, sys.version_info[:3])), least):
        raise Refused(
            f"Python {least} or a later release of it is needed, this is {sys.version.split()[0]}. Install its "
            "newest release."
        )
    system, oldest = system_version(), manifest.least_system[key]
    if older(system, oldest):
        what = "macOS" if sys.platform == "darwin" else "A Linux with glibc"
        raise Refused(
            f"{what} {oldest} or newer is needed, this is {system}. Work on another laptop, or beside a neighbour."
        )


def _is_installed(mark: Path, bundle: Path) -> bool:
    try:
        return bool(json.loads(mark.read_text(encoding="utf-8"))["manifest"] == sha256_of(bundle / NAME))
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _check_room(manifest: Manifest, key: str, bundle: Path, folder: Path) -> None:
    needed = manifest.unpacked[key]
    if folder != bundle:
        needed += sum(entry.size for name, entry in manifest.files.items() if _goes_along(name))
    there = next(place for place in (folder, *folder.parents) if place.exists())
    free = shutil.disk_usage(there).free
    if free < needed:
        raise Refused(
            f"The disk of {folder} has {free / 1e9:.1f} GB free, {needed / 1e9:.1f} GB are needed. Free some, or "
            "choose another disk by --to FOLDER."
        )
    longest = len(str(folder / VENV)) + 1 + manifest.longest_path[key]
    if on_windows() and longest > _WINDOWS_PATH:
        raise Refused(
            f"Paths below {folder} would have up to {longest} characters, of which Windows takes {_WINDOWS_PATH}. "
            "Choose a folder with a shorter name: install.py --to C:\\workshop"
        )


def _check_libraries() -> None:
    wanted = RUNTIME if on_windows() else LIBRARIES if sys.platform == "linux" else ""
    missing = []
    for name in wanted.split():
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    if missing:
        cure = (
            "Install Microsoft's Visual C++ Redistributable, from the teacher's stick or "
            "https://aka.ms/vs/17/release/vc_redist.x64.exe"
            if on_windows()
            else f"With the network, on Debian and Ubuntu: sudo apt-get install {PACKAGES}"
        )
        raise Refused(f"Libraries of the system are missing: {' '.join(missing)}. {cure}")


def _check_bundle(bundle: Path, manifest: Manifest, *, whole: bool) -> None:
    """Refuse a bundle with damaged files; ``whole`` is False where notebooks and runs may have been worked on."""
    files = {name: entry for name, entry in manifest.files.items() if whole or not _goes_along(name)}
    print(f"Checking {len(files)} files of the bundle, {sum(e.size for e in files.values()) / 1e9:.2f} GB ...")
    wrong = check_files(bundle, files)
    if wrong:
        raise Refused(f"The bundle in {bundle} is damaged:\n{told(wrong)}\n{COPY_AGAIN}")


def _goes_along(name: str) -> bool:
    """Say whether a file is copied to where participants work: all but what is only installed from."""
    return name.split("/", 1)[0] not in (WHEELS, REQUIREMENTS)


def _copy(bundle: Path, folder: Path, manifest: Manifest) -> None:
    names = [name for name in manifest.files if _goes_along(name)]
    print(f"Copying {len(names)} files to {folder} ...")
    kept = 0
    try:
        for name in names:
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():
                kept += 1
            else:
                shutil.copyfile(bundle / name, target)
        shutil.copyfile(bundle / NAME, folder / NAME)  # by which the samples are known
    except OSError as error:
        raise Refused(f"{folder} cannot be written: {error}. Choose another one by --to FOLDER.") from None
    if kept:
        print(f"{kept} files were there already and are as they were.")


def _make_venv(folder: Path) -> None:
    print("Making a virtual environment ...")
    command = [sys.executable, "-m", "venv", "--clear", str(folder / VENV)]
    answer = subprocess.run(command, check=False)
    if answer.returncode:
        raise Refused(
            "Python could not make a virtual environment; what it says stands above. On Debian and Ubuntu it needs "
            f"the package python{sys.version_info[0]}.{sys.version_info[1]}-venv; the Python of Windows' store is "
            "best replaced by that of python.org."
        )


def clean_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return variables without those by which pip would look elsewhere than in the bundle."""
    kept = {name: value for name, value in environment.items() if not name.upper().startswith("PIP_")}
    return {**kept, "PIP_CONFIG_FILE": os.devnull, "PYTHONUTF8": "1"}


def _install_wheels(folder: Path, wheels: Path, requirements: Path) -> None:
    print("Installing the wheels: some minutes ...")
    # All versions and hashes are in the file: nothing is looked for that the bundle does not have.
    command = [str(venv_python(folder)), "-m", "pip", "install", "--no-index", "--find-links", str(wheels)]
    command += ["--no-deps", "--require-hashes", "--disable-pip-version-check", "--progress-bar", "off", "--quiet"]
    answer = subprocess.run(
        [*command, "--requirement", str(requirements)], check=False, env=clean_environment(os.environ)
    )
    if answer.returncode:
        raise Refused(f"pip could not install the wheels; what it says stands above. {COPY_AGAIN}")


def place_runs(folder: Path) -> None:
    """Let the runs that were made beforehand name their data by where they are now."""
    for path in sorted((folder / RUNS).glob("*/run.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        data = Path(record["data"])
        if not data.is_absolute():
            record["data"] = str(folder / data)
            path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
