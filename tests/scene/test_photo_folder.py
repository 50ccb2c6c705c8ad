"""A scene from a folder of photos: order, cameras, EXIF."""

from __future__ import annotations

import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from toolkit.errors import Cancelled, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.scene import Scene
from toolkit.scene.exif import PhotoTags
from toolkit.scene.photos import PhotoFolder, scene_from_photos
from toolkit.scene.tag_writer import exif_block, xmp_packet

GPS = {1: "N", 2: (46.0, 50.0, 33.3855), 3: "W", 4: (91.0, 59.0, 40.4156), 5: b"\x00", 6: 198.309}


def photo(path: Path, size: tuple[int, int] = (40, 30), **tags: Any) -> Path:
    """Save a photo; ``base``, ``photo`` and ``gps`` are tables of EXIF tags by number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    for number, value in tags.get("base", {}).items():
        exif[number] = value
    if "photo" in tags:
        exif[0x8769] = tags["photo"]
    if "gps" in tags:
        exif[0x8825] = tags["gps"]
    kind = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}.get(path.suffix.lower(), "JPEG")
    Image.new("RGB", size, (90, 120, 40)).save(path, kind, exif=exif)
    return path


def focal(found: PhotoFolder) -> float:
    (camera,) = found.scene.cameras.values()
    assert isinstance(camera, ColmapCamera)
    return camera.params[0]


def test_photos_are_found_in_natural_order_whatever_their_case_and_folder(tmp_path: Path) -> None:
    names = ["a2.jpg", "a010.jpg", "a10.jpg", "a11.JPG", "b/1.Jpeg", "b/02.TIFF", "b/10.png", "z.tif"]
    for name in reversed(names):
        photo(tmp_path / name)
    for other in ("notes.txt", "._a2.jpg", ".thumbs/x.jpg", "masks/a2.jpg.png", "clip.mp4", "x.webp"):
        (tmp_path / other).parent.mkdir(exist_ok=True)
        (tmp_path / other).write_bytes(b"none")
    scene = scene_from_photos(tmp_path).scene
    assert [frame.name for frame in scene.frames] == names
    assert scene.image_dir == tmp_path
    assert scene.mask_dir == tmp_path / "masks"
    assert all(frame.cam_from_world is None for frame in scene.frames)


def test_an_images_folder_is_preferred(tmp_path: Path) -> None:
    photo(tmp_path / "preview.jpg")
    photo(tmp_path / "images/1.jpg")
    photo(tmp_path / "images/masks2/1.jpg")
    scene = scene_from_photos(tmp_path).scene
    assert scene.image_dir == tmp_path / "images"
    assert [frame.name for frame in scene.frames] == ["1.jpg", "masks2/1.jpg"]
    assert scene.mask_dir is None


def test_one_camera_for_each_size_camera_and_focal_length(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg")
    photo(tmp_path / "2.jpg", (60, 30))
    photo(tmp_path / "3.jpg", base={0x010F: "DJI\0\0", 0x0110: "FC300S\0"})
    photo(tmp_path / "4.jpg", base={0x010F: "DJI", 0x0110: "FC300S"}, photo={0xA405: 20})
    photo(tmp_path / "5.jpg")
    shared = scene_from_photos(tmp_path, camera_model="OPENCV").scene
    assert [frame.camera_id for frame in shared.frames] == [1, 2, 3, 4, 1]
    assert shared.cameras[2] == ColmapCamera("OPENCV", 60, 30, (72.0, 72.0, 30.0, 15.0, 0, 0, 0, 0))
    own = scene_from_photos(tmp_path, share_camera=False).scene
    assert [frame.camera_id for frame in own.frames] == [1, 2, 3, 4, 5]


def test_the_start_focal_length_is_colmaps(tmp_path: Path) -> None:
    cases: list[dict[str, Any]] = [
        {"photo": {0xA405: 20}},
        {"photo": {0xA405: 35, 0x920A: IFDRational(36, 10)}},
        {"photo": {0x920A: IFDRational(5, 1), 0xA20E: IFDRational(80, 1), 0xA210: 3}},
        {"photo": {0x920A: IFDRational(5, 1), 0xA20E: IFDRational(200, 1), 0xA210: 2}},
    ]
    for number, tags in enumerate(cases):
        path = photo(tmp_path / str(number) / "a.jpg", (120, 80), **tags)
        bitmap = pycolmap.Bitmap.read(str(path), True)
        assert bitmap is not None
        found = scene_from_photos(path.parent)
        # COLMAP rounds the diagonal of full frame to 43.27 mm.
        assert focal(found) == pytest.approx(bitmap.exif_focal_length(), rel=1e-4)
        assert found.scene.cameras[1].prior_focal_length
        assert found.warnings == ()


def test_without_tags_the_focal_length_is_a_guess_from_the_longer_side(tmp_path: Path) -> None:
    photo(tmp_path / "a.png", (30, 50), photo={0x920A: IFDRational(5, 1)})
    found = scene_from_photos(tmp_path)
    assert focal(found) == 60.0
    assert not found.scene.cameras[1].prior_focal_length


def test_the_focal_plane_is_that_of_the_picture_before_it_was_resized(tmp_path: Path) -> None:
    tags = {0x920A: IFDRational(15, 1), 0xA20E: IFDRational(80, 1), 0xA210: 3, 0xA002: 240}
    photo(tmp_path / "a.jpg", (120, 80), photo=tags)
    assert focal(scene_from_photos(tmp_path)) == pytest.approx(15 * 8 / 2, rel=1e-12)


@pytest.mark.parametrize(
    ("tags", "warning"),
    [
        ({0xA405: 1}, "FocalLengthIn35mmFilm gives an unlikely focal length of 1 px"),
        ({0xA405: 65535}, "FocalLengthIn35mmFilm gives an unlikely focal length"),
        (
            {0x920A: IFDRational(30, 1), 0xA20E: IFDRational(4865, 1), 0xA210: 2},
            "FocalPlaneXResolution gives an unlikely focal length of 5746 px, which was left out",
        ),
        ({0x920A: IFDRational(1, 0), 0xA20E: IFDRational(80, 1)}, "FocalLength is not finite"),
        ({0x920A: IFDRational(0, 0), 0xA20E: IFDRational(80, 1)}, "FocalLength is not finite"),
        (
            {0x920A: IFDRational(5, 1), 0xA20E: IFDRational(80, 1), 0xA210: 77},
            "FocalPlaneResolutionUnit is unknown",
        ),
    ],
)
def test_focal_lengths_that_cannot_be_are_left_out_with_a_warning(
    tmp_path: Path, tags: dict[int, Any], warning: str
) -> None:
    photo(tmp_path / "a.jpg", photo=tags)
    found = scene_from_photos(tmp_path)
    assert focal(found) == 48.0
    assert len(found.warnings) == 1
    assert warning in found.warnings[0]


# ---------------------------------------------------------------------------------------------------------- GPS


def positions(scene: Scene) -> list[Any]:
    return [None if frame.prior is None else frame.prior.position for frame in scene.frames]


def test_positions_are_metres_east_north_and_up_of_the_first(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg", gps=GPS)
    photo(tmp_path / "2.jpg", gps={**GPS, 2: (46.0, 50.0, 34.3855), 6: 208.309})
    photo(tmp_path / "3.jpg", gps={**GPS, 4: (91.0, 59.0, 39.4156), 5: b"\x01", 6: 1.691})
    found = scene_from_photos(tmp_path)
    assert found.warnings == ()
    origin = found.scene.georeference
    assert origin is not None
    assert origin.latitude == pytest.approx(46 + 50 / 60 + 33.3855 / 3600, abs=1e-12)
    assert origin.longitude == pytest.approx(-(91 + 59 / 60 + 40.4156 / 3600), abs=1e-12)
    assert origin.altitude == pytest.approx(198.309)
    first, north, east = positions(found.scene)
    np.testing.assert_allclose(first, 0, atol=1e-6)
    # An arc second of latitude at 46.84 degrees is 30.87 m (meridian radius of curvature 6,369,400 m).
    np.testing.assert_allclose(north, [0, 30.88, 10], atol=0.01)
    # An arc second of longitude there is 21.19 m; -1.691 m lies 200 m below the origin, below sea level.
    np.testing.assert_allclose(east, [21.19, 0, -200], atol=0.02)


def test_the_frame_agrees_with_an_independent_conversion(tmp_path: Path) -> None:
    pyproj = pytest.importorskip("pyproj")
    photo(tmp_path / "1.jpg", gps=GPS)
    photo(tmp_path / "2.jpg", gps={**GPS, 2: (46.0, 51.0, 3.5), 4: (91.0, 58.0, 0.0), 6: 300.0})
    scene = scene_from_photos(tmp_path).scene
    origin = scene.georeference
    assert origin is not None
    enu = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={origin.latitude!r} +lon_0={origin.longitude!r} +h_0={origin.altitude!r}"
    ).transform(-(91 + 58 / 60), 46 + 51 / 60 + 3.5 / 3600, 300.0)
    # PROJ evaluates the same formulas.
    np.testing.assert_allclose(positions(scene)[1], enu, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({2: (IFDRational(46, 0), 50.0, 33.0)}, "latitude is not finite"),
        ({2: (IFDRational(0, 0), IFDRational(0, 0), IFDRational(0, 0))}, "latitude is not finite"),
        ({6: IFDRational(0, 0)}, "altitude is not finite"),
        ({6: IFDRational(5, 0)}, "altitude is not finite"),
        ({6: 4_000_000.0}, "the altitude is 4e+06 m"),
        ({2: (46.0, 50.0)}, "latitude is not degrees, minutes and seconds"),
        ({2: (91.0, 0.0, 0.0)}, "latitude is 91 0 0"),
        ({4: (180.0, 0.0, 1.0)}, "longitude is 180 0 1"),
        ({1: ""}, "latitude does not say N or S"),
        ({3: "X"}, "longitude does not say E or W"),
        ({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, "it is 0, 0, which receivers without a fix write"),
        ({6: None}, "there is no altitude"),
        ({4: None}, "longitude is not degrees"),
    ],
)
def test_positions_that_cannot_be_are_left_out_with_a_warning(
    tmp_path: Path, change: dict[int, Any], why: str
) -> None:
    photo(tmp_path / "1.jpg", gps=GPS)
    photo(tmp_path / "2.jpg", gps={key: value for key, value in {**GPS, **change}.items() if value is not None})
    found = scene_from_photos(tmp_path)
    assert [position is None for position in positions(found.scene)] == [False, True]
    assert any(why in warning and "(2.jpg)" in warning for warning in found.warnings), found.warnings
    assert "1 of 2 photos: no GPS position, which 1 others have (2.jpg)" in found.warnings


def test_without_any_position_there_is_no_georeference_and_no_warning(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg")
    found = scene_from_photos(tmp_path)
    assert found.scene.georeference is None
    assert found.warnings == ()


def test_a_warning_names_three_photos_at_most(tmp_path: Path) -> None:
    for number in range(5):
        photo(tmp_path / f"{number}.jpg", gps={**GPS, 6: IFDRational(0, 0)})
    assert scene_from_photos(tmp_path).warnings == (
        "5 of 5 photos: GPS position left out: altitude is not finite (0.jpg, 1.jpg, 2.jpg, ...)",
    )


def test_damaged_tags_are_a_warning_or_values_and_never_a_crash(tmp_path: Path) -> None:
    path = photo(tmp_path / "a.jpg", base={0x0110: "M"}, photo={0xA405: 20, 0x920A: IFDRational(7, 2)}, gps=GPS)
    whole, rng, warned = path.read_bytes(), random.Random(5), 0
    end = whole.index(b"\xff\xdb")
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(rng.choice([1, 2, 5])):
            damaged[rng.randrange(24, end)] = rng.choice([0, 255, rng.randrange(256)])
        path.write_bytes(damaged)
        try:
            found = scene_from_photos(tmp_path, check=False)
        except DataError:
            continue
        warned += bool(found.warnings)
        for position in positions(found.scene):
            assert position is None or np.isfinite(position).all()
        assert 0 < focal(found) < 1e6
    assert warned > 50


# ------------------------------------------------------------------------------------------------------- pixels


def test_turned_photos_are_used_as_stored_as_colmap_does(tmp_path: Path) -> None:
    pixels = (np.random.default_rng(0).random((8, 12, 3)) * 255).astype(np.uint8)
    tags = Image.Exif()
    tags[0x0112] = 6
    (tmp_path / "images").mkdir()
    Image.fromarray(pixels).resize((192, 128), Image.Resampling.NEAREST).save(
        tmp_path / "images/a.jpg", exif=tags, quality=95
    )
    scene = scene_from_photos(tmp_path).scene
    assert (scene.cameras[1].width, scene.cameras[1].height) == (192, 128)
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1
    pycolmap.extract_features(tmp_path / "a.db", tmp_path / "images", extraction_options=options)
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        (image,) = database.read_all_images()
        camera = database.read_camera(image.camera_id)
        keypoints = database.read_keypoints(image.image_id)
    assert (camera.width, camera.height) == (192, 128)
    assert keypoints[:, 0].max() > 128


# ------------------------------------------------------------------------------------------------------- errors


def test_a_missing_folder_and_one_without_photos_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Folder .*gone is missing; expected a folder with photos"):
        scene_from_photos(tmp_path / "gone")
    with pytest.raises(
        DataError, match=r"No photos in .*; expected files ending in \.jpg, \.jpeg.*found an empty folder"
    ):
        scene_from_photos(tmp_path)
    (tmp_path / "a.mp4").write_bytes(b"")
    with pytest.raises(DataError, match=r"expected files ending in \.jpg.*; found a\.mp4"):
        scene_from_photos(tmp_path)


def test_a_folder_that_may_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: str) -> None:
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr(os, "scandir", refuse)
    with pytest.raises(DataError, match=rf"Cannot read folder {tmp_path}; found .*Permission denied"):
        scene_from_photos(tmp_path)


def test_a_photo_cut_off_is_found_by_the_check_only(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg")
    path = photo(tmp_path / "2.jpg", (400, 300))
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DataError, match=r"Picture .*2\.jpg is cut off or damaged.*Copy it again from the camera"):
        scene_from_photos(tmp_path)
    assert len(scene_from_photos(tmp_path, check=False).scene) == 2


@pytest.mark.parametrize(("content", "found"), [(b"", "an empty file"), (b"text", "4 bytes that are none")])
def test_empty_files_and_texts_are_named(tmp_path: Path, content: bytes, found: str) -> None:
    photo(tmp_path / "1.jpg")
    (tmp_path / "2.jpg").write_bytes(content)
    with pytest.raises(DataError, match=rf"2\.jpg is no picture.*found {found}.*or delete it"):
        scene_from_photos(tmp_path, check=False)


@pytest.mark.parametrize("name", [b"\xff.jpg", b"a\nb.jpg"])
def test_a_name_that_cannot_be_stored_is_an_error(tmp_path: Path, name: bytes) -> None:
    photo(tmp_path / "a.jpg").rename(tmp_path / os.fsdecode(name))
    with pytest.raises(DataError, match=r"cannot be stored; expected a name without control characters.*Rename"):
        scene_from_photos(tmp_path)


def test_an_unknown_camera_model_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Unknown camera model 'LENS'; expected .*SIMPLE_RADIAL"):
        scene_from_photos(tmp_path, camera_model="LENS")


def test_progress_counts_photos_and_can_cancel(tmp_path: Path) -> None:
    for number in range(3):
        photo(tmp_path / f"{number}.jpg")
    events: list[ProgressEvent] = []
    scene_from_photos(tmp_path, progress=events.append)
    assert [(event.done, event.total) for event in events] == [(0, 3), (1, 3), (2, 3), (3, 3)]
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        scene_from_photos(tmp_path, progress=token)


@pytest.mark.parametrize(("telling", "expected"), [(3, [40.0, 41.0, 42.0]), (1, [0.0, 1.0, 2.0])])
def test_z_is_the_height_above_the_take_off_where_most_photos_tell_it(
    tmp_path: Path, telling: int, expected: list[float]
) -> None:
    for i in range(3):
        tags = PhotoTags(
            position=(46.8, -92.0, 198.0 + i), relative_altitude=40.0 + i if i < telling else None, time=None
        )
        Image.new("RGB", (40, 30)).save(tmp_path / f"{i}.jpg", exif=exif_block(tags, 40, 30), xmp=xmp_packet(tags))
    scene = scene_from_photos(tmp_path).scene
    heights = [None if f.prior is None or f.prior.position is None else f.prior.position[2] for f in scene.frames]
    # EXIF holds altitudes in thousandths of a metre.
    assert heights == pytest.approx(expected, abs=0.002)
