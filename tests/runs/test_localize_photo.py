"""Photos localised in a run's map: which photos and starts there are, what comes of them, and what is kept."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from ground_run import NAMES, POSES, TESTS, UNPOSED, make_ground_run
from PIL import Image
from splat_ground import CAMERA, down

from toolkit.errors import Cancelled, CapabilityError, DataError, RunError, SettingsError
from toolkit.files import read_json, write_json
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.settings import SequenceSettings
from toolkit.metrics.localization import pose_errors
from toolkit.progress import ProgressEvent
from toolkit.runs.folder import RunFolder
from toolkit.runs.localize_photo import PhotoLocalizer, feature_choices, method_settings, run_scene
from toolkit.runs.localize_work import LocalizeProcess, LocalizeWork, PhotoRequest, shared_localizer
from toolkit.runs.photo_query import file_photo, frame_photo
from toolkit.runs.photo_results import list_results, photo_file, read_photo_result, write_photo_result
from toolkit.runs.photo_start import StartChoice, parse_start, photo_start
from toolkit.runs.pose_pictures import pose_pictures
from toolkit.scene import Scene
from toolkit.scene.pictures import load_picture

QUICK = ("polish.use=false", "fan.most=3")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return make_ground_run(tmp_path_factory.mktemp("ground"))


@pytest.fixture(scope="module")
def scene(run: RunFolder) -> Scene:
    return run_scene(run)


@pytest.fixture(scope="module")
def localizer(run: RunFolder) -> PhotoLocalizer:
    return PhotoLocalizer(run, method_settings("ours", changes=QUICK))


@pytest.fixture
def clean(run: RunFolder) -> Iterator[RunFolder]:
    """Yield the run, in which nothing was localised, and leave it so."""
    yield run
    for file in (run.artifacts / "localize").rglob("*"):
        if file.is_file():
            file.unlink()


def test_a_photo_is_found_from_metres_off_and_kept(clean: RunFolder, localizer: PhotoLocalizer) -> None:
    photo = frame_photo(localizer.scene, TESTS[0])
    start = photo_start(localizer.scene, photo, StartChoice("own", metres=4.0, degrees=6.0), seed=3)
    heard: list[ProgressEvent] = []
    done = localizer.localize(photo, start, progress=heard.append)
    assert done.errors is not None
    assert done.start_errors == pytest.approx((4.0, 6.0))
    # Photos are the map's own renders, as 8-bit pictures.
    assert done.errors[0] < 0.03
    assert done.method == "ours"
    assert done.seconds > 0
    assert [event.message for event in heard[:3]] == ["photo", "render 1", "matching render 1"]

    path = write_photo_result(clean, done)
    assert path == clean.artifacts / "localize" / "photos" / f"{TESTS[0]}.json"
    content = read_json(path)
    assert content["error_m"] == done.errors[0]
    assert content["settings"]["polish"]["use"] is False
    assert content["found"] is True
    again = read_photo_result(path)
    assert again.cam_from_world is not None
    assert pose_errors(again.cam_from_world, POSES[4])[0] == pytest.approx(done.errors[0])
    assert (again.inliers, again.matches, again.rounds) == (
        done.found.inliers,
        done.found.matches,
        done.found.rounds,
    )
    assert again.start is not None
    assert pose_errors(again.start, POSES[4]) == pytest.approx((4.0, 6.0))
    assert again.start_sigmas == pytest.approx((4.0 / 3**0.5, 6.0 / 3**0.5))

    pictures = pose_pictures(localizer.splat_map, localizer.scene, again)
    # From the right pose the render is the photo, and what was matched lies in the same pixels.
    assert np.abs(pictures.photo.astype(int) - pictures.render).mean() < 5
    assert 20 <= pictures.inside.sum() <= 200
    off = np.linalg.norm(pictures.photo_pixels - pictures.render_pixels, axis=1)
    assert np.median(off[pictures.inside]) < 0.5
    assert pictures.distance == pytest.approx(40.0, abs=2.0)
    assert pictures.metric


def test_a_photo_that_is_lost_is_kept_with_its_reason(clean: RunFolder, localizer: PhotoLocalizer) -> None:
    black = frame_photo(localizer.scene, NAMES[0])
    empty = dataclasses.replace(black.query, picture=np.zeros_like(black.query.picture))
    photo = dataclasses.replace(black, query=empty)
    done = localizer.localize(photo, photo_start(localizer.scene, photo, StartChoice("own")))
    assert done.errors is None
    stored = read_photo_result(write_photo_result(clean, done))
    assert not stored
    assert "matches agree" in stored.reason
    pictures = pose_pictures(localizer.splat_map, localizer.scene, stored)
    assert len(pictures.inside) == 0


def test_a_picture_file_is_a_photo_of_the_camera_of_its_size(
    clean: RunFolder, localizer: PhotoLocalizer, tmp_path: Path
) -> None:
    mine = tmp_path / "my photo.png"
    Image.open(localizer.scene.image_dir / UNPOSED).save(mine)
    photo = file_photo(localizer.scene, mine)
    assert (photo.query.name, photo.truth, photo.prior, photo.frame) == ("my photo.png", None, None, False)
    start = photo_start(localizer.scene, photo, parse_start("2,1,42,5,-88", 3.0, 4.0))
    done = localizer.localize(photo, start)
    assert done.found.cam_from_world is not None
    assert pose_errors(done.found.cam_from_world, POSES[6])[0] < 0.05
    assert done.errors is None
    path = write_photo_result(clean, done)
    assert re.fullmatch(r"file=my_photo_png-[0-9a-f]{8}\.json", path.name)
    mine.unlink()
    stored = read_photo_result(path)
    assert stored.picture == path.with_suffix(".jpg")
    pictures = pose_pictures(localizer.splat_map, localizer.scene, stored)
    assert pictures.photo.shape == (180, 240, 3)
    assert pictures.truth is None


def test_pictures_of_other_sizes_are_refused_with_those_that_fit(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "large.png"
    Image.new("RGB", (100, 50)).save(path)
    with pytest.raises(
        DataError, match=r"No camera .* took large\.png; expected a picture of 240x180 pixels; found 100x50"
    ):
        file_photo(scene, path)
    with pytest.raises(DataError, match="is missing"):
        file_photo(scene, tmp_path / "nothing.jpg")
    path.write_bytes(b"no picture")
    with pytest.raises(DataError, match="is no picture"):
        file_photo(scene, path)
    Image.new("RGB", (240, 180)).save(path)
    flat = scene.replace(cameras={1: AffineCamera(240, 180, 8.0, 0.0, 8.0, 120.0, 90.0)})
    with pytest.raises(CapabilityError, match="No photo can be localised in this scene.*found AffineCamera"):
        file_photo(flat, path)
    with pytest.raises(DataError, match="No frame 'x' in the scene"):
        frame_photo(scene, "x")


def test_of_several_cameras_the_one_of_most_frames_counts(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("RGB", (240, 180)).save(path)
    other = CAMERA.pinhole(240, 180, 150.0)
    frames = tuple(
        dataclasses.replace(frame, camera_id=2 if number < 4 else 1) for number, frame in enumerate(scene.frames)
    )
    both = scene.replace(cameras={1: scene.cameras[1], 2: other, 3: other}, frames=frames)
    assert file_photo(both, path).query.camera is other


def test_sensors_say_where_a_photo_was_taken(scene: Scene) -> None:
    for name in (TESTS[0], NAMES[1], UNPOSED):
        photo = frame_photo(scene, name)
        start = photo_start(scene, photo, StartChoice("prior"))
        assert start.name == name
        metres, degrees = pose_errors(start.cam_from_world, POSES[NAMES.index(name)])
        assert 0.1 < metres < 6.0  # a metre on each axis
        assert degrees < 6.0
        assert start.position_sigma >= 1.0
    without = dataclasses.replace(frame_photo(scene, TESTS[0]), prior=None)
    with pytest.raises(DataError, match="has no start by sensors; .* found neither. Give a start pose"):
        photo_start(scene, without, StartChoice("prior"))
    bare = scene.replace(frames=tuple(dataclasses.replace(frame, prior=None) for frame in scene.frames))
    with pytest.raises(DataError, match="No map frame has an attitude by sensors"):
        photo_start(bare, frame_photo(scene, TESTS[0]), StartChoice("prior"))


def test_a_photo_without_a_pose_cannot_begin_there(scene: Scene) -> None:
    with pytest.raises(DataError, match=f"Photo '{UNPOSED}' has no pose of its own"):
        photo_start(scene, frame_photo(scene, UNPOSED), StartChoice("own"))
    exact = photo_start(scene, frame_photo(scene, TESTS[0]), StartChoice("own"))
    assert pose_errors(exact.cam_from_world, POSES[4])[0] < 1e-9
    with pytest.raises(SettingsError, match="cannot be off by so much"):
        photo_start(scene, frame_photo(scene, TESTS[0]), StartChoice("own", metres=-1.0))


def test_starts_are_read_from_texts() -> None:
    said = parse_start("1,2,40,0,-90", 2.0, 3.0)
    assert said.pose is not None
    # North up, straight down.
    np.testing.assert_allclose(said.pose.matrix, down(1.0, 2.0).matrix, atol=1e-12)
    assert (said.position_sigma, said.rotation_sigma_deg) == (2.0, 3.0)
    assert parse_start("prior", 1.0, 1.0).kind == "prior"
    for wrong in ("", "1,2,3", "1,2,3,4,x", "1,2,3,4,nan", "here"):
        with pytest.raises(SettingsError, match="The start cannot be read; expected prior, own, or five numbers"):
            parse_start(wrong, 1.0, 1.0)
    with pytest.raises(SettingsError, match="There is no start pose"):
        StartChoice("pose")
    with pytest.raises(SettingsError, match="standard deviation of the position cannot be used"):
        StartChoice("pose", pose=down(), position_sigma=-1.0)
    with pytest.raises(SettingsError, match="standard deviation of the rotation cannot be used"):
        StartChoice("pose", pose=down(), rotation_sigma_deg=float("nan"))


def test_methods_are_chosen_by_name() -> None:
    assert method_settings("one-shot", features="disk-lightglue", changes=["render_side=500"]).render_side == 500
    assert {"sift", "aliked-lightglue"} <= set(feature_choices())
    with pytest.raises(SettingsError, match="Unknown method 'both'; expected one of ours, one-shot"):
        method_settings("both")
    with pytest.raises(SettingsError, match="Unknown setting 'x'"):
        method_settings("ours", changes=["x=1"])


def test_a_flight_is_followed_in_order_of_its_times(localizer: PhotoLocalizer) -> None:
    photos = [frame_photo(localizer.scene, name) for name in (NAMES[2], NAMES[0], NAMES[1])]
    start = photo_start(localizer.scene, photos[1], StartChoice("own", metres=2.0))
    # They lie on the corners of a square: no drone turns like this.
    agile = SequenceSettings().replace({"speed": 15.0, "acceleration": 20.0, "angular_acceleration": 60.0})
    done = localizer.localize_flight(photos, start, agile)
    assert [one.photo.query.name for one in done] == list(NAMES[:3])
    assert all(one.errors is not None and one.errors[0] < 0.1 for one in done)
    untimed = dataclasses.replace(photos[0], time=None)
    with pytest.raises(DataError, match=f"Photo '{NAMES[2]}' has no time"):
        localizer.localize_flight([untimed], start, SequenceSettings())


def test_the_one_shot_follows_no_flight(run: RunFolder, localizer: PhotoLocalizer) -> None:
    once = PhotoLocalizer(run, method_settings("one-shot", features="sift"), splat_map=localizer.splat_map)
    photo = frame_photo(once.scene, TESTS[0])
    start = photo_start(once.scene, photo, StartChoice("own", metres=2.0))
    done = once.localize(photo, start)
    assert (done.method, done.found.rounds) == ("one-shot-sift", 1)
    with pytest.raises(SettingsError, match="The one shot cannot follow a flight; expected the method ours"):
        once.localize_flight([photo], start, SequenceSettings())


def test_results_are_listed_with_the_recipes_own_and_damaged_ones_say_so(
    clean: RunFolder, localizer: PhotoLocalizer
) -> None:
    photo = frame_photo(localizer.scene, TESTS[1])
    done = localizer.localize(photo, photo_start(localizer.scene, photo, StartChoice("own")))
    write_photo_result(clean, done)
    folder = clean.artifacts / "localize"
    row = {**done.found.to_dict(), "start": done.start.cam_from_world.matrix[:3].tolist()}
    lost = {**row, "found": False, "cam_from_world": None, "reason": "black"}
    batch = {"scenario": "sfm-test", "measures": {}, "method": "ours", "queries": [row, lost]}
    write_json(folder / "ours.sfm-test.json", batch)
    before = (folder / "ours.sfm-test.json").read_bytes()
    files = list_results(clean)
    assert [(file.label, len(file.poses), file.error) for file in files] == [
        ("ours.sfm-test", 2, ""),
        (f"photos/{TESTS[1]}", 1, ""),
    ]
    assert [bool(pose) for pose in files[0].poses] == [True, False]
    assert files[0].poses[1].reason == "black"
    assert files[0].poses[0].method == "ours"
    write_photo_result(clean, done)
    assert (folder / "ours.sfm-test.json").read_bytes() == before

    good = read_json(folder / "photos" / f"{TESTS[1]}.json")
    for name, damage, told in (
        ("cut", None, "Cannot read"),
        ("list", [], "expected a table; found list"),
        ("new", {**good, "schema": 2}, "expected schema 1; found 2"),
        ("short", {"schema": 1, "name": "x"}, "found 'cam_from_world'"),
        ("nameless", {**good, "name": 3}, "expected a name of every photo; found 3"),
        ("bent", {**good, "cam_from_world": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "no rotation"),
        ("nan", {**good, "position_sigma": [1, 2]}, "2 standard deviations"),
        ("odd", {**good, "lines": {**good["lines"], "inside": [True]}}, "matches that do not correspond"),
        ("out", {**good, "picture": "../../../../../etc/passwd"}, "expected the picture out.jpg"),
    ):
        path = folder / "photos" / f"{name}.json"
        path.write_text("{" if damage is None else json.dumps(damage))
        (listed,) = [file for file in list_results(clean) if file.path == path]
        assert told in listed.error, name
        assert listed.poses == ()
        path.unlink()
    write_json(folder / "batch.json", {"method": "ours", "queries": 3})
    assert "expected a list of queries; found int" in list_results(clean)[0].error


def test_names_that_cannot_be_files_get_another(run: RunFolder) -> None:
    folder = run.artifacts / "localize" / "photos"
    for name in ("../../x.jpg", "a/b.jpg", "a" * 300, "..", "ä.jpg", "a..b"):
        path = photo_file(run, name, frame=True)
        assert path.parent == folder
        assert re.fullmatch(r"[A-Za-z0-9_-]+\.json", path.name)
    assert photo_file(run, "a/b.jpg", frame=True) != photo_file(run, "a_b.jpg", frame=True)
    assert photo_file(run, "a.jpg", frame=True) != photo_file(run, "a.jpg", frame=False)


def test_what_is_gone_cannot_be_drawn(clean: RunFolder, localizer: PhotoLocalizer) -> None:
    photo = frame_photo(localizer.scene, TESTS[0])
    done = localizer.localize(photo, photo_start(localizer.scene, photo, StartChoice("own")))
    stored = read_photo_result(write_photo_result(clean, done))
    nowhere = dataclasses.replace(stored, cam_from_world=None, start=None, lines=None)
    with pytest.raises(DataError, match="Nothing is known of where"):
        pose_pictures(localizer.splat_map, localizer.scene, nowhere)
    with pytest.raises(DataError, match="No frame 'x' in the scene"):
        pose_pictures(localizer.splat_map, localizer.scene, dataclasses.replace(stored, name="x"))
    flat = localizer.scene.replace(cameras={1: AffineCamera(240, 180, 8.0, 0.0, 8.0, 120.0, 90.0)})
    with pytest.raises(CapabilityError, match="cannot be drawn; expected a camera of COLMAP's; found AffineCamera"):
        pose_pictures(localizer.splat_map, flat, stored)


def request(run: RunFolder, name: str = TESTS[0], **changes: object) -> PhotoRequest:
    asked = PhotoRequest(run, name, StartChoice("own", metres=3.0, degrees=3.0), "one-shot", "sift")
    return dataclasses.replace(asked, **changes)


def test_pages_ask_another_process_which_tells_and_can_be_cancelled(clean: RunFolder) -> None:
    process = LocalizeProcess()
    heard: list[str] = []
    try:
        answer = process.localize(request(clean), lambda event: heard.append(event.message))
        assert answer.errors is not None
        assert answer.errors[0] < 0.5
        assert answer.start_errors == pytest.approx((3.0, 3.0))
        assert answer.file == photo_file(clean, TESTS[0], frame=True)
        assert heard[0] == "waiting"
        assert process._call(os.getpid) != os.getpid()
        looked = process.look(clean, answer.pose)
        np.testing.assert_array_equal(looked.pictures.render, answer.pictures.render)
        assert looked.errors == pytest.approx(answer.errors)

        def cancel(event: ProgressEvent) -> None:
            raise Cancelled("Cancelled by a listener")

        with pytest.raises(Cancelled, match="by a listener"):
            process.localize(request(clean, TESTS[1]), cancel)
        with pytest.raises(DataError, match="No frame 'x' in the scene"):
            process.localize(request(clean, "x"))
    finally:
        process.close()
    assert shared_localizer() is shared_localizer()


def test_this_process_does_the_same(clean: RunFolder, tmp_path: Path) -> None:
    work = LocalizeWork()
    sent = tmp_path / "sent"
    Image.fromarray(load_picture(run_scene(clean).image_dir / UNPOSED)).save(sent, "PNG")
    pose = RigidTransform(POSES[6].rotation, POSES[6].translation + 0.5)
    answer = work.localize(request(clean, "mine.png", picture=sent, start=StartChoice("pose", pose=pose)))
    assert answer.errors is None
    assert answer.pose.name == "mine.png"
    assert answer.pose.picture is not None
    assert answer.pose.picture.is_file()
    with pytest.raises(RunError, match="has no splat"):
        work.localize(request(RunFolder(tmp_path)))
