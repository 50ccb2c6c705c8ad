"""Bad input from one end of the program to the other: each gets a message that names it and says what to do."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.cli import main

QUICK = ["--set", "sift.max_features=512", "--set", "train.steps=5", "--set", "train.max_side=64"]


def write_noise_photos(folder: Path, count: int, *, seed: int = 0) -> Path:
    """Write pictures of smooth noise that have features but nothing in common with each other."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    for number in range(count):
        coarse = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
        Image.fromarray(coarse).resize((256, 192), Image.Resampling.BICUBIC).save(folder / f"{number}.png")
    return folder


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run the command, which must fail with exit code 2 and without a traceback, and return its message."""
    code = main(list(arguments))
    said = capsys.readouterr().err
    assert code == 2, said
    assert "Traceback" not in said
    message = said[said.index("error:") :]
    return " ".join(message.split())


def run_arguments(data: Path, runs: Path, *more: str) -> list[str]:
    return ["run", "colmap-3dgs", "--data", str(data), "--runs", str(runs), *QUICK, *more]


def test_a_folder_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, *run_arguments(tmp_path / "nowhere", tmp_path / "runs"))
    assert "nowhere" in said


def test_a_folder_without_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").write_text("no pictures here")
    said = refused(capsys, *run_arguments(tmp_path / "empty", tmp_path / "runs"))
    assert "empty" in said
    assert ".jpg" in said


def test_a_truncated_jpeg(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_noise_photos(tmp_path / "photos", 4)
    Image.open(folder / "2.png").save(folder / "broken.jpg")
    whole = (folder / "broken.jpg").read_bytes()
    (folder / "broken.jpg").write_bytes(whole[: len(whole) // 2])
    said = refused(capsys, *run_arguments(folder, tmp_path / "runs"))
    assert "broken.jpg" in said
    assert "truncated" in said


def test_an_unknown_setting(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_noise_photos(tmp_path / "photos", 4)
    said = refused(capsys, *run_arguments(folder, tmp_path / "runs", "--set", "train.step=5"))
    assert "Unknown setting 'step'" in said
    assert "Did you mean 'steps'?" in said


@pytest.mark.parametrize("text", ["-1", "nan", "many", "1e999", "2.5", "true"])
def test_a_value_out_of_range(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    folder = write_noise_photos(tmp_path / "photos", 4)
    said = refused(capsys, *run_arguments(folder, tmp_path / "runs", "--set", f"train.steps={text}"))
    assert "steps" in said
    assert "whole number 1 to 1000000" in said


def test_nan_in_a_setting(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_noise_photos(tmp_path / "photos", 4)
    said = refused(capsys, *run_arguments(folder, tmp_path / "runs", "--set", "train.lambda_dssim=nan"))
    assert "lambda_dssim" in said
    assert "nan" in said


def test_photos_that_do_not_overlap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_noise_photos(tmp_path / "photos", 5)
    said = refused(capsys, *run_arguments(folder, tmp_path / "runs"))
    assert "overlap" in said


def test_spatial_pairs_without_positions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_noise_photos(tmp_path / "photos", 4)
    said = refused(capsys, *run_arguments(folder, tmp_path / "runs", "--set", "pairs.method=spatial"))
    assert "position" in said
    assert "exhaustive" in said


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a folder on a file system of 2 MiB, or skip where one cannot be mounted."""
    folder = tmp_path / "small"
    folder.mkdir()
    mount = shutil.which("mount")
    if os.geteuid() != 0 or mount is None:
        pytest.skip("mounting a small file system needs root")
    done = subprocess.run(
        [mount, "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip(f"no small file system could be mounted: {done.stderr.strip()}")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk(tmp_path: Path, small_disk: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_noise_photos(tmp_path / "photos", 12)
    said = refused(capsys, *run_arguments(folder, small_disk / "runs"))
    assert "disk is full" in said
    assert "resume" in said
