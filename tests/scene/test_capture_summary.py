"""What is told of a capture at a glance: of a drawn flight, of which all is known, and of real photos."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from fake_recipe import write_photos
from photo_tags import retagged
from PIL import Image, ImageEnhance, ImageFilter

from toolkit.samples import FlightSettings, SampleSettings, SensorSettings, make_sample
from toolkit.scene.capture_summary import summary_rows, summary_warnings
from toolkit.scene.dataset import Capture, open_capture
from toolkit.scene.flight_facts import median_overlap, median_speed
from toolkit.scene.survey import PhotoFacts, evenly, read_facts, survey
from toolkit.scene.thumbnails import Thumbnails

FRAMES, HEIGHT, INTERVAL = 12, 50.0, 2.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a flight in strips, looking straight down, with nearly perfect sensors."""
    exact = dict.fromkeys(
        (
            "position_sigma_east",
            "position_sigma_north",
            "position_sigma_up",
            "yaw_sigma",
            "pitch_sigma",
            "roll_sigma",
            "relative_altitude_sigma",
        ),
        0.001,
    )
    flight = FlightSettings(
        pattern="lawnmower",
        radius=30.0,
        frames=FRAMES,
        height=HEIGHT,
        frame_interval=INTERVAL,
        image_width=96,
        image_height=72,
        samples=1,
        position_jitter=0.0,
        angle_jitter=0.0,
    )
    folder = tmp_path_factory.mktemp("samples") / "flight"
    make_sample(folder, SampleSettings(flight=flight, sensors=SensorSettings(**exact), points=100))
    return folder


def looked_at(folder: Path) -> tuple[Capture, tuple[PhotoFacts, ...], dict[str, str]]:
    capture = open_capture(folder)
    facts = read_facts(capture.scene)
    return capture, facts, {row.title: row.text for row in summary_rows(capture, facts)}


def photos_of(flown: Path, folder: Path) -> Path:
    """Copy the pictures alone: without scene.json they are photos."""
    return Path(shutil.copytree(flown / "images", folder))


def test_a_flight_is_told_as_it_was_flown(flown: Path) -> None:
    capture, facts, rows = looked_at(flown)
    assert rows["Photos"] == f"{FRAMES}, of which 2 are for tests"
    assert rows["Size"] == "96 × 72 px"
    assert rows["GPS position"] == rows["Gimbal attitude"] == f"{FRAMES} of {FRAMES} photos (100 %)"
    assert rows["Known poses"] == f"{FRAMES} of {FRAMES} photos"
    reference = capture.reference
    assert reference is not None
    # A horizontal field of view of 65 degrees.
    assert rows["Focal length"].startswith(f"{48 / np.tan(np.radians(32.5)):.0f} px; ")
    ways = np.linalg.norm(np.diff(reference.centres(), axis=0), axis=1)
    speed, overlap = median_speed(capture.scene), median_overlap(capture.scene, facts)
    assert speed == pytest.approx(np.median(ways) / INTERVAL, rel=1e-3)
    assert rows["Speed"].startswith(f"{speed:.1f} m/s")
    # Along a strip the picture's height is flown over; between strips it is its width: independent of the code, by
    # the corners of both footprints on the ground. Sensors are good to a millimetre, tags to some centimetres.
    assert overlap == pytest.approx(np.median(true_overlaps(capture)), abs=0.02)
    assert summary_warnings(capture, facts) == ()


def true_overlaps(capture: Capture) -> list[float]:
    """Return the share of each photo that the next one sees, by counting points of the ground."""
    reference = capture.reference
    assert reference is not None
    camera = reference.cameras[1]
    shares = []
    for first, second in zip(reference.frames, reference.frames[1:], strict=False):
        assert first.cam_from_world is not None
        assert second.cam_from_world is not None
        grid = np.stack(np.meshgrid(np.arange(0.5, 96), np.arange(0.5, 72)), axis=-1).reshape(-1, 2)
        origins, directions = camera.ray(grid)
        back = first.cam_from_world.inverse()
        start, way = back.apply(origins), directions @ back.rotation.T
        ground = start - way * (start[:, 2] / way[:, 2])[:, None]
        pixels = camera.project(second.cam_from_world.apply(ground))
        shares.append(float(np.mean(np.all((pixels >= 0) & (pixels <= [96, 72]), axis=1))))
    return shares


def test_photos_alone_tell_camera_height_and_times(flown: Path, tmp_path: Path) -> None:
    _, facts, rows = looked_at(photos_of(flown, tmp_path / "photos"))
    assert "Known poses" not in rows
    assert rows["Camera"] == facts[0].tags.camera
    low, _, high = rows["Height above take-off"].partition(" to ")
    assert {float(text.removesuffix(" m")) for text in (low, high) if text} <= {HEIGHT - 0.1, HEIGHT, HEIGHT + 0.1}
    first, last = facts[0].tags.time, facts[-1].tags.time
    assert first is not None
    assert last is not None
    assert last - first == pytest.approx((FRAMES - 1) * INTERVAL, abs=0.01)
    assert " to " in rows["Taken"]


def test_what_varies_is_told(flown: Path, tmp_path: Path) -> None:
    folder = photos_of(flown, tmp_path / "photos")
    names = sorted(path.name for path in folder.iterdir())
    with Image.open(folder / names[0]) as picture:
        picture.rotate(90, expand=True).save(folder / names[0])
    capture, facts, rows = looked_at(folder)
    assert rows["Size"] == f"96 × 72 px ({FRAMES - 1}), 72 × 96 px (1)"
    assert rows["GPS position"] == f"{FRAMES - 1} of {FRAMES} photos (92 %)"
    assert rows["Taken"].endswith("; not told by 1 of them")
    varying = {row.title for row in summary_rows(capture, facts) if row.varies}
    assert varying >= {"Size", "GPS position", "Gimbal attitude", "Taken"}
    told = summary_warnings(capture, facts)
    assert sum("no GPS position" in text for text in told) == 1
    assert sum("portrait format" in text for text in told) == 1


def test_no_gps_at_all_is_a_warning(tmp_path: Path) -> None:
    capture, facts, rows = looked_at(write_photos(tmp_path / "photos", 3))
    assert rows["GPS position"] == "0 of 3 photos (0 %)"
    assert rows["Focal length"] == "58 px, a guess: nothing is known of the lens"  # 1.2 x 48
    assert "Speed" not in rows
    assert "Overlap" not in rows
    (told,) = summary_warnings(capture, facts)
    assert told.startswith("no photo has a GPS position: methods that need sensors cannot run")


def test_positions_at_one_place_are_a_warning(flown: Path, tmp_path: Path) -> None:
    photos = photos_of(flown, tmp_path / "photos")
    place = looked_at(photos)[1][0].tags.position

    def same(tags: object) -> object:
        return dataclasses.replace(tags, position=place)

    folder = retagged(photos, tmp_path / "still", {path.name: same for path in photos.iterdir()})
    capture, facts, _ = looked_at(folder)
    assert any("all GPS positions lie within 1 m" in text for text in summary_warnings(capture, facts))


def test_mixed_orientation_is_a_warning(flown: Path, tmp_path: Path) -> None:
    folder = photos_of(flown, tmp_path / "photos")
    names = sorted(path.name for path in folder.iterdir())
    with Image.open(folder / names[2]) as picture:
        exif = picture.getexif()
        exif[0x0112] = 3
        picture.save(folder / names[2], exif=exif, xmp=picture.info["xmp"])
    capture, facts, _ = looked_at(folder)
    told = summary_warnings(capture, facts)
    assert any("to be shown turned" in text and names[2] in text for text in told)
    assert any("mixed orientation" in text for text in told)
    # The same photos with a scene beside them: opening them says nothing then.
    shutil.copytree(flown, tmp_path / "scene")
    shutil.copy(folder / names[2], tmp_path / "scene/images" / names[2])
    capture, facts, _ = looked_at(tmp_path / "scene")
    assert capture.warnings == ()
    told = summary_warnings(capture, facts)
    assert any("to be shown turned" in text and names[2] in text for text in told)
    assert any("mixed orientation" in text for text in told)


def test_blur_and_exposure_jumps_are_named(flown: Path, tmp_path: Path) -> None:
    folder = photos_of(flown, tmp_path / "photos")
    names = sorted(path.name for path in folder.iterdir())
    for name, change in ((names[4], blur), (names[8], darken)):
        with Image.open(folder / name) as picture:
            exif, xmp = picture.info["exif"], picture.info["xmp"]
            change(picture).save(folder / name, quality=92, exif=exif, xmp=xmp)
    capture, facts, _ = looked_at(folder)
    pictures = tuple(survey(capture.scene, facts, Thumbnails(tmp_path / "kept")).values())
    told = summary_warnings(capture, facts, pictures)
    (soft,) = [text for text in told if "may be blurred" in text]
    assert soft.startswith(f"1 of {FRAMES} photos")
    assert f"({names[4]} with" in soft
    (jump,) = [text for text in told if "than their neighbours" in text]
    assert f"{names[8]} by -" in jump


def blur(picture: Image.Image) -> Image.Image:
    return picture.filter(ImageFilter.GaussianBlur(2))


def darken(picture: Image.Image) -> Image.Image:
    return ImageEnhance.Brightness(picture).enhance(0.5)


def test_a_damaged_photo_is_a_warning_and_the_rest_is_told(flown: Path, tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    shutil.copytree(flown, folder)
    capture = open_capture(folder)
    names = [frame.name for frame in capture.scene.frames]
    (folder / "images" / names[1]).write_bytes(b"words")
    (folder / "images" / names[2]).write_bytes((folder / "images" / names[3]).read_bytes()[:700])
    facts = read_facts(capture.scene)
    assert "is no picture" in facts[1].damage
    pictures = tuple(survey(capture.scene, facts, Thumbnails(tmp_path / "kept")).values())
    assert [picture is None for picture in pictures[:4]] == [False, True, True, False]
    told = summary_warnings(capture, facts, pictures)
    assert any("is no picture" in text for text in told)
    assert {row.title: row.text for row in summary_rows(capture, facts)}["Size"] == "96 × 72 px"


def test_photos_are_chosen_evenly() -> None:
    assert evenly(5, 60) == [0, 1, 2, 3, 4]
    chosen = evenly(1000, 60)
    assert (len(chosen), len(set(chosen)), chosen[0], chosen[-1]) == (60, 60, 0, 999)
    assert set(np.diff(chosen)) <= {16, 17}


@pytest.mark.real
def test_brighton_has_nothing_to_mind(real_data: Path, tmp_path: Path) -> None:
    capture, facts, rows = looked_at(real_data / "uav_brighton_beach")
    changed: Mapping[str, str] = {
        "Camera": "DJI FC300S",
        "GPS position": "18 of 18 photos (100 %)",
        "Gimbal attitude": "18 of 18 photos (100 %)",
        "Size": "1280 × 720 px",
    }
    assert {title: rows[title] for title in changed} == changed
    # The README: about 40 m above take-off, a Phantom 3's lens of 3.61 mm (20 mm as of full frame).
    low, high = (float(text.split(" ")[0]) for text in rows["Height above take-off"].split(" to "))
    assert 38 < low <= high < 42
    assert rows["Focal length"].endswith("3.61 mm by the tags")
    assert capture.warnings == ()
    pictures = tuple(survey(capture.scene, facts, Thumbnails(tmp_path / "kept")).values())
    assert summary_warnings(capture, facts, pictures) == ()
    # One of them blurred as by half a second at walking pace, and it is named.
    folder = tmp_path / "photos"
    shutil.copytree(real_data / "uav_brighton_beach/images", folder)
    name = facts[9].name
    (folder / name).chmod(0o644)
    with Image.open(folder / name) as picture:
        picture.filter(ImageFilter.BoxBlur(4)).save(folder / name, exif=picture.info["exif"])
    capture, facts, _ = looked_at(folder)
    told = summary_warnings(
        capture, facts, tuple(survey(capture.scene, facts, Thumbnails(tmp_path / "kept")).values())
    )
    assert any("may be blurred" in text and f"({name} with" in text for text in told)
