"""Commands on sweeps: sweep, sweep-resume, sweep-cancel, sweeps, sweep-show; and mirror."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from toolkit.cli.common import add, add_runs_dir, with_bar
from toolkit.errors import SettingsError

if TYPE_CHECKING:
    from toolkit.runs.sweep_record import SweepFolder
    from toolkit.runs.sweep_space import Dimension, Method
    from toolkit.settings import Settings

_SWEEP_HELP = "id, unique beginning of an id, name, or latest"


def add_commands(commands: argparse._SubParsersAction) -> None:
    """Add all of them."""
    _add_sweep(commands)
    added = add(commands, "sweep-resume", _resume, "Go on with a sweep that did not finish.", "sweep-resume latest")
    added.add_argument("sweep", metavar="SWEEP", help=_SWEEP_HELP)
    added.add_argument("--cluster", metavar="ADDRESS", help="another Dask scheduler than before")
    add_runs_dir(added)
    added = add(commands, "sweep-cancel", _cancel, "Stop a sweep and its runs.", "sweep-cancel latest")
    added.add_argument("sweep", metavar="SWEEP", help=_SWEEP_HELP)
    add_runs_dir(added)
    add_runs_dir(add(commands, "sweeps", _sweeps, "List all sweeps, oldest first.", "sweeps"))
    added = add(
        commands, "sweep-show", _show, "Show a sweep: trials, the best run, what mattered.", "sweep-show latest"
    )
    added.add_argument("sweep", metavar="SWEEP", help=_SWEEP_HELP)
    add_runs_dir(added)
    added = add(
        commands,
        "mirror",
        _mirror,
        "Copy what finished runs measured into an MLflow store.",
        "mirror --to sqlite:///runs/mlflow.db",
    )
    added.add_argument("--to", required=True, metavar="URI", help="as sqlite:///runs/mlflow.db")
    added.add_argument("--experiment", default="sightline-toolkit", metavar="NAME", help="[sightline-toolkit]")
    add_runs_dir(added)


def _add_sweep(commands: argparse._SubParsersAction) -> None:
    added = add(
        commands,
        "sweep",
        _sweep,
        "Run a method again and again with other settings.",
        "sweep colmap-3dgs --data photos/ --tpe train.lr_means=1e-5:1e-3:log --trials 20",
    )
    added.add_argument("recipe", metavar="RECIPE", help="name of the method (toolkit recipes lists them)")
    added.add_argument("--data", type=Path, required=True, metavar="FOLDER", help="the capture")
    chosen = added.add_argument_group("what is tried, each may come several times; one kind a sweep")
    space = "SETTING=VALUES"
    chosen.add_argument(
        "--grid", action="append", default=[], metavar=space, help="all of a,b,c or of LOW:HIGH:COUNT[:log]"
    )
    chosen.add_argument(
        "--random", action="append", default=[], metavar=space, help="any of a,b,c or from LOW:HIGH[:log]"
    )
    chosen.add_argument(
        "--tpe",
        action="append",
        default=[],
        metavar=space,
        help="as --random, proposed by Optuna from what was good",
    )
    added.add_argument("--trials", type=int, metavar="N", help="how many; a grid has as many as it has points")
    added.add_argument("--objective", default="test.psnr", metavar="MEASURE", help="what is to be good [test.psnr]")
    way = added.add_mutually_exclusive_group()
    for direction in ("maximise", "minimise"):
        way.add_argument(
            f"--{direction}", dest="direction", action="store_const", const=direction, help="[as the name says]"
        )
    added.add_argument(
        "--prune",
        nargs="?",
        const="splat.train/psnr_test",
        default="",
        metavar="CURVE",
        help="with --tpe, stop runs early that are worse than most by this curve [splat.train/psnr_test]",
    )
    added.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of all runs")
    added.add_argument("--preset", metavar="NAME", help="draft, standard or paper; --set comes after")
    added.add_argument("--seed", type=int, default=0, help="of every run, and of the choice of values [0]")
    added.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute [cpu]")
    added.add_argument("--name", default="", metavar="TEXT", help="what to call the sweep")
    added.add_argument(
        "--workers", type=int, default=0, metavar="N", help="runs at a time [2, or all of a cluster]"
    )
    added.add_argument(
        "--threads", type=int, default=0, metavar="N", help="of each worker [its share of the cores; a cluster: 1]"
    )
    added.add_argument(
        "--cluster",
        default="",
        metavar="ADDRESS",
        help="Dask scheduler, as tcp://host:8786, on a network that is yours",
    )
    added.add_argument(
        "--hands", type=int, default=3, metavar="N", help="times a run is handed out where its workers die [3]"
    )
    added.add_argument("--later", action="store_true", help="let a process of its own work on it and come back")
    add_runs_dir(added)


def _sweep(arguments: argparse.Namespace) -> None:
    from toolkit.recipes.presets import with_preset
    from toolkit.recipes.registry import find_recipe
    from toolkit.runs import sweep as sweeps

    recipe = find_recipe(arguments.recipe)
    base = recipe.settings_type()
    if arguments.preset is not None:
        base = with_preset(base, arguments.preset)
    base = base.replace_from_text(arguments.set)
    method, space = _space(arguments, base)
    sweep = sweeps.create_sweep(
        recipe,
        arguments.data,
        base,
        arguments.runs,
        method=method,
        space=space,
        trials=arguments.trials,
        goal=sweeps.SweepGoal(arguments.objective, arguments.direction, arguments.prune),
        places=sweeps.SweepPlaces(
            arguments.workers, arguments.threads, arguments.cluster, arguments.hands, arguments.device
        ),
        seed=arguments.seed,
        name=arguments.name,
    )
    print(f"Sweep {sweep.id} in {sweep.path}", file=sys.stderr)
    if arguments.later:
        sweeps.start_sweep(sweep)
    else:
        _work(sweep)


def _space(arguments: argparse.Namespace, base: Settings) -> tuple[Method, list[Dimension]]:
    """Return how values are chosen, and of which settings."""
    from toolkit.runs.sweep_space import Method, parse_dimension

    given = {method: getattr(arguments, method) for method in get_args(Method) if getattr(arguments, method)}
    if len(given) != 1:
        raise SettingsError(
            "It is not clear what to try",
            expected="one of --grid, --random and --tpe, as often as there are settings to change",
            found=" and ".join(f"--{method}" for method in given) or "none of them",
        )
    ((method, texts),) = given.items()
    return method, [parse_dimension(text, method, base) for text in texts]


def _work(sweep: SweepFolder, cluster: str | None = None) -> None:
    from toolkit.runs.sweep_figures import sweep_text
    from toolkit.runs.sweep_run import work_on_sweep

    try:
        rows = with_bar(lambda bar: work_on_sweep(sweep, bar, cluster=cluster))
    except BaseException:
        if sweep.status().state in ("cancelled", "failed"):
            print(f"\nThe sweep can go on where it stopped: toolkit sweep-resume {sweep.id}", file=sys.stderr)
        raise
    print(sweep_text(sweep, sweep.plan(), rows))


def _resume(arguments: argparse.Namespace) -> None:
    from toolkit.runs.sweep_record import find_sweep

    _work(find_sweep(arguments.sweep, arguments.runs), arguments.cluster)


def _cancel(arguments: argparse.Namespace) -> None:
    from toolkit.runs.sweep_record import find_sweep

    sweep = find_sweep(arguments.sweep, arguments.runs)
    sweep.request_cancel()
    print(f"Sweep {sweep.id} stops; toolkit sweep-resume {sweep.id} goes on with it")


def _sweeps(arguments: argparse.Namespace) -> None:
    from toolkit.runs.sweep_figures import sweeps_text
    from toolkit.runs.sweep_record import list_sweeps

    sweeps = list_sweeps(arguments.runs)
    print(sweeps_text(sweeps) if sweeps else f"No sweeps in {arguments.runs}")


def _show(arguments: argparse.Namespace) -> None:
    from toolkit.runs.sweep_figures import sweep_text
    from toolkit.runs.sweep_record import find_sweep
    from toolkit.runs.sweep_table import TrialReader

    sweep = find_sweep(arguments.sweep, arguments.runs)
    reader = TrialReader(sweep)
    print(sweep_text(sweep, reader.plan, reader.read()))


def _mirror(arguments: argparse.Namespace) -> None:
    from toolkit.runs.mlflow_mirror import mirror_runs

    report = with_bar(
        lambda bar: mirror_runs(arguments.runs, arguments.to, experiment=arguments.experiment, progress=bar)
    )
    print(
        f"Mirrored {report.mirrored} runs to experiment '{arguments.experiment}' in {arguments.to}; "
        f"{report.known} were there already, {report.unfinished} are not finished"
    )
    for problem in report.problems:
        print(f"warning: {problem}", file=sys.stderr)
