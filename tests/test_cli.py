"""The command line, from one end to the other, with a recipe that takes no time."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
import webbrowser
from pathlib import Path

import pytest
from fake_recipe import RECIPE, LoopSettings, write_photos

import toolkit
from toolkit import demo
from toolkit.cli import build_parser, main
from toolkit.errors import Cancelled, SettingsError
from toolkit.progress import ProgressEvent
from toolkit.recipes import registry
from toolkit.recipes.base import Recipe
from toolkit.runs import process
from toolkit.runs.compare import Comparison, compare_runs
from toolkit.runs.index import list_runs
from toolkit.scene.folder import read_scene


@pytest.fixture(autouse=True)
def fake_recipes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "all_recipes", lambda: {"fake": RECIPE})


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of runs, which the environment names."""
    folder = tmp_path / "my runs"
    monkeypatch.setenv("TOOLKIT_RUNS", str(folder))
    return folder


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return write_photos(tmp_path / "photos")


class Said:
    """Runs commands and keeps what they print."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.out = self.err = ""

    def __call__(self, *arguments: object) -> int:
        code = main([str(argument) for argument in arguments])
        self.out, self.err = self._capsys.readouterr()
        return code


@pytest.fixture
def toolkit_command(capsys: pytest.CaptureFixture[str]) -> Said:
    return Said(capsys)


def test_recipes_are_listed_and_explained(toolkit_command: Said) -> None:
    assert toolkit_command("recipes") == 0
    assert "fake    –      A fake recipe" in toolkit_command.out
    assert toolkit_command("recipes", "fake") == 0
    assert "loop.steps = 30\n    How many steps. (whole number 1 to 100000)\n" in toolkit_command.out


def test_an_unknown_recipe_is_told_with_those_there_are(toolkit_command: Said, runs: Path, photos: Path) -> None:
    assert toolkit_command("recipes", "fakes") == 2
    assert toolkit_command.err.startswith(
        "error: Unknown recipe 'fakes'; expected one of fake. Did you mean 'fake'?"
    )
    assert toolkit_command("run", "nothing", "--data", photos) == 2
    assert "Unknown recipe 'nothing'" in toolkit_command.err


def test_a_run_from_start_to_page(toolkit_command: Said, runs: Path, photos: Path, tmp_path: Path) -> None:
    assert toolkit_command("run", "fake", "--data", photos, "--name", "one", "--seed", 3) == 0
    run = list_runs(runs)[0]
    assert (run.state, run.name, run.seed) == ("finished", "one", 3)
    assert f"Run {run.run.id} in {run.run.path}" in toolkit_command.err
    assert "train" in toolkit_command.err  # the bar
    assert re.search(r"test\.psnr ↑ +\d", toolkit_command.out)
    assert str(run.run.result_file) in toolkit_command.out

    settings = tmp_path / "settings.json"
    settings.write_text(json.dumps({"loop": {"rate": 0.2, "steps": 12}}))
    more = ["--settings", settings, "--set", "loop.steps=15", "--set", "test_every=2"]
    assert toolkit_command("run", "fake", "--data", photos, "--name", "two", *more) == 0
    assert list_runs(runs)[1].run.record().settings["loop"] == {"steps": 15, "rate": 0.2}  # --set comes last

    assert toolkit_command("runs") == 0
    assert [line.split()[1] for line in toolkit_command.out.splitlines()[1:]] == ["one", "two"]
    assert toolkit_command("show", "latest-1") == 0
    assert "one" in toolkit_command.out or run.run.id in toolkit_command.out
    assert toolkit_command("compare", "one", "latest", "--html", tmp_path / "page.html") == 0
    assert "Settings that differ" in toolkit_command.out
    assert f"Page written to {tmp_path / 'page.html'}" in toolkit_command.out
    assert "<!DOCTYPE html>" in (tmp_path / "page.html").read_text()
    assert toolkit_command("export", "two", "--to", tmp_path / "scene") == 0
    assert (tmp_path / "scene" / "scene.json").is_file()
    assert toolkit_command("export", "two", "--to", tmp_path / "c", "--format", "colmap") == 0
    assert (tmp_path / "c" / "sparse" / "0").is_dir()


def test_the_page_opens_in_the_browser(
    toolkit_command: Said, runs: Path, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    toolkit_command("run", "fake", "--data", photos)
    assert toolkit_command("compare", "latest", "--html", tmp_path / "a page.html", "--open") == 0
    assert opened == [(tmp_path / "a page.html").as_uri()]
    assert toolkit_command("compare", "latest", "--open") == 2
    assert "--open has nothing to open; expected --html FILE too" in toolkit_command.err


def test_a_failed_run_tells_why_and_how_to_go_on(toolkit_command: Said, runs: Path, photos: Path) -> None:
    assert toolkit_command("run", "fake", "--data", photos, "--set", "fail_at=12") == 2
    path = list_runs(runs)[0].run.path
    assert f"The run can go on where it stopped: toolkit resume {path}" in toolkit_command.err
    assert toolkit_command.err.splitlines()[-1] == "error: The fake recipe fails here; found step 12."
    assert "Traceback" not in toolkit_command.err
    assert toolkit_command("runs") == 0
    assert "The fake recipe fails here" in toolkit_command.out
    assert toolkit_command("resume", path) == 2
    assert toolkit_command("show", "latest") == 0
    assert "failed" in toolkit_command.out
    assert toolkit_command("export", "latest", "--to", path / "x.ply") == 2
    assert "has no splat" in toolkit_command.err


def test_ctrl_c_ends_with_130_and_resume_finishes(
    toolkit_command: Said, runs: Path, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(self: object, event: ProgressEvent) -> None:
        if event.stage == "train" and event.done == 14:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("toolkit.progress.TqdmProgress.__call__", interrupt)
        assert toolkit_command("run", "fake", "--data", photos) == 130
    assert toolkit_command.err.splitlines()[-1] == "stopped: Ctrl-C"
    assert "toolkit resume" in toolkit_command.err
    assert list_runs(runs)[0].state == "cancelled"
    assert toolkit_command("resume", "latest") == 0
    assert list_runs(runs)[0].state == "finished"
    assert toolkit_command("resume", "latest") == 2
    assert toolkit_command.err.startswith("error: ")  # no word that it could go on
    assert "found one that is finished" in toolkit_command.err


def test_a_cancelled_command_ends_with_130_too(
    toolkit_command: Said, runs: Path, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cancel(self: object, event: ProgressEvent) -> None:
        if event.stage == "train":
            raise Cancelled("Cancelled by a listener")

    monkeypatch.setattr("toolkit.progress.TqdmProgress.__call__", cancel)
    assert toolkit_command("run", "fake", "--data", photos) == 130
    assert toolkit_command.err.splitlines()[-1] == "stopped: Cancelled by a listener."


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_real_ctrl_c_in_a_real_process(runs: Path, photos: Path) -> None:
    code = (
        "import sys; from fake_recipe import RECIPE; from toolkit.recipes import registry\n"
        "registry.all_recipes = lambda: {'fake': RECIPE}\n"
        "from toolkit.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", code, "run", "fake", "--data", str(photos), "--set", "pause=0.05"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, env=environment) as child:
        deadline = time.monotonic() + 60  # generous: a busy machine takes seconds to import everything
        while time.monotonic() < deadline:
            rows = list_runs(runs)
            if rows and rows[0].state == "running" and rows[0].stage == "train":
                break
            time.sleep(0.02)
        child.send_signal(signal.SIGINT)
        said = child.communicate()[1].decode()
    assert child.returncode == 130, said
    assert "stopped: Ctrl-C" in said
    assert "Traceback" not in said
    assert list_runs(runs)[0].state == "cancelled"


def test_a_refused_resume_does_not_promise_that_it_can_go_on(
    toolkit_command: Said, runs: Path, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toolkit_command("run", "fake", "--data", photos, "--set", "fail_at=3")
    other = dataclasses.replace(RECIPE, settings_type=LoopSettings)
    monkeypatch.setattr(registry, "all_recipes", lambda: {"fake": other})
    monkeypatch.setattr(process, "_started", lambda pid: "another start")  # as in a later process
    assert toolkit_command("resume", "latest") == 2
    assert toolkit_command.err.startswith("error: The settings of run")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--set", "loop.step=3"], "Unknown setting 'step' of LoopSettings"),
        (["--set", "loop.steps"], "Cannot read 'loop.steps'; expected key=value"),
        (["--set", "loop.steps=0"], "whole number 1 to 100000; found 0"),
        (["--seed", "-1"], "Seed is out of range"),
        (["--name", "../x"], "Run name '../x' cannot be used"),
        (["--settings", "nowhere.json"], "Cannot read nowhere.json; expected a JSON file of settings"),
    ],
)
def test_bad_arguments_are_told_and_start_nothing(
    toolkit_command: Said, runs: Path, photos: Path, arguments: list[str], told: str
) -> None:
    assert toolkit_command("run", "fake", "--data", photos, *arguments) == 2
    assert told in toolkit_command.err
    assert toolkit_command.err.startswith("error: ")
    assert list_runs(runs) == []


def test_debug_shows_the_traceback(runs: Path, photos: Path) -> None:
    with pytest.raises(SettingsError, match="Unknown setting"):
        main(["run", "fake", "--data", str(photos), "--set", "wrong=1", "--debug"])


@pytest.mark.parametrize("command", ["show", "resume", "compare"])
def test_a_run_that_is_not_there_is_told(toolkit_command: Said, runs: Path, command: str) -> None:
    assert toolkit_command(command, "nothing") == 2
    assert "error: No run 'nothing' in" in toolkit_command.err
    assert toolkit_command(command, "../../etc") == 2
    assert "is no run; expected a folder with run.json" in toolkit_command.err


def test_a_sample_is_made_with_the_flags_of_its_settings(toolkit_command: Said, tmp_path: Path) -> None:
    size = ["--flight.frames", 2, "--flight.image-width", 32, "--flight.image-height", 24, "--points", 50]
    assert toolkit_command("sample", "town", "--to", tmp_path / "town", "--seed", 3, *size) == 0
    assert toolkit_command.out == f"Sample written to {tmp_path / 'town'}\n"
    scene = read_scene(tmp_path / "town")
    assert [scene.camera_of(frame).width for frame in scene.frames] == [32, 32]
    assert toolkit_command("sample", "town", "--to", tmp_path / "town", *size) == 2
    assert "town is in the way" in toolkit_command.err
    assert toolkit_command("sample", "town", "--to", tmp_path / "other", "--flight.frames", 1) == 2
    assert "whole number 2 to 5000" in toolkit_command.err


def test_the_demonstration_ends_with_a_comparison_and_a_page(
    toolkit_command: Said, runs: Path, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toolkit_command("run", "fake", "--data", photos)
    made: list[Path] = []

    def quick(folder: Path, progress: object) -> tuple[Comparison, Path]:
        made.append(folder)
        return compare_runs([list_runs(runs)[0].run]), folder / "compare.html"

    monkeypatch.setattr(demo, "run_demo", quick)
    assert toolkit_command("demo", "--folder", tmp_path / "d") == 0
    assert made == [tmp_path / "d"]
    assert "test.psnr" in toolkit_command.out
    assert (tmp_path / "d" / "compare.html").as_uri() in toolkit_command.out
    assert f"toolkit dashboard --runs {tmp_path / 'd' / 'runs'}" in toolkit_command.out.splitlines()[-1]


def test_data_sets_are_listed_and_found_where_they_are(
    toolkit_command: Said, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "uav_brighton_beach").mkdir()
    monkeypatch.setenv("TOOLKIT_DATA", str(tmp_path))
    assert toolkit_command("data", "--cache", tmp_path / "cache") == 0
    rows = {line.split()[0]: line for line in toolkit_command.out.splitlines()}
    assert " here " in rows["uav_brighton_beach"]
    assert " by hand " in rows["jb3d"]
    assert toolkit_command("data", "uav_brighton_beach") == 0
    assert toolkit_command.out.strip() == str(tmp_path / "uav_brighton_beach")
    assert toolkit_command("data", "uav_brighton") == 2
    assert "Did you mean uav_brighton_beach?" in toolkit_command.err


def test_the_dashboard_serves_the_folder_of_runs(
    toolkit_command: Said, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from toolkit.widgets import serve

    asked: list[tuple[object, ...]] = []
    monkeypatch.setattr(serve, "serve", lambda *given, **named: asked.append((*given, named)))
    monkeypatch.delenv("TOOLKIT_DATA", raising=False)
    rest = {"clusters": [], "open_browser": False}
    assert toolkit_command("dashboard", "--port", 5011) == 0
    assert asked.pop() == (runs, [runs.parent / "data"], serve.Opening(5011), rest)
    monkeypatch.setenv("TOOLKIT_DATA", "sets")
    assert toolkit_command("dashboard") == 0
    assert asked.pop()[1] == [runs.parent / "data", Path("sets")]
    assert toolkit_command("dashboard", "--data", "mine", "--host", "0.0.0.0", "--passwords", "who.json") == 0
    assert asked.pop() == (runs, [Path("mine")], serve.Opening(5006, "0.0.0.0", Path("who.json")), rest)


def test_an_empty_folder_of_runs_is_said(toolkit_command: Said, runs: Path, tmp_path: Path) -> None:
    assert toolkit_command("runs") == 0
    assert toolkit_command.out == f"No runs in {runs}\n"
    assert toolkit_command("runs", "--runs", tmp_path / "other") == 0
    assert toolkit_command.out == f"No runs in {tmp_path / 'other'}\n"


def test_without_the_environment_runs_lie_in_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TOOLKIT_RUNS", raising=False)
    assert build_parser().parse_args(["runs"]).runs == Path("runs")


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["--version"])
    assert done.value.code == 0
    assert capsys.readouterr().out == f"toolkit {toolkit.__version__}\n"


@pytest.mark.parametrize(
    "command",
    [
        "recipes",
        "run",
        "runs",
        "show",
        "compare",
        "resume",
        "export",
        "sample",
        "demo",
        "data",
        "dashboard",
        "render",
    ],
)
def test_every_help_has_an_example(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main([command, "--help"])
    assert done.value.code == 0
    assert f"Example: toolkit {command}" in capsys.readouterr().out


def test_wrong_usage_ends_with_2(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in ([], ["dance"], ["run"], ["run", "fake"], ["export", "latest"], ["sample", "moon", "--to", "x"]):
        with pytest.raises(SystemExit) as done:
            main(wrong)
        assert done.value.code == 2
        assert "usage: toolkit" in capsys.readouterr().err


def test_listing_runs_imports_nothing_heavy(runs: Path) -> None:
    code = (
        "import sys; from toolkit.cli import main; main(['runs'])\n"
        "print(sorted({'torch', 'numba', 'pycolmap', 'plotly'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_reader_that_goes_away_is_no_error(runs: Path) -> None:
    command = [sys.executable, "-m", "toolkit", "runs"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.close()
        said = child.stderr.read().decode()
    assert said == ""
    assert child.returncode == 0


def test_registered_recipes_have_a_name_for_ids_and_a_table_of_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    recipes = registry.all_recipes()
    assert recipes
    for name, recipe in recipes.items():
        assert isinstance(recipe, Recipe)
        assert recipe.name == name
        assert re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name)
        assert recipe.settings_type.table()
