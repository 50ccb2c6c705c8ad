"""Satellite pictures become a scene, and a folder of them a capture."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import pytest
from rpc_samples import CORNERS, digital_globe_xml, geom, rpb, rpc_txt, sample_rpc, satnerf_json, write_picture

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc import Rpc
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.scene.capture_folders import find_captures
from toolkit.scene.capture_summary import summary_warnings
from toolkit.scene.colmap import write_colmap
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.footprints import footprint, overlapping_groups
from toolkit.scene.pictures import load_picture
from toolkit.scene.raster import read_raster
from toolkit.scene.satellite import (
    is_satellite,
    open_satellite,
    read_satellite,
    sun_direction,
)
from toolkit.scene.scene import Frame, Points, Scene
from toolkit.scene.survey import photo_facts
from toolkit.scene.thumbnails import Thumbnails

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'sightline-toolkit[geo]'")
rasterio_shutil = pytest.importorskip("rasterio.shutil")

PLACE = (43.26, 5.44)
LEANS = {"a.tif": (0.3, -0.1), "b.tif": (-0.2, 0.2), "c.tif": (0.0, 0.4)}


def triplet(folder: Path) -> Path:
    for seed, (name, lean) in enumerate(LEANS.items()):
        write_picture(folder / name, sample_rpc(seed, place=PLACE, lean=lean), seed=seed)
    return folder


def camera(rpc: Rpc) -> RpcCamera:
    return RpcCamera(rpc, 400, 300, (*PLACE, 100.0))


def write_map(path: Path, dtype: str = "float32") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(
        path, "w", driver="GTiff", width=8, height=6, count=1, dtype=dtype,
        crs="EPSG:32631", transform=rasterio.Affine(0.5, 0, 698053, 0, -0.5, 4792984),
    ) as dataset:  # fmt: skip
        dataset.write(np.ones((6, 8), dtype), 1)
    return path


def cameras_of(scene: Scene) -> list[RpcCamera]:
    cameras = [scene.camera_of(frame) for frame in scene.frames]
    assert all(isinstance(camera, RpcCamera) for camera in cameras)
    return [camera for camera in cameras if isinstance(camera, RpcCamera)]


# -------------------------------------------------------------------------------------------------------- the scene


def test_every_picture_becomes_a_frame_with_its_camera(tmp_path: Path) -> None:
    scene = open_satellite(triplet(tmp_path))
    assert [frame.name for frame in scene.frames] == ["a.tif", "b.tif", "c.tif"]
    assert scene.image_dir == tmp_path
    assert scene.points is None
    for seed, (frame, camera) in enumerate(zip(scene.frames, cameras_of(scene), strict=True)):
        assert frame.cam_from_world is not None
        np.testing.assert_array_equal(frame.cam_from_world.matrix, np.eye(4))
        assert (camera.width, camera.height) == (400, 300)
        assert camera.correction == (0.0,) * 6
        assert camera.extrapolate is False
        rpc = sample_rpc(seed, place=PLACE, lean=LEANS[frame.name])
        places = rpc.locate(CORNERS, [60.0, 80.0, 120.0, 140.0])
        # The tag has fifteen digits; a float64 of Earth's radius a nanometre.
        np.testing.assert_allclose(
            camera.project(enu_from_geodetic(places, camera.origin)), CORNERS, rtol=0, atol=1e-6
        )


def test_the_origin_is_in_the_middle_at_the_mean_height(tmp_path: Path) -> None:
    scene = open_satellite(triplet(tmp_path))
    origin = scene.georeference
    assert origin is not None
    assert origin.altitude == 100.0
    # At its height offset the middle of each picture is the RPC's offset, to the small terms and the bulge of the
    # ground: a metre.
    off = enu_from_geodetic([[*PLACE, 100.0]], (origin.latitude, origin.longitude, origin.altitude))
    assert np.abs(off).max() < 1.0
    assert {camera.origin for camera in cameras_of(scene)} == {(origin.latitude, origin.longitude, 100.0)}


def test_an_origin_at_the_date_line_is_not_on_the_other_side_of_the_earth(tmp_path: Path) -> None:
    for seed, longitude in enumerate((179.9999, -179.9999)):
        write_picture(tmp_path / f"{seed}.tif", sample_rpc(seed, place=(10.0, longitude)))
    scene = open_satellite(tmp_path)
    assert scene.georeference is not None
    assert abs(abs(scene.georeference.longitude) - 180) < 1e-3
    middle = np.array([[200.0, 150.0]])
    for camera in cameras_of(scene):
        assert np.linalg.norm(camera.locate(middle, 100.0)[:, :2]) < 50


def test_side_files_of_any_kind_do(tmp_path: Path) -> None:
    kinds = {"a_RPC.TXT": rpc_txt, "b.RPB": rpb, "c.geom": geom, "d.json": satnerf_json, "e.XML": digital_globe_xml}
    for seed, (name, writer) in enumerate(kinds.items()):
        write_picture(tmp_path / "images" / f"{name[0]}.tif")
        place = tmp_path / "images" / name if seed % 2 else tmp_path / name
        place.write_text(writer(sample_rpc(seed)))
    opened = read_satellite(tmp_path)
    assert opened.warnings == ()
    assert opened.scene.image_dir == tmp_path / "images"
    assert [camera.rpc for camera in cameras_of(opened.scene)] == [sample_rpc(seed) for seed in range(5)]
    assert [view.kind for view in opened.views.values()] == [
        "RPC text",
        "RPB",
        "OTB geometry",
        "JSON",
        "DigitalGlobe XML",
    ]
    # Times count from the first picture that has one: August 2013.
    assert [frame.time for frame in opened.scene.frames[:3]] == [None, None, 0.0]
    assert opened.scene.frames[3].time == pytest.approx(425.9 * 86400, rel=1e-2)
    assert opened.views["d.tif"].sun_elevation == 50.8


def test_files_from_anywhere_are_a_scene(tmp_path: Path) -> None:
    one = write_picture(tmp_path / "left" / "a.tif")
    other = write_picture(tmp_path / "right" / "b.tif", sample_rpc(1))
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "a.RPB").write_text(rpb(sample_rpc(0)))
    scene = open_satellite([one, other, tmp_path / "meta" / "a.RPB"])
    assert scene.image_dir == tmp_path
    assert [frame.name for frame in scene.frames] == ["left/a.tif", "right/b.tif"]
    assert scene.image_path(scene.frames[0]) == one
    assert cameras_of(scene)[0].rpc == sample_rpc(0)


def test_nitf_pictures_are_views(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.tif", sample_rpc(0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        rasterio_shutil.copy(tmp_path / "a.tif", tmp_path / "a.ntf", driver="NITF", RPC00B="YES")
    (tmp_path / "a.tif").unlink()
    assert is_satellite(tmp_path)
    opened = read_satellite(tmp_path)
    assert opened.views["a.ntf"].kind == "NITF"
    # NITF writes scales of latitude with four decimals: 0.000675 becomes 0.0007, 3.7 % of half a picture.
    camera = cameras_of(opened.scene)[0]
    there = camera.rpc.project(sample_rpc(0).locate(CORNERS, 100.0))
    assert np.abs(there - CORNERS).max() < 7
    assert load_picture(tmp_path / "a.ntf").shape == (300, 400, 3)


# ---------------------------------------------------------------------------------------------------------- errors


def test_a_picture_without_rpc_is_named(tmp_path: Path) -> None:
    triplet(tmp_path)
    write_picture(tmp_path / "d.tif")
    with pytest.raises(
        DataError, match=r"Picture .*d\.tif has no RPC; expected one in its tags, or a file beside it"
    ):
        open_satellite(tmp_path)
    with pytest.raises(DataError, match=r"Picture .*d\.tif has no RPC"):
        open_satellite([tmp_path / "a.tif", tmp_path / "d.tif"])


def test_a_map_beside_is_left_out_with_a_warning(tmp_path: Path) -> None:
    write_map(triplet(tmp_path) / "dsm.tif")
    opened = read_satellite(tmp_path)
    assert opened.warnings == ("left out, being maps and no pictures: dsm.tif",)
    assert len(opened.scene) == 3
    with pytest.raises(DataError, match=r"dsm\.tif has no RPC"):
        read_satellite([tmp_path / "a.tif", tmp_path / "dsm.tif"])
    write_map(tmp_path / "ortho.tif", "uint8")
    with pytest.raises(DataError, match=r"ortho\.tif has no RPC"):
        read_satellite(tmp_path)


def test_views_that_do_not_overlap_are_an_error(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.tif", sample_rpc(0))
    write_picture(tmp_path / "b.tif", sample_rpc(1, place=(43.30, 5.44)))
    with pytest.raises(
        DataError, match=r"do not overlap on the ground; .*a\.tif at 43\.2600, 5\.4400, b\.tif at 43\.30"
    ):
        open_satellite(tmp_path)
    assert len(open_satellite([tmp_path / "a.tif"])) == 1


def test_a_view_of_another_place_is_named_in_a_warning(tmp_path: Path) -> None:
    triplet(tmp_path)
    write_picture(tmp_path / "far.tif", sample_rpc(9, place=(43.30, 5.44)))
    opened = read_satellite(tmp_path)
    assert opened.warnings == ("1 of 4 views do not overlap on the ground with the rest: far.tif",)
    assert len(opened.scene) == 4


def test_neighbours_hang_together_in_a_chain() -> None:
    def view(north: float, east: float = 0.0) -> RpcCamera:
        return camera(sample_rpc(0, place=(PLACE[0] + north, PLACE[1] + east), lean=(0.0, 0.0)))

    # Half a picture is 0.000675 degrees of latitude and 0.00123 of longitude.
    chain = {"a": view(0), "b": view(0.0013), "c": view(0.0026), "d": view(0.0053), "e": view(0.0053, 0.0024)}
    assert overlapping_groups(chain) == [["a", "b", "c"], ["d", "e"]]
    assert overlapping_groups({"a": view(0), "b": view(0.00136)}) == [["a"], ["b"]]


def test_footprints_meet_at_the_height_where_the_views_were_aimed() -> None:
    """Two pictures side by side at their middle height overlap above it, where their rays cross."""
    one = camera(sample_rpc(0, place=PLACE, lean=(0.5, 0.0)))
    other = camera(sample_rpc(0, place=(PLACE[0] + 0.0015, PLACE[1]), lean=(-0.5, 0.0)))
    flat = [footprint(view, 100.0) for view in (one, other)]
    assert flat[0][:, 1].max() < flat[1][:, 1].min()
    assert overlapping_groups({"a": one, "b": other}) == [["a", "b"]]


def test_ranges_of_heights_that_touch_have_their_end_in_common() -> None:
    low = sample_rpc(0, place=PLACE, lean=(0.0, 0.0))
    bottom, top = low.height_range
    high = dataclasses.replace(low, height_offset=low.height_offset + (top - bottom))
    assert high.height_range[0] == pytest.approx(top)
    assert overlapping_groups({"a": camera(low), "b": camera(high)}) == [["a", "b"]]
    beyond = dataclasses.replace(low, height_offset=low.height_offset + (top - bottom) + 1)
    assert overlapping_groups({"a": camera(low), "b": camera(beyond)}) == [["a"], ["b"]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: folder, r"No satellite pictures in .*; expected pictures .* found an empty folder"),
        (lambda folder: folder / "gone", r"Cannot read folder .*gone"),
        (lambda folder: [], r"No satellite pictures among the files"),
        (lambda folder: [folder / "a.tif"], r"a\.tif is missing; expected a picture or its RPC"),
    ],
)
def test_nothing_to_open_is_an_error(tmp_path: Path, make: object, message: str) -> None:
    with pytest.raises(DataError, match=message):
        open_satellite(make(tmp_path))


def test_an_rpc_that_belongs_to_no_picture_is_named(tmp_path: Path) -> None:
    triplet(tmp_path)
    (tmp_path / "z.RPB").write_text(rpb(sample_rpc(0)))
    with pytest.raises(DataError, match=r"z\.RPB belongs to no picture by its name; expected names like"):
        open_satellite([tmp_path / "a.tif", tmp_path / "b.tif", tmp_path / "z.RPB"])


def test_an_rpc_without_a_place_for_its_pixels_is_named(tmp_path: Path) -> None:
    whole = sample_rpc(0)
    # Lines and samples run the same way: a picture without width.
    write_picture(
        tmp_path / "a.tif", dataclasses.replace(whole, sample_num=whole.line_num, sample_den=whole.line_den)
    )
    with pytest.raises(
        DataError, match=r"The RPC of a\.tif has no footprint; found No place on the ground was found"
    ):
        open_satellite(tmp_path)


def test_a_name_that_cannot_be_stored_is_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "a\n.tif", sample_rpc(0))
    with pytest.raises(DataError, match="cannot be stored"):
        open_satellite(tmp_path)


def test_a_damaged_side_file_is_named(tmp_path: Path) -> None:
    write_picture(triplet(tmp_path) / "d.tif")
    (tmp_path / "d_RPC.TXT").write_text(rpc_txt(sample_rpc(0))[:500] + "\n")
    with pytest.raises(DataError, match=r"Cannot read LINE_NUM_COEFF in .*d_RPC\.TXT; expected 20"):
        open_satellite(tmp_path)


def test_the_sun_stands_where_its_angles_say() -> None:
    np.testing.assert_allclose(sun_direction(0, 90), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(sun_direction(0, 0), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(sun_direction(90, 123), [0, 0, 1], atol=1e-15)
    assert sun_direction(30, 180)[1] == pytest.approx(-np.cos(np.pi / 6))


# --------------------------------------------------------------------------------------------------------- capture


def test_a_satellite_folder_is_a_capture(tmp_path: Path) -> None:
    write_map(triplet(tmp_path) / "dsm.tif")
    capture = open_capture(tmp_path)
    assert capture.reference is None
    assert capture.warnings == ("left out, being maps and no pictures: dsm.tif",)
    assert [frame.split for frame in capture.scene.frames] == ["test", "train", "train"]
    assert len(capture.scene.registered) == 3
    assert len(cameras_of(capture.scene)) == 3
    with pytest.raises(CapabilityError, match="Camera 1 cannot be given to COLMAP"):
        capture.scene.to_pycolmap()


def test_a_damaged_picture_is_found_when_the_capture_is_opened(tmp_path: Path) -> None:
    path = triplet(tmp_path) / "b.tif"
    path.write_bytes(path.read_bytes()[:-500])
    assert len(open_capture(tmp_path, check=False).scene) == 3
    with pytest.raises(DataError, match=r"Picture .*b\.tif is cut off"):
        open_capture(tmp_path)


def test_a_scene_folder_of_satellites_opens_with_its_cameras(tmp_path: Path) -> None:
    scene = open_satellite(triplet(tmp_path / "a"))
    write_scene(scene, tmp_path / "b", copy_images=True)
    capture = open_capture(tmp_path / "b")
    assert len(capture.scene.registered) == 3
    assert [camera.rpc for camera in cameras_of(capture.scene)] == [camera.rpc for camera in cameras_of(scene)]
    assert capture.scene.georeference == scene.georeference
    assert capture.reference is None
    assert dict(read_scene(tmp_path / "b").cameras) == dict(scene.cameras)


def test_known_points_and_other_cameras_poses_are_the_reference_only(tmp_path: Path) -> None:
    scene = open_satellite(triplet(tmp_path / "images"))
    affine = AffineCamera(400, 300, 2.0, 0.0, 2.0, 200.0, 150.0)
    turned = dataclasses.replace(scene.frames[2], camera_id=9, cam_from_world=RigidTransform(np.eye(3), np.ones(3)))
    write_scene(scene.replace(cameras={**scene.cameras, 9: affine}, frames=(*scene.frames[:2], turned)), tmp_path)
    capture = open_capture(tmp_path)
    assert [frame.cam_from_world is not None for frame in capture.scene.frames] == [True, True, False]
    assert capture.reference is not None
    assert len(capture.reference.registered) == 3
    write_scene(scene.replace(points=Points(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))), tmp_path)
    capture = open_capture(tmp_path)
    assert capture.scene.points is None
    assert capture.reference is not None
    assert capture.reference.points is not None


def test_a_colmap_model_counts_more_than_rpcs(tmp_path: Path) -> None:
    triplet(tmp_path / "images")
    camera = ColmapCamera.pinhole(400, 300, 500.0)
    frames = tuple(Frame(name, 1, RigidTransform.identity()) for name in LEANS)
    write_colmap(Scene(tmp_path / "images", {1: camera}, frames), tmp_path / "sparse" / "0")
    (tmp_path / "images" / "a.RPB").write_text(rpb(sample_rpc(0)))
    capture = open_capture(tmp_path)
    assert capture.scene.registered == ()
    assert set(capture.scene.cameras.values()) == {camera}
    (found,) = find_captures([tmp_path])
    assert found.layout == "COLMAP"


def test_the_fingerprint_depends_on_the_cameras(tmp_path: Path) -> None:
    scene = open_satellite(triplet(tmp_path))
    cameras = {number: camera.with_correction((1.0, 0.0)) for number, camera in enumerate(cameras_of(scene), 1)}
    assert capture_fingerprint(scene) == capture_fingerprint(open_satellite(tmp_path))
    assert capture_fingerprint(scene) != capture_fingerprint(scene.replace(cameras=cameras))


def test_folders_of_photos_are_none_of_satellites(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.tif")
    assert not is_satellite(tmp_path)
    (tmp_path / "a.json").write_text('{"fov": 60}')
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    assert not is_satellite(tmp_path)
    (tmp_path / "a.json").write_text(satnerf_json(sample_rpc(0)))
    assert is_satellite(tmp_path)
    with pytest.raises(DataError, match="Cannot read folder"):
        is_satellite(tmp_path / "gone")


def test_photos_of_sixteen_bits_still_open_as_photos(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.tif")
    capture = open_capture(tmp_path)
    assert capture.scene.registered == ()
    assert len(capture.scene) == 1


def test_a_single_deep_band_is_stretched_where_an_rpc_tells_a_satellite(tmp_path: Path) -> None:
    path = write_picture(tmp_path / "a.tif")
    # 100 to 1500 of 65535.
    assert load_picture(path).max() <= 6
    (tmp_path / "a.RPB").write_text(rpb(sample_rpc(0)))
    assert (load_picture(path).min(), load_picture(path).max()) == (0, 255)


def test_an_rpc_file_beside_the_picture_counts_most_and_one_for_two_of_a_name_is_refused(tmp_path: Path) -> None:
    inner = [write_picture(tmp_path / folder / "a.tif", seed=i) for i, folder in enumerate(("one", "two"))]
    listed = tmp_path / "rpc" / "a.RPB"
    listed.parent.mkdir()
    listed.write_text(rpb(sample_rpc(0, place=PLACE)))
    with pytest.raises(DataError, match=r"a\.RPB fits two pictures by its name; expected an RPC file for each"):
        read_satellite([*inner, listed])
    mine = sample_rpc(1, place=PLACE)
    (tmp_path / "one" / "a.RPB").write_text(rpb(mine))
    views = read_satellite([*inner, listed]).views
    assert views["one/a.tif"].rpc == mine
    assert views["two/a.tif"].rpc == sample_rpc(0, place=PLACE)


def test_a_satellite_folder_is_told_by_the_names_in_it(tmp_path: Path) -> None:
    for folder, names in {
        "rpb": ("a.tif", "a.RPB"),
        "text": ("a.TIF", "A_rpc.txt"),
        "dimap": ("IMG_x_R1C1.TIF", "RPC_x.XML"),
        "nitf": ("a.NTF", "notes.txt"),
        "inner": ("images/a.tif", "images/a.geom"),
        "photos": ("a.tif", "a.json", "b_RPC.TXT"),
    }.items():
        for name in names:
            (tmp_path / folder / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / folder / name).write_bytes(b"")
    found = {capture.label: (capture.layout, capture.photos) for capture in find_captures([tmp_path])}
    assert found == {
        "rpb": ("satellite", 1),
        "text": ("satellite", 1),
        "dimap": ("satellite", 1),
        "nitf": ("satellite", 1),
        "inner": ("satellite", 1),
        "photos": ("photos", 1),
    }


# ------------------------------------------------------------------------------------------------------ real files


@pytest.mark.real
def test_the_real_triplet_opens(real_data: Path) -> None:
    folder = real_data / "sat_pleiades_s2p" / "triplet"
    capture = open_capture(folder)
    assert capture.warnings == ("left out, being maps and no pictures: expected_dsm.tif",)
    assert [frame.name for frame in capture.scene.frames] == ["img_01.tif", "img_02.tif", "img_03.tif"]
    origin = capture.scene.georeference
    assert origin is not None
    # The README: near 43.262 N 5.443 E.
    assert (round(origin.latitude, 2), round(origin.longitude, 2)) == (43.26, 5.44)
    for frame, camera in zip(capture.scene.frames, cameras_of(capture.scene), strict=True):
        pixels = np.array([[100.5, 200.5], [900.25, 800.75]])
        points = camera.locate(pixels, np.array([100.0, 250.0]))
        # Within a kilometre of the origin, and back where they came from.
        assert np.linalg.norm(points[:, :2], axis=1).max() < 1000
        np.testing.assert_allclose(camera.project(points), pixels, rtol=0, atol=1e-6)
        assert read_raster(capture.scene.image_path(frame)).valid.all()


@pytest.mark.real
def test_a_real_pair_with_files_elsewhere_opens(real_data: Path) -> None:
    folder = real_data / "sat_rpc_shareloc"
    pictures = sorted((folder / "image" / "phr_ventoux").glob("*.tif"))
    geoms = sorted((folder / "rpc" / "phr_ventoux").glob("*.geom"))
    opened = read_satellite([*pictures, *geoms])
    assert opened.warnings == ()
    # Parts at (5000, 5000) and (4915, 5162) of the whole pictures, 33 seconds apart.
    assert opened.views["left_image.tif"].rpc.sample_offset == 19207.5 - 5000
    assert opened.views["right_image.tif"].rpc.line_offset == 20417.5 - 5162
    assert opened.scene.frames[1].time == pytest.approx(32.9, abs=0.1)
    left, right = cameras_of(opened.scene)
    # 466 m by SRTM and 51 m of geoid; (200.5, 63.5) is where correlating the two pictures finds the place. Five
    # pixels are some metres of height.
    place = left.locate([[120.5, 380.5]], 517.0)
    np.testing.assert_allclose(right.project(place), [[200.5, 63.5]], rtol=0, atol=6)
    assert abs(right.project(place)[0, 1] - 63.5) < 0.5
    with pytest.raises(DataError, match=r"left_image\.tif has no RPC"):
        read_satellite(pictures)


@pytest.mark.real
def test_two_real_pictures_of_different_places_are_an_error(real_data: Path) -> None:
    with pytest.raises(
        DataError, match=r"do not overlap on the ground; .*wv3_20\.NTF at -34\.5043, -58\.6024, wv3_30"
    ):
        open_satellite(real_data / "sat_rpc_shareloc" / "rpc")


def test_the_summary_of_a_satellite_folder_asks_for_no_gps(tmp_path: Path) -> None:
    capture = open_capture(triplet(tmp_path / "views"))
    facts = [photo_facts(frame.name, capture.scene.image_path(frame)) for frame in capture.scene.frames]
    assert all(fact.damage == "" and fact.width > 0 for fact in facts)
    assert not any("GPS" in text for text in summary_warnings(capture, facts))
    small = Thumbnails(tmp_path / "small").of(capture.scene.image_path(capture.scene.frames[0]), 16)
    # 16-bit numbers use the whole range of greys.
    assert 0.2 < small.brightness < 0.8
