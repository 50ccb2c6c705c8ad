"""The code in README and documentation runs, and its commands are commands."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from doc_blocks import NOT_RUN, Block, blocks, page_id, pages

from toolkit.cli import build_parser

BLOCKS = {page: list(blocks(page)) for page in pages()}
WITH_PYTHON = [page for page, found in BLOCKS.items() if any(block.language == "python" for block in found)]
WITH_COMMANDS = [page for page, found in BLOCKS.items() if any(block.language == "sh" for block in found)]
LANGUAGES = {"python", "py", "sh", "toml", "text", "json"}
MOST_LINES = 60
#: What the code of a page prints.
SAID = {
    "docs/concepts/runs.md": "Did you mean 'steps'",
    "docs/concepts/scene.md": "12 frames; the first is .* of the split test",
    # Twelve photos 14 degrees apart: most pairs of next ones are verified.
    "docs/extend/matcher.md": r"^\d+ of 21 pairs verified, \d{3,} inliers",
    "docs/extend/recipe.md": r"^0\.\d+$",
    "docs/extend/camera_model.md": r"^\{1: \(\d",
}
SITE = "site"


def run(command: list[str], folder: Path) -> str:
    """Return what a command says in a folder in which installed packages may be; fail where it fails."""
    paths = [str(folder), str(folder / SITE)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*paths, *filter(None, [os.environ.get("PYTHONPATH")])]),
        "PYTHONWARNINGS": "error",
    }
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def install(folder: Path) -> None:
    """Install the package in a folder as its page says, without the network and beside the environment."""
    pytest.importorskip("setuptools", reason="setuptools builds the package of the example")
    pip = [sys.executable, "-W", "ignore", "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    target = ["--no-build-isolation", "--disable-pip-version-check", "--target", str(folder / SITE), str(folder)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONWARNINGS"}
    done = subprocess.run([*pip, *target], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


def write_files(page: Path, folder: Path) -> bool:
    """Write the files that a page shows; return whether they make a package."""
    for block in (block for block in BLOCKS[page] if block.title):
        (folder / block.title).write_text(block.text, encoding="utf-8")
    return (folder / "pyproject.toml").is_file()


def commands(block: Block) -> list[tuple[int, list[str]]]:
    """Return the words of each ``toolkit`` command of a block with its line, comments left out."""
    found = []
    lines = block.text.replace("\\\n", "  ").split("\n")
    for number, line in enumerate(lines, start=block.line + 1):
        for part in line.partition(" #")[0].split("&&"):
            words = shlex.split(part)
            if words and Path(words[0]).name == "toolkit":
                found.append((number, words[1:]))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PYTHON, ids=page_id)
def test_the_python_of_a_page_runs_in_order(page: Path, folder: Path) -> None:
    if write_files(page, folder):
        install(folder)
    code = "\n".join(block.text for block in BLOCKS[page] if block.language == "python" and not block.title)
    (folder / "page.py").write_text(code, encoding="utf-8")
    said = run([sys.executable, "page.py"], folder)
    assert re.search(SAID.get(page_id(page), ""), said, re.MULTILINE), said


@pytest.mark.parametrize("page", pages(), ids=page_id)
def test_code_that_does_not_run_says_why(page: Path) -> None:
    for block in BLOCKS[page]:
        assert block.language in LANGUAGES, f"line {block.line}: '{block.language}' is none of {LANGUAGES}"
        if block.language == "py":
            assert NOT_RUN.fullmatch(block.before), f"line {block.line}: <!-- does not run: reason --> is missing"


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=page_id)
def test_commands_are_known_with_their_flags(page: Path) -> None:
    for block in (block for block in BLOCKS[page] if block.language == "sh"):
        for line, words in commands(block):
            given = ["1" if word.isupper() and len(word) == 1 else word for word in words]
            try:
                build_parser().parse_args(given)
            except SystemExit as stop:
                if stop.code == 0:  # --help and --version end here
                    continue
                raise AssertionError(f"line {line}: toolkit {shlex.join(words)} is not understood") from stop


@pytest.mark.parametrize("name", ["matcher", "recipe", "camera_model"])
def test_each_example_is_short(name: str) -> None:
    page = next(page for page in BLOCKS if page.parts[-2:] == ("extend", f"{name}.md"))
    files = [block for block in BLOCKS[page] if block.title]
    assert files
    for block in files:
        assert len(block.text.splitlines()) < MOST_LINES, block.title


@pytest.mark.slow
def test_the_recipe_of_the_page_is_a_command_and_its_second_run_reuses_the_first(folder: Path) -> None:
    page = next(page for page in WITH_PYTHON if page.name == "recipe.md")
    assert write_files(page, folder)
    install(folder)
    toolkit = [sys.executable, "-m", "toolkit"]
    assert "solid" in run([*toolkit, "recipes", "quick-look"], folder)
    for solid in ("3", "4"):
        run([*toolkit, "run", "quick-look", "--data", "photos", "--set", f"solid={solid}"], folder)
    told = run([*toolkit, "compare", "latest-1", "latest"], folder)
    assert "cloud.solid" in told


@pytest.mark.slow
def test_the_matcher_of_the_page_is_a_choice_of_recipes(folder: Path) -> None:
    page = next(page for page in WITH_PYTHON if page.name == "matcher.md")
    assert write_files(page, folder)
    install(folder)
    told = run([sys.executable, "-m", "toolkit", "recipes", "blades-sequential"], folder)
    assert "features.orb.max_ratio" in told
    assert "sift | disk-lightglue | aliked-lightglue | orb" in told
