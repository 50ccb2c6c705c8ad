"""Commands on runs: list methods, run, list, show, compare, resume, export."""

from __future__ import annotations

import argparse
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from toolkit.cli.common import RUN_HELP, add, add_runs_dir, with_bar
from toolkit.errors import SettingsError, ToolkitError
from toolkit.progress import Progress

if TYPE_CHECKING:
    from toolkit.runs.folder import RunFolder
    from toolkit.settings import Settings


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Add all commands on runs."""
    for one in (_add_recipes, _add_run, _add_runs, _add_show, _add_compare, _add_resume, _add_export):
        one(commands)


def _add_recipes(commands: argparse._SubParsersAction) -> None:
    added = add(commands, "recipes", _recipes, "List methods, or the settings of one.", "recipes colmap-3dgs")
    added.add_argument("name", nargs="?", metavar="NAME", help="show this one's settings")


def _recipes(arguments: argparse.Namespace) -> None:
    from toolkit.recipes.registry import all_recipes, find_recipe
    from toolkit.runs.text import recipe_text, recipes_text

    print(recipe_text(find_recipe(arguments.name)) if arguments.name else recipes_text(all_recipes().values()))


def _add_run(commands: argparse._SubParsersAction) -> None:
    added = add(
        commands,
        "run",
        _run,
        "Run a method on a folder of pictures.",
        "run colmap-3dgs --data photos/ --set train.steps=500 --name quick",
    )
    added.add_argument("recipe", metavar="RECIPE", help="name of the method (toolkit recipes lists them)")
    added.add_argument("--data", type=Path, required=True, metavar="FOLDER", help="the capture")
    added.add_argument(
        "--camera",
        type=Path,
        metavar="PROFILE",
        help="known intrinsics, not refined unless --set says so: a profile that toolkit calibrate wrote, or a "
        "folder of profiles to find the photos' camera in",
    )
    added.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    base = added.add_mutually_exclusive_group()
    base.add_argument("--settings", type=Path, metavar="FILE", help="settings as JSON; --set comes after")
    base.add_argument(
        "--preset", metavar="NAME", help="draft, standard or paper (toolkit recipes RECIPE); --set comes after"
    )
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    added.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute [cpu]")
    added.add_argument("--name", default="", metavar="TEXT", help="what to call the run")
    added.add_argument(
        "--queue",
        action="store_true",
        help="let it wait for its turn and come back; toolkit show tells how it goes",
    )
    add_runs_dir(added)


def _run(arguments: argparse.Namespace) -> None:
    from toolkit.recipes.presets import with_preset
    from toolkit.recipes.registry import find_recipe
    from toolkit.runs.launch import create_run, execute

    recipe = find_recipe(arguments.recipe)
    settings = recipe.settings_type()
    if arguments.settings is not None:
        settings = recipe.settings_type.from_json(_text_of(arguments.settings))
    elif arguments.preset is not None:
        settings = with_preset(settings, arguments.preset)
    data = arguments.data
    if arguments.camera is not None:
        data, settings = _with_camera(arguments, settings)
    changed = settings.replace_from_text(arguments.set)
    run = with_bar(
        lambda bar: create_run(
            recipe,
            data,
            changed,
            arguments.runs,
            seed=arguments.seed,
            device=arguments.device,
            name=arguments.name,
            progress=bar,
        )
    )
    print(f"Run {run.id} in {run.path}", file=sys.stderr)
    if arguments.queue:
        from toolkit.runs.queue import enqueue, ensure_worker

        enqueue(run)
        ensure_worker(arguments.runs)
    else:
        _finish(run, execute)


def _with_camera(arguments: argparse.Namespace, settings: Settings) -> tuple[Path, Settings]:
    """Return a folder with the same pictures and the profile's camera, and settings that do not refine it."""
    from toolkit.poses.camera_profile import with_fixed_cameras
    from toolkit.poses.profiled_capture import capture_with_profile

    made = with_bar(
        lambda bar: capture_with_profile(
            arguments.data, arguments.camera, arguments.runs / ".captures", progress=bar
        )
    )
    for warning in made.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"Camera {made.profile.name}, {made.profile.width} x {made.profile.height} px", file=sys.stderr)
    return made.folder, with_fixed_cameras(settings)


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"Cannot read {path}", expected="a JSON file of settings", found=str(error)) from error


def _finish(run: RunFolder, work: Callable[[RunFolder, Progress], object]) -> None:
    """Work on a run with a progress bar, then print its result; where it stops, say how to go on."""
    from toolkit.runs.compare import compare_runs
    from toolkit.runs.process import ProcessMark
    from toolkit.runs.text import result_text

    try:
        with_bar(lambda bar: work(run, bar))
    except (ToolkitError, KeyboardInterrupt):
        status = run.status()
        began = status.process == ProcessMark.current()  # or else it was refused
        if began and status.state in ("failed", "cancelled"):
            print(f"\nThe run can go on where it stopped: toolkit resume {run.path}", file=sys.stderr)
        raise
    print(result_text(compare_runs([run])))


def _add_runs(commands: argparse._SubParsersAction) -> None:
    add_runs_dir(add(commands, "runs", _runs, "List all runs, oldest first.", "runs"))


def _runs(arguments: argparse.Namespace) -> None:
    from toolkit.runs.index import list_runs
    from toolkit.runs.text import runs_text

    summaries = list_runs(arguments.runs)
    print(runs_text(summaries) if summaries else f"No runs in {arguments.runs}")


def _add_show(commands: argparse._SubParsersAction) -> None:
    added = add(commands, "show", _show, "Show one run: state, measures, times, files.", "show latest")
    added.add_argument("run", metavar="RUN", help=RUN_HELP)
    add_runs_dir(added)


def _show(arguments: argparse.Namespace) -> None:
    from toolkit.runs.compare import compare_runs
    from toolkit.runs.index import find_run
    from toolkit.runs.text import run_text

    print(run_text(compare_runs([find_run(arguments.run, arguments.runs)])))


def _add_compare(commands: argparse._SubParsersAction) -> None:
    added = add(
        commands,
        "compare",
        _compare,
        "Lay runs side by side; one run alone makes its report.",
        "compare latest-1 latest --html compare.html --open",
    )
    added.add_argument("run", nargs="+", metavar="RUN", help=RUN_HELP)
    added.add_argument("--html", type=Path, metavar="FILE", help="write a page with curves and pictures")
    added.add_argument("--open", action="store_true", help="open the page in the browser")
    add_runs_dir(added)


def _compare(arguments: argparse.Namespace) -> None:
    from toolkit.runs.compare import compare_runs
    from toolkit.runs.index import find_run
    from toolkit.runs.text import comparison_text

    if arguments.open and arguments.html is None:
        raise SettingsError("--open has nothing to open", expected="--html FILE too")
    comparison = compare_runs([find_run(text, arguments.runs) for text in arguments.run])
    print(comparison_text(comparison))
    if arguments.html is not None:
        from toolkit.runs.report_html import write_report

        with_bar(lambda bar: write_report(comparison, arguments.html, progress=bar))
        print(f"\nPage written to {arguments.html}")
    if arguments.open:
        webbrowser.open(arguments.html.resolve().as_uri())


def _add_resume(commands: argparse._SubParsersAction) -> None:
    added = add(commands, "resume", _resume, "Go on with a run that did not finish.", "resume latest")
    added.add_argument("run", metavar="RUN", help=RUN_HELP)
    add_runs_dir(added)


def _resume(arguments: argparse.Namespace) -> None:
    from toolkit.runs.index import find_run
    from toolkit.runs.launch import resume

    _finish(find_run(arguments.run, arguments.runs), resume)


def _add_export(commands: argparse._SubParsersAction) -> None:
    from toolkit.runs.export import ExportFormat

    added = add(commands, "export", _export, "Copy a run's splat or scene.", "export latest --to town.ply")
    added.add_argument("run", metavar="RUN", help=RUN_HELP)
    added.add_argument("--to", type=Path, required=True, metavar="PATH", help="file or folder")
    added.add_argument(
        "--format",
        choices=get_args(ExportFormat),
        help="splat as PLY or SPZ; poses as TUM or KITTI; transforms.json, COLMAP or scene folder with pictures "
        "[by the ending of PATH: .ply, .spz, .tum, .txt (TUM), transforms.json; otherwise scene]",
    )
    add_runs_dir(added)


def _export(arguments: argparse.Namespace) -> None:
    from toolkit.runs.export import export_run
    from toolkit.runs.index import find_run

    run = find_run(arguments.run, arguments.runs)
    with_bar(lambda bar: export_run(run, arguments.to, arguments.format, progress=bar))
    print(f"Wrote {arguments.to} from run {run.id}")
