"""The command line: reads arguments, calls the toolkit, prints."""

from __future__ import annotations

import argparse
import os
import sys
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, get_args

import toolkit
from toolkit.errors import Cancelled, SettingsError, ToolkitError
from toolkit.progress import Progress, TqdmProgress

if TYPE_CHECKING:
    from toolkit.runs.folder import RunFolder

T = TypeVar("T")

_RUN_HELP = "id, unique beginning of an id, name, path, latest or latest-<n> (n runs before)"
_Command = Callable[[argparse.Namespace], None]


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return the exit code: 0, 2 for an error that is told, 130 when stopped."""
    given = list(sys.argv[1:] if argv is None else argv)
    arguments = build_parser(with_sample_flags="sample" in given).parse_args(given)
    command: _Command = arguments.command
    try:
        command(arguments)
        sys.stdout.flush()
    except (Cancelled, KeyboardInterrupt) as stop:
        print(f"stopped: {str(stop) or 'Ctrl-C'}", file=sys.stderr)
        return 130
    except ToolkitError as error:
        if arguments.debug:
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        # The reader of our output went away (as in `toolkit runs | head`); nothing more can be said to it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return 0


def build_parser(*, with_sample_flags: bool = True) -> argparse.ArgumentParser:
    """Return the parser of all commands.

    The flags of ``sample`` come from its settings, which take a moment to import: only that command needs them.
    """
    parser = argparse.ArgumentParser(
        prog="toolkit",
        description="3D reconstruction from drone video, satellite images and inspection footage.",
        epilog="Example: toolkit run colmap-3dgs --data photos/ --set train.steps=500",
    )
    parser.add_argument("--version", action="version", version=f"toolkit {toolkit.__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (_add_demo, _add_recipes, _add_run, _add_runs, _add_show, _add_compare, _add_resume, _add_export):
        add(commands)
    _add_sample(commands, with_sample_flags)
    return parser


def _add(
    commands: argparse._SubParsersAction, name: str, command: _Command, help: str, example: str
) -> argparse.ArgumentParser:
    added: argparse.ArgumentParser = commands.add_parser(
        name, help=help, description=help, epilog=f"Example: toolkit {example}"
    )
    added.set_defaults(command=command)
    added.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return added


def _add_runs_dir(parser: argparse.ArgumentParser) -> None:
    default = Path(os.environ.get("TOOLKIT_RUNS") or "runs")
    parser.add_argument(
        "--runs", type=Path, default=default, metavar="DIR", help="folder of runs [runs, or $TOOLKIT_RUNS]"
    )


def _add_demo(commands: argparse._SubParsersAction) -> None:
    added = _add(commands, "demo", _demo, "Make a sample flight, run a method in two ways, compare.", "demo")
    added.add_argument("--folder", type=Path, default=Path("demo"), metavar="DIR", help="where to write [demo]")


def _demo(arguments: argparse.Namespace) -> None:
    from toolkit.demo import run_demo
    from toolkit.runs.text import comparison_text

    comparison, page = _with_bar(lambda bar: run_demo(arguments.folder, bar))
    print(comparison_text(comparison))
    print(f"\nThe same with curves, camera paths and pictures: {page.resolve().as_uri()}")


def _add_recipes(commands: argparse._SubParsersAction) -> None:
    added = _add(commands, "recipes", _recipes, "List methods, or the settings of one.", "recipes colmap-3dgs")
    added.add_argument("name", nargs="?", metavar="NAME", help="show this one's settings")


def _recipes(arguments: argparse.Namespace) -> None:
    from toolkit.recipes.registry import all_recipes, find_recipe
    from toolkit.runs.text import recipe_text, recipes_text

    print(recipe_text(find_recipe(arguments.name)) if arguments.name else recipes_text(all_recipes().values()))


def _add_run(commands: argparse._SubParsersAction) -> None:
    added = _add(
        commands,
        "run",
        _run,
        "Run a method on a folder of pictures.",
        "run colmap-3dgs --data photos/ --set train.steps=500 --name quick",
    )
    added.add_argument("recipe", metavar="RECIPE", help="name of the method (toolkit recipes lists them)")
    added.add_argument("--data", type=Path, required=True, metavar="FOLDER", help="the capture")
    added.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting")
    added.add_argument("--settings", type=Path, metavar="FILE", help="settings as JSON; --set comes after")
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    added.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute [cpu]")
    added.add_argument("--name", default="", metavar="TEXT", help="what to call the run")
    _add_runs_dir(added)


def _run(arguments: argparse.Namespace) -> None:
    from toolkit.recipes.registry import find_recipe
    from toolkit.runs.launch import create_run, execute

    recipe = find_recipe(arguments.recipe)
    settings = recipe.settings_type()
    if arguments.settings is not None:
        settings = recipe.settings_type.from_json(_text_of(arguments.settings))
    changed = settings.replace_from_text(arguments.set)
    run = _with_bar(
        lambda bar: create_run(
            recipe,
            arguments.data,
            changed,
            arguments.runs,
            seed=arguments.seed,
            device=arguments.device,
            name=arguments.name,
            progress=bar,
        )
    )
    print(f"Run {run.id} in {run.path}", file=sys.stderr)
    _finish(run, execute)


def _text_of(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"Cannot read {path}", expected="a JSON file of settings", found=str(error)) from error


def _with_bar(work: Callable[[TqdmProgress], T]) -> T:
    bar = TqdmProgress()
    try:
        return work(bar)
    finally:
        bar.close()


def _finish(run: RunFolder, work: Callable[[RunFolder, Progress], object]) -> None:
    """Work on a run with a progress bar, then print its result; where it stops, say how to go on."""
    from toolkit.runs.compare import compare_runs
    from toolkit.runs.process import ProcessMark
    from toolkit.runs.text import result_text

    try:
        _with_bar(lambda bar: work(run, bar))
    except (ToolkitError, KeyboardInterrupt):
        status = run.status()
        began = status.process == ProcessMark.current()  # or else it was refused
        if began and status.state in ("failed", "cancelled"):
            print(f"\nThe run can go on where it stopped: toolkit resume {run.path}", file=sys.stderr)
        raise
    print(result_text(compare_runs([run])))


def _add_runs(commands: argparse._SubParsersAction) -> None:
    _add_runs_dir(_add(commands, "runs", _runs, "List all runs, oldest first.", "runs"))


def _runs(arguments: argparse.Namespace) -> None:
    from toolkit.runs.index import list_runs
    from toolkit.runs.text import runs_text

    summaries = list_runs(arguments.runs)
    print(runs_text(summaries) if summaries else f"No runs in {arguments.runs}")


def _add_show(commands: argparse._SubParsersAction) -> None:
    added = _add(commands, "show", _show, "Show one run: state, measures, times, files.", "show latest")
    added.add_argument("run", metavar="RUN", help=_RUN_HELP)
    _add_runs_dir(added)


def _show(arguments: argparse.Namespace) -> None:
    from toolkit.runs.compare import compare_runs
    from toolkit.runs.index import find_run
    from toolkit.runs.text import run_text

    print(run_text(compare_runs([find_run(arguments.run, arguments.runs)])))


def _add_compare(commands: argparse._SubParsersAction) -> None:
    added = _add(
        commands,
        "compare",
        _compare,
        "Lay runs side by side; one run alone makes its report.",
        "compare latest-1 latest --html compare.html --open",
    )
    added.add_argument("run", nargs="+", metavar="RUN", help=_RUN_HELP)
    added.add_argument("--html", type=Path, metavar="FILE", help="write a page with curves and pictures")
    added.add_argument("--open", action="store_true", help="open the page in the browser")
    _add_runs_dir(added)


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

        _with_bar(lambda bar: write_report(comparison, arguments.html, progress=bar))
        print(f"\nPage written to {arguments.html}")
    if arguments.open:
        webbrowser.open(arguments.html.resolve().as_uri())


def _add_resume(commands: argparse._SubParsersAction) -> None:
    added = _add(commands, "resume", _resume, "Go on with a run that did not finish.", "resume latest")
    added.add_argument("run", metavar="RUN", help=_RUN_HELP)
    _add_runs_dir(added)


def _resume(arguments: argparse.Namespace) -> None:
    from toolkit.runs.index import find_run
    from toolkit.runs.launch import resume

    _finish(find_run(arguments.run, arguments.runs), resume)


def _add_export(commands: argparse._SubParsersAction) -> None:
    from toolkit.runs.export import ExportFormat

    added = _add(commands, "export", _export, "Copy a run's splat or scene.", "export latest --to town.ply")
    added.add_argument("run", metavar="RUN", help=_RUN_HELP)
    added.add_argument("--to", type=Path, required=True, metavar="PATH", help="file.ply, or a folder")
    added.add_argument(
        "--format",
        choices=get_args(ExportFormat),
        help="splat as PLY, COLMAP folder, or scene folder [ply for a name in .ply, otherwise scene]",
    )
    _add_runs_dir(added)


def _export(arguments: argparse.Namespace) -> None:
    from toolkit.runs.export import export_run
    from toolkit.runs.index import find_run

    run = find_run(arguments.run, arguments.runs)
    _with_bar(lambda bar: export_run(run, arguments.to, arguments.format, progress=bar))
    print(f"Wrote {arguments.to} from run {run.id}")


def _add_sample(commands: argparse._SubParsersAction, with_flags: bool) -> None:
    added = _add(
        commands,
        "sample",
        _sample,
        "Make pictures of a scene whose truth is known.",
        "sample town --to town/ --flight.frames 32",
    )
    added.add_argument("kind", choices=("town",), help="which scene")
    added.add_argument("--to", type=Path, required=True, metavar="FOLDER", help="new folder to write")
    added.add_argument("--seed", type=int, default=0, help="of every random choice [0]")
    if with_flags:
        from toolkit.samples.make import SampleSettings

        SampleSettings.add_flags(added)


def _sample(arguments: argparse.Namespace) -> None:
    from toolkit.samples.make import SampleSettings, make_sample

    settings = SampleSettings.from_flags(arguments)
    _with_bar(lambda bar: make_sample(arguments.to, settings, seed=arguments.seed, progress=bar))
    print(f"Sample written to {arguments.to}")
