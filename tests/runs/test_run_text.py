"""What the terminal shows: aligned, complete, and harmless."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fake_recipe import RECIPE, MakeRun

from toolkit.errors import StageError
from toolkit.recipes.registry import find_recipe
from toolkit.runs.compare import compare_runs
from toolkit.runs.index import list_runs
from toolkit.runs.launch import execute
from toolkit.runs.text import comparison_text, printable, recipe_text, recipes_text, run_text, runs_text, table


def test_columns_are_aligned_for_wide_and_combining_letters_too() -> None:
    text = table([("name", "x"), ("日本", "1"), ("e\u0301", "2"), ("longer", "3")])
    assert text.split("\n") == ["name    x", "日本    1", "e\u0301       2", "longer  3"]
    assert table([("a", "bb"), ("cc", "d")], right=True).split("\n") == ["a   bb", "cc   d"]


def test_control_characters_never_reach_the_terminal() -> None:
    assert printable("a\x1b[31mb\x07\nc\u202e") == "a�[31mb��c�"


def test_the_list_of_runs_has_a_line_a_run_and_errors_below(
    finished: MakeRun, queued: MakeRun, runs_dir: Path
) -> None:
    finished(name="good")
    bad = queued(name="bad", fail_at=3)
    with pytest.raises(StageError):
        execute(bad, recipe=RECIPE)
    lines = runs_text(list_runs(runs_dir)).split("\n")
    assert lines[0].split() == ["id", "name", "state", "stage", "time", "PSNR"]
    assert "good" in lines[1]
    assert "finished" in lines[1]
    assert "train 2/30" in lines[2]
    assert lines[3] == "    The fake recipe fails here; found step 3."


def test_a_name_with_escape_sequences_from_a_foreign_folder_is_harmless(finished: MakeRun, runs_dir: Path) -> None:
    run = finished()
    record = json.loads(run.record_file.read_text())
    run.record_file.write_text(json.dumps({**record, "name": "evil\x1b]0;title\x07"}))
    assert "\x1b" not in runs_text(list_runs(runs_dir))
    assert "\x1b" not in comparison_text(compare_runs([run]))


def test_a_comparison_marks_the_best_and_the_reused(finished: MakeRun) -> None:
    runs = [finished(name="slow", loop__rate=0.8), finished(name="fast", loop__rate=0.2)]
    text = comparison_text(compare_runs(runs))
    ate = next(line for line in text.split("\n") if line.startswith("poses.sim3.ate"))
    assert ate.split() == ["poses.sim3.ate", "↓", "0.8000", "0.2000", "*"]
    prepare = next(line for line in text.split("\n") if line.startswith("prepare"))
    assert prepare.split() == ["prepare", "0.0", "s", "0.0", "s", "r"]
    assert "Settings that differ\nsetting    slow  fast\nloop.rate  0.8   0.2" in text
    assert "The same in all" in text


def test_one_run_alone_is_not_compared(finished: MakeRun) -> None:
    text = comparison_text(compare_runs([finished(name="alone")]))
    assert "best" not in text
    assert "Settings that differ" not in text
    assert "The same in all" not in text


def test_equal_settings_are_said_to_be_equal(finished: MakeRun) -> None:
    assert "Settings that differ\nnone that all have" in comparison_text(
        compare_runs([finished(name="a"), finished(name="b", seed=1)])
    )


def test_warnings_end_the_text(finished: MakeRun) -> None:
    text = comparison_text(compare_runs([finished(name="one"), finished(name="two", test_every=3)]))
    assert text.split("\n")[-1].startswith("Warning: The runs were measured on different test pictures")


def test_showing_a_run_tells_all_about_it(finished: MakeRun) -> None:
    run = finished(name="mine", loop__steps=12)
    text = run_text(compare_runs([run]))
    for part in (
        run.id,
        "finished",
        "test.psnr",
        "train",
        "loop.steps",
        "12",
        str(run.result_file),
        "End of the log",
    ):
        assert part in text
    assert "splat" not in text  # it made none


def test_recipes_are_listed_and_explained() -> None:
    assert recipes_text([RECIPE]).split("\n")[1].split() == ["fake", "–", "A", "fake", "recipe"]
    text = recipe_text(RECIPE)
    assert "fake: A fake recipe" in text
    assert "\n\nloop.rate = 0.5 1/step\n    How fast the loss falls. (number 0 to 10)\n" in text


def test_what_a_recipe_says_fits_into_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = find_recipe("sensor-3dgs")
    for columns, widest in (("60", 60), ("10", 50), ("300", 100)):
        monkeypatch.setenv("COLUMNS", columns)
        said = recipe_text(recipe).split("\n")
        # The heading is one line, and a name of a setting is not broken.
        assert all(len(line) <= widest for line in said[2:] if " " in line.strip() and " = " not in line)
