"""Bad input from one end of the program to the other: each gets a message that names it and says what to do."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from photo_tags import retagged
from PIL import Image

from toolkit.cli import main
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene.dataset import Capture, open_capture
from toolkit.scene.exif import PhotoTags

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


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the pictures of a small flight, as a drone writes them."""
    settings = SampleSettings().replace(
        {
            "flight.frames": 8,
            "flight.arc": 60.0,
            "flight.image_width": 192,
            "flight.image_height": 144,
            "flight.samples": 1,
        }
    )
    folder = tmp_path_factory.mktemp("flight") / "town"
    make_sample(folder, settings)
    return folder / "images"


def with_gps(flown: Path, folder: Path, name: str, gps: Mapping[int, object]) -> Path:
    """Copy the flight with other GPS tags in one picture, as no careful writer would write them."""
    shutil.copytree(flown, folder)
    with Image.open(folder / name) as picture:
        exif, xmp, pixels = picture.getexif(), picture.info["xmp"], picture.convert("RGB")
    exif.get_ifd(0x8825).update(gps)
    pixels.save(folder / name, exif=exif, xmp=xmp)
    return folder


def sensor_arguments(data: Path, runs: Path) -> list[str]:
    return ["run", "sensor-3dgs", "--data", str(data), "--runs", str(runs), *QUICK]


def told_of(capture: Capture) -> str:
    return " | ".join(capture.warnings)


def test_photos_without_gps_cannot_be_placed_by_sensors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, *sensor_arguments(write_noise_photos(tmp_path / "photos", 4), tmp_path / "runs"))
    assert "do not say where they were taken" in said
    assert "Use colmap-3dgs" in said


def test_one_photo_without_gps_is_named(flown: Path, tmp_path: Path) -> None:
    folder = retagged(
        flown, tmp_path / "p", {"frame_0003.jpg": lambda tags: replace(tags, position=None, gimbal=None)}
    )
    assert "1 of 8 photos: no GPS position, which 7 others have (frame_0003.jpg)" in told_of(open_capture(folder))


def test_gps_0_0_is_no_position(flown: Path, tmp_path: Path) -> None:
    folder = with_gps(flown, tmp_path / "p", "frame_0002.jpg", {2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)})
    capture = open_capture(folder)
    assert "GPS position left out: it is 0, 0, which receivers without a fix write (frame_0002.jpg)" in told_of(
        capture
    )
    prior = capture.scene.frame("frame_0002.jpg").prior
    assert prior is not None
    assert prior.position is None


def test_an_altitude_that_cannot_be_is_left_out(flown: Path, tmp_path: Path) -> None:
    folder = with_gps(flown, tmp_path / "p", "frame_0005.jpg", {6: 90_000.0})
    assert "the altitude is 90000 m, expected -1000 to 50000 (frame_0005.jpg)" in told_of(open_capture(folder))


def test_heights_that_contradict_each_other_are_told(flown: Path, tmp_path: Path) -> None:
    def low(tags: PhotoTags) -> PhotoTags:
        assert tags.position is not None
        return replace(tags, position=(*tags.position[:2], tags.position[2] - 60.0), above_ellipsoid=False)

    told = told_of(open_capture(retagged(flown, tmp_path / "p", {"frame_0004.jpg": low})))
    assert "GPS height and height above take-off contradict each other by over 15 m (frame_0004.jpg)" in told
    assert "7 of 8 photos: altitude above the ellipsoid, others above the sea" in told


def test_orientation_0_is_taken_as_upright_and_told(flown: Path, tmp_path: Path) -> None:
    folder = retagged(flown, tmp_path / "p", {})
    with Image.open(folder / "frame_0001.jpg") as picture:
        exif, pixels = picture.getexif(), picture.convert("RGB")
    exif[0x0112] = 0
    pixels.save(folder / "frame_0001.jpg", exif=exif)
    assert "its orientation tag is 0, expected 1 to 8; it is taken as upright (frame_0001.jpg)" in told_of(
        open_capture(folder)
    )


def test_portrait_among_landscape_is_told_and_gets_a_camera(flown: Path, tmp_path: Path) -> None:
    folder = retagged(flown, tmp_path / "p", {})
    with Image.open(folder / "frame_0006.jpg") as picture:
        picture.convert("RGB").transpose(Image.Transpose.ROTATE_90).save(folder / "frame_0006.jpg")
    capture = open_capture(folder)
    assert "portrait format among landscape ones; each format gets a camera of its own (frame_0006.jpg)" in told_of(
        capture
    )
    assert len(capture.scene.cameras) == 2


def test_what_the_data_say_is_shown_with_the_result(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = retagged(
        flown, tmp_path / "p", {"frame_0003.jpg": lambda tags: replace(tags, position=None, gimbal=None)}
    )
    assert main(sensor_arguments(folder, tmp_path / "runs")) == 0
    said = capsys.readouterr().out
    assert "data: 1 of 8 photos: no GPS position, which 7 others have (frame_0003.jpg)" in said
    assert "sensors: 1 of 8 frames have no GPS position: frame_0003.jpg" in said


def test_transforms_without_a_key(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = retagged(flown, tmp_path / "p", {})
    (folder / "transforms.json").write_text('{"frames": [{"file_path": "frame_0000.jpg"}], "fl_x": 100}')
    said = refused(capsys, *run_arguments(folder, tmp_path / "runs"))
    assert "transforms.json" in said
    assert "transform_matrix" in said
