"""Flights with bad readings from one end of the program to the other: what is told, and what still comes out."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from photo_tags import retagged

from toolkit.cli import main
from toolkit.runs.index import list_runs
from toolkit.samples.drone_flights import OrbitVideoSettings, make_drone_flight
from toolkit.samples.make import SampleSettings, make_sample
from toolkit.scene.exif import PhotoTags

PHOTOS = 12
QUICK = ["--set", "train.steps=2", "--set", "train.max_side=64"]
NAMES = [f"frame_{number:04d}.jpg" for number in range(PHOTOS)]

Metrics = Mapping[str, float | None]


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a third of a circle, the camera looking inwards, as a drone writes it: 1 m, 1 degree, no bias."""
    changes = {
        "flight.frames": PHOTOS,
        "flight.arc": 120.0,
        "flight.image_width": 320,
        "flight.image_height": 240,
        "flight.samples": 1,
        "points": 0,
    }
    folder = tmp_path_factory.mktemp("flight") / "town"
    make_sample(folder, SampleSettings().replace(changes), seed=0)
    return folder / "images"


def fused(folder: Path, runs: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[str, Metrics]:
    """Run sensor-fused from the command line; return what it printed and its measures."""
    code = main(["run", "sensor-fused", "--data", str(folder), "--runs", str(runs), *QUICK, *more])
    said = capsys.readouterr()
    assert code == 0, said.err
    row = list_runs(runs)[-1]
    assert row.metrics is not None
    return " ".join(said.out.split()), row.metrics


def without_gps(tags: PhotoTags) -> PhotoTags:
    return replace(tags, position=None, relative_altitude=None)


def test_half_of_the_photos_without_gps(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = retagged(photos, tmp_path / "p", dict.fromkeys(NAMES[1::2], without_gps))
    runs = tmp_path / "runs"
    # Pairs by place are not guessed where so many have none: the message says what would do.
    assert main(["run", "sensor-fused", "--data", str(folder), "--runs", str(runs), *QUICK]) == 2
    refusal = " ".join(capsys.readouterr().err.split())
    assert "need a position of most frames" in refusal
    assert "found 6 of 12 frames without one: frame_0001.jpg" in refusal
    assert "Choose the exhaustive or the sequential method" in refusal
    said, metrics = fused(folder, runs, capsys, "--set", "pairs.method=exhaustive")
    assert "6 of 12 photos: no GPS position, which 6 others have" in said
    assert metrics["sfm.registered"] == PHOTOS
    # The six that have a position hold it: their noise is 1 m an axis.
    residual = metrics["sensors.position_residual_m"]
    assert residual is not None
    assert residual < 3.0


def test_angles_of_the_airframe_in_place_of_the_gimbals(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def airframe(tags: PhotoTags) -> PhotoTags:
        # The drone flies along the circle while the camera looks to its middle.
        assert tags.gimbal is not None
        return replace(tags, gimbal=replace(tags.gimbal, yaw=tags.gimbal.yaw + 90.0))

    folder = retagged(photos, tmp_path / "p", dict.fromkeys(NAMES, airframe))
    said, metrics = fused(folder, tmp_path / "runs", capsys)
    assert "heading" in said
    assert metrics["sfm.registered"] == PHOTOS
    bias, sigma = metrics["sensors.heading_bias_deg"], metrics["sensors.heading_bias_sigma_deg"]
    assert bias is not None
    assert sigma is not None
    assert bias == pytest.approx(90.0, abs=3 * sigma + 0.5)


def test_photos_that_were_taken_before_the_take_off(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = retagged(photos, tmp_path / "p", {})
    for number in range(4):
        shutil.copyfile(folder / NAMES[0], folder / f"before_{number}.jpg")
    _, metrics = fused(folder, tmp_path / "runs", capsys)
    assert metrics["sfm.registered"] == PHOTOS + 4
    # Four more readings of one place pull no more than one: the noise is 1 m an axis.
    residual = metrics["sensors.position_residual_m"]
    assert residual is not None
    assert residual < 3.0


def test_half_of_the_heights_from_another_level(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def above_the_sea(tags: PhotoTags) -> PhotoTags:
        # The geoid lies 48 m above the ellipsoid here.
        assert tags.position is not None
        latitude, longitude, altitude = tags.position
        return replace(
            tags, position=(latitude, longitude, altitude - 48.0), above_ellipsoid=False, relative_altitude=None
        )

    folder = retagged(photos, tmp_path / "p", dict.fromkeys(NAMES[1::2], above_the_sea))
    runs = tmp_path / "runs"
    assert main(["run", "sensor-fused", "--data", str(folder), "--runs", str(runs), *QUICK]) == 2
    refusal = " ".join(capsys.readouterr().err.split())
    assert "The pictures contradict the positions of most photos" in refusal
    assert "heights above several levels" in refusal
    (row,) = list_runs(runs)
    log = (row.run.path / "log.txt").read_text(encoding="utf-8")
    assert "6 of 12 photos: altitude above the ellipsoid, others above the sea" in log


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda blocks: blocks[::-1], "earlier than the one before them: sorted by time"),
        (lambda blocks: [block for block in blocks for _ in range(2)], "have the time of another: merged"),
    ],
)
def test_telemetry_that_is_unsorted_or_doubled(
    film: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[list[str]], list[str]],
    told: str,
) -> None:
    blocks = (film / "video.srt").read_text(encoding="utf-8").strip().split("\n\n")
    odd = tmp_path / "odd.srt"
    odd.write_text("\n\n".join(change(blocks)) + "\n", encoding="utf-8")
    arguments = ["frames", str(film / "video.mp4"), str(tmp_path / "out"), "--telemetry", str(odd)]
    code = main([*arguments, "--keyframes.method=every-nth", "--keyframes.every=3"])
    said = capsys.readouterr()
    assert code == 0, said.err
    assert told in said.err
    assert "4 with priors" in said.out


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of twelve filmed frames with telemetry."""
    pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
    changes = {
        "town.trees": 0,
        "flight.frames": 12,
        "flight.arc": 20.0,
        "flight.image_width": 96,
        "flight.image_height": 72,
        "flight.samples": 1,
    }
    folder = tmp_path_factory.mktemp("film") / "orbit"
    make_drone_flight(folder, OrbitVideoSettings().replace(changes), seed=0)
    return folder
