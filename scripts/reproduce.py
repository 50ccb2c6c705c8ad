"""Makes every paper's table at standard size, and a page that says on what machine, when, and how long it took.

``python scripts/reproduce.py`` runs ``toolkit table`` for each. Runs that are finished are taken as they are: what
was stopped goes on with the next call, and a second call only writes the tables again. ``--quick`` makes tiny
tables that show that all of it works, and nothing else.
"""

from __future__ import annotations

import argparse
import datetime
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from toolkit.errors import SettingsError, StageError, ToolkitError
from toolkit.files import read_json, write_json, write_text
from toolkit.runs.machine import describe_code, describe_machine

RESULTS: Final = Path("docs/results")
PAGE: Final = "reproduced.md"
#: Beside a table: how it was made.
RECORD: Final = "reproduced.json"


@dataclass(frozen=True, slots=True)
class Table:
    """A paper's table.

    Attributes
    ----------
    title:
        What it is.
    standard:
        What ``toolkit table`` is told for the size that docs/results is meant to have, beside its name and folders.
    quick:
        The same for the smallest that goes through the same code.
    sample:
        What ``toolkit sample`` is told for the data of the quick one, beside its folder.
    """

    title: str
    standard: tuple[str, ...]
    quick: tuple[str, ...]
    sample: tuple[str, ...]


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


TABLES: Final[Mapping[str, Table]] = {
    "a-3dgs": Table(
        "A-3DGS, Table 3: poses of drone video, and the splats trained on them",
        _words("--train-steps 1000 --max-side 480"),
        _words("--rows sensor-dpt sensor-3dgs --train-steps 30 --max-side 160 --fit-steps 0"),
        _words(
            "town --town.trees 20 --flight.frames 10 --flight.arc 120 --flight.image-width 200 "
            "--flight.image-height 150"
        ),
    ),
    "blades-camera-models": Table(
        "Blades, Table 1: the arc that each camera model finds",
        (),
        _words("--rows known"),
        _words(
            "engine --rotor.blades 24 --film.step 3 --film.frames 12 --film.samples 1 --borescope.image-width 240 "
            "--borescope.image-height 180"
        ),
    ),
    "blades-nerf": Table(
        "Blades, Tables 2 and 3: radiance fields on segments, with and without depth",
        _words("--stride 2"),
        _words("--rows nerf-40 --stride 5 --train-steps 20 --max-side 64"),
        _words(
            "engine --rotor.blades 24 --film.step 1 --film.frames 40 --film.samples 1 --borescope.image-width 160 "
            "--borescope.image-height 120"
        ),
    ),
    "satellite-3d": Table(
        "Satellite pictures: surface models and splats with and without RPCs",
        _words("--train-steps 1500"),
        _words("--rows heights"),
        _words("city --plan.size 64 --plan.tallest 20 --orbit.views 7"),
    ),
    "uav-localization": Table(
        "Localisation, Tables 1 to 3: maps of disks, and the poses found in them",
        _words("--train-steps 3000 --max-side 480"),
        _words("--rows 2dgs-sparse --train-steps 30 --max-side 200"),
        _words(
            "nadir --town.extent 150 --town.buildings 15 --town.trees 80 --path.map-photos 8 --path.leg-spacing 20 "
            "--camera.image-width 200 --camera.image-height 150"
        ),
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the tables and return the exit code: 0, or 2 where one failed or something is in the way."""
    given = _parser().parse_args(arguments)
    try:
        return reproduce(given)
    except KeyboardInterrupt:
        print("stopped; the next call goes on", file=sys.stderr)
        return 130
    except ToolkitError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="reproduce.py", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--only", nargs="+", choices=tuple(TABLES), metavar="TABLE", help="of " + ", ".join(TABLES))
    parser.add_argument(
        "--quick", action="store_true", help="tiny data and few steps: whether it works, no results; below --runs"
    )
    parser.add_argument("--runs", type=Path, metavar="DIR", help="folder of runs [runs, quick: runs/quick]")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help=f"for tables [{RESULTS}, quick: runs/quick/results]"
    )
    parser.add_argument("--force", action="store_true", help="make finished runs again")
    return parser


def reproduce(given: argparse.Namespace) -> int:
    """Make the tables that are asked for, and the page of all that are there; return the exit code."""
    runs = given.runs or Path("runs/quick" if given.quick else "runs")
    out = given.out or (runs / "results" if given.quick else RESULTS)
    _refuse_mixture(out, quick=given.quick)
    failed = []
    names = given.only or list(TABLES)
    for number, name in enumerate(names, 1):
        print(f"{name}: table {number} of {len(names)} ...", flush=True)
        record = make_table(name, runs / name, out / name, quick=given.quick, force=given.force)
        if record["exit"]:
            failed.append(name)
        records = read_records(out)
        if records:
            write_text(out / PAGE, page(out, records))
            print(f"Wrote {out / PAGE}", flush=True)
    if failed:
        print(f"error: not made: {', '.join(failed)}", file=sys.stderr)
    return 2 if failed else 0


def _refuse_mixture(out: Path, *, quick: bool) -> None:
    """Keep tiny tables and true ones apart."""
    for record in read_records(out).values():
        if bool(record["quick"]) != quick:
            there, wanted = ("quick", "standard") if record["quick"] else ("standard", "quick")
            raise SettingsError(
                f"{out} holds tables of {there} size",
                expected=f"of {wanted} size, or none",
                todo="Choose another --out",
            )


def make_table(name: str, runs: Path, out: Path, *, quick: bool, force: bool = False) -> dict[str, Any]:
    """Run ``toolkit table`` in a process of its own, write down how, and return that.

    Seconds of earlier calls that were made for the same table with the same code are kept: what was stopped and
    went on took all of them.

    Raises
    ------
    StageError
        Where the data of a quick table cannot be made.
    """
    table = TABLES[name]
    arguments = ["table", name, *(table.quick if quick else table.standard)]
    folders = ["--runs", runs.as_posix(), "--out", out.as_posix()]
    if quick:
        data = runs / ".data" / "quick"
        folders += ["--data", data.as_posix()]
        if not data.is_dir() and _toolkit(["sample", *table.sample, "--to", data.as_posix()]):
            raise StageError(f"The data of the quick table {name} could not be made")
    commands = [["toolkit", "sample", *table.sample]] if quick else []
    commands.append(["toolkit", *arguments])
    made_with = {"commands": commands, "quick": quick, "code": describe_code()["sources"]}
    began, date = time.monotonic(), datetime.datetime.now(datetime.UTC)
    earlier = [] if force else _sittings(runs / RECORD, made_with)
    code = _toolkit([*arguments, *folders, *(["--force"] if force else [])])
    record = {
        **made_with,
        "exit": code,
        "date": date.isoformat(timespec="minutes"),
        "sittings": [*earlier, round(time.monotonic() - began, 1)],
        "version": describe_code(),
        "machine": describe_machine("cpu"),
        "photographs": "TOOLKIT_DATA" in os.environ,
    }
    write_json(runs / RECORD, record)
    if code == 0:
        write_json(out / RECORD, record)
    return record


def _toolkit(arguments: Sequence[str]) -> int:
    """Run the command line and return its exit code."""
    environment = {**os.environ, "PYTHONUTF8": "1"}
    return subprocess.run([sys.executable, "-m", "toolkit", *arguments], env=environment, check=False).returncode


def _sittings(path: Path, made_with: Mapping[str, Any]) -> list[float]:
    """Return the seconds of earlier calls for the same table."""
    if not path.is_file():
        return []
    found = read_json(path)
    return list(found["sittings"]) if all(found.get(key) == value for key, value in made_with.items()) else []


def read_records(out: Path) -> dict[str, dict[str, Any]]:
    """Return how the tables that are there were made, by their names."""
    return {name: read_json(out / name / RECORD) for name in TABLES if (out / name / RECORD).is_file()}


def page(out: Path, records: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the page of the tables below ``out``: how each was made, with links to them."""
    quick = any(record["quick"] for record in records.values())
    lines = ["# Tables made again", ""]
    if quick:
        lines += [
            "**Quick: tiny data and a few steps. These tables show that the commands work; they are no results.**",
            "",
        ]
    command = "python scripts/reproduce.py" + (" --quick" if quick else "")
    lines += [
        f"Made by `{command}` (`make reproduce`); each table stands beside the paper's figures.",
        "",
        "| table | files | made by | on | seconds | toolkit |",
        "|---|---|---|---|---|---|",
    ]
    lines += [_line(name, record, out) for name, record in records.items()]
    lines += ["", "Seconds are those of all calls that it took, with finished runs taken as they were."]
    if not all(record["photographs"] for record in records.values()):
        lines.append(
            "Where `TOOLKIT_DATA` named no folder, the photographs that were fetched earlier, or none, were taken."
        )
    machines: dict[str, list[str]] = {}
    for name, record in records.items():
        machines.setdefault(_machine(record["machine"]), []).append(name)
    for machine, names in machines.items():
        lines += ["", f"## Machine of {', '.join(names)}", "", machine]
    return "\n".join(lines) + "\n"


def _line(name: str, record: Mapping[str, Any], out: Path) -> str:
    files = sorted(path for path in (out / name).iterdir() if path.suffix in (".md", ".csv"))
    links = ", ".join(f"[{path.name}]({name}/{path.name})" for path in files)
    sittings = record["sittings"]
    seconds = f"{sum(sittings):.0f}" + (f" in {len(sittings)} calls" if len(sittings) > 1 else "")
    version = record["version"]
    commit = version.get("commit", "")[:10] + (" and changes" if version.get("changed") else "")
    told = f"{version['version']} {commit}".strip()
    commands = ", ".join(f"`{' '.join(words)}`" for words in record["commands"])
    return f"| {TABLES[name].title} | {links} | {commands} | {record['date']} | {seconds} | {told} |"


def _machine(machine: Mapping[str, Any]) -> str:
    memory = (
        f"{machine['memory_gib']} GiB of memory" if machine.get("memory_gib") else "memory not told by the system"
    )
    libraries = ", ".join(f"{name} {version}" for name, version in machine["libraries"].items())
    return (
        f"- {machine['cpu']}, {machine['cores']} cores, {memory}\n- {machine['system']}\n"
        f"- Python {machine['python']}, {libraries}"
    )


if __name__ == "__main__":
    sys.exit(main())
