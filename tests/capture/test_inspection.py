"""An inspection video becomes a scene: cropped, without its stop, masked, with the numbers of the video."""

from __future__ import annotations

import dataclasses
import json
import shutil
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.ndimage import binary_dilation
from turning import HEIGHT, LEFT, TOP, WIDTH, Footage, overlap

from toolkit.capture.borders import Rectangle
from toolkit.capture.inspection import RECORD_FILE, Inspection, InspectionSettings, open_inspection
from toolkit.capture.sources import frame_source, resample
from toolkit.errors import Cancelled, DataError, RunError, SettingsError, StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.features import SiftSettings, extract_sift
from toolkit.progress import ProgressEvent
from toolkit.scene import Frame, Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.pictures import load_picture

pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")
pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'sightline-toolkit[video]'")

FOOTAGE = Footage((2.3,) * 40 + (0.0,) * 20 + (2.3,) * 40)
CROP = Rectangle(LEFT, TOP, 160, 120)
DEFAULT = InspectionSettings()


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return FOOTAGE.video(tmp_path_factory.mktemp("inspection") / "clip.mp4")


@pytest.fixture(scope="module")
def made(clip: Path) -> Inspection:
    return open_inspection(clip, clip.parent / "scene", DEFAULT)


def pictures(folder: Path, footage: Footage) -> Path:
    """Write the frames as PNG files and return the folder."""
    folder.mkdir()
    for number, frame in enumerate(footage.frames()):
        Image.fromarray(frame).save(folder / f"{number}.png")
    return folder


# ---------------------------------------------------------------------------------------- what is made


def test_the_video_is_cropped_masked_and_rid_of_its_stop(made: Inspection, clip: Path) -> None:
    folder = clip.parent / "scene"
    assert made.rectangle == CROP
    assert made.stills is not None
    (stop,) = made.stills.stops
    assert (stop.first, stop.last) == (41, 60)
    assert made.numbers.tolist() == [*range(41), *range(61, 101)]
    truth = CROP.cut(FOOTAGE.truth)
    assert overlap(made.mask, truth)[0] > 0.99
    assert overlap(made.mask, binary_dilation(truth, iterations=10))[1] > 0.99
    scene = open_capture(folder).scene
    assert [frame.name for frame in scene.frames[39:43]] == [f"frame_{i:06d}.jpg" for i in (39, 40, 61, 62)]
    np.testing.assert_allclose([frame.time for frame in scene.frames], made.numbers / 30, atol=1e-3)
    assert {(camera.width, camera.height) for camera in scene.cameras.values()} == {(160, 120)}
    picture = load_picture(scene.image_path(scene.frames[5]))
    truly = CROP.cut(list(FOOTAGE.frames())[5]).astype(float)
    # Noise of 2 levels is in both, and two compressions.
    assert np.abs(picture[..., 0] - truly).mean() < 4
    assert not made.warnings


def test_each_frame_has_the_mask_and_no_feature_lies_under_it(made: Inspection, tmp_path: Path) -> None:
    scene = made.scene.replace(frames=made.scene.frames[::20])
    for frame in scene.frames:
        path = scene.mask_path(frame)
        assert path is not None
        np.testing.assert_array_equal(load_picture(path)[..., 0] == 0, made.mask)
    settings = SiftSettings(max_features=500)
    extract_sift(scene.replace(mask_dir=None), tmp_path / "free.db", settings)
    extract_sift(scene, tmp_path / "masked.db", settings)
    hits = {}
    for name in ("free", "masked"):
        with closing(pycolmap.Database.open(tmp_path / f"{name}.db")) as database:
            points = np.concatenate([database.read_keypoints(i + 1)[:, :2] for i in range(len(scene))])
        column, row = np.floor(points).astype(int).T
        hits[name] = int(made.mask[row, column].sum())
        assert len(points) > 100
    assert hits["free"] > 10
    assert hits["masked"] == 0


def test_the_record_says_what_was_done_in_numbers_of_the_video(made: Inspection, clip: Path) -> None:
    record = json.loads((clip.parent / "scene" / RECORD_FILE).read_text())
    assert record["source"] == "clip.mp4"
    assert record["crop"] == [LEFT, TOP, 160, 120]
    assert record["numbers"] == made.numbers.tolist()
    assert record["stills"]["stops"][0] == {"kept": 40, "first": 41, "last": 60, "frames": 20} | {
        "motion_px": record["stills"]["stops"][0]["motion_px"]
    }
    assert InspectionSettings.from_dict(record["settings"]).to_dict() == DEFAULT.to_dict()
    again = dict(record)
    assert again.pop("source")
    assert again.pop("settings")
    assert again == json.loads(json.dumps(made.to_dict()))


def test_frames_come_at_the_rate_asked_for(clip: Path, tmp_path: Path) -> None:
    made = open_inspection(clip, tmp_path / "slow", DEFAULT.replace({"rate": 10.0, "stills.remove": False}))
    assert made.numbers.tolist() == list(range(0, 101, 3))
    assert made.stills is None
    fast = open_inspection(clip, tmp_path / "fast", DEFAULT.replace({"rate": 60.0, "find_static": False}))
    assert len(fast.sampled) == 101
    assert fast.static is None
    assert not fast.mask.any()
    assert fast.scene.mask_dir is None
    assert fast.warnings == ("the video has 30 frames a second, fewer than the 60 asked for: all 101 were taken",)
    slow_stop = DEFAULT.replace({"rate": 15.0, "stills.least_frames": 6})
    stop = open_inspection(clip, tmp_path / "half", slow_stop).to_dict()["stills"]["stops"][0]
    assert (stop["kept"], stop["first"], stop["last"], stop["frames"]) == (40, 42, 60, 10)


def test_the_nearest_frame_is_taken_for_each_time() -> None:
    times = np.array([0.0, 0.1, 0.15, 0.7, 0.705, 1.0])
    assert resample(times, 0.0).tolist() == [0, 1, 2, 3, 4, 5]
    assert resample(times, 5.0).tolist() == [0, 2, 3, 4, 5]
    assert resample(times, 2.0).tolist() == [0, 3, 5]
    assert resample(np.arange(100) / 30, 30.0).tolist() == list(range(100))
    assert resample(np.arange(100) / 29.97, 30.0).tolist() == list(range(100))
    assert resample(np.zeros(1), 30.0).tolist() == [0]


def test_the_corners_about_a_round_picture_are_masked(tmp_path: Path) -> None:
    footage = Footage((2.3,) * 40, round=True, static=False)
    made = open_inspection(pictures(tmp_path / "in", footage), tmp_path / "out", DEFAULT)
    assert made.borders.round
    outside = made.rectangle.cut(~footage.inside)
    assert made.mask[outside].mean() > 0.99
    # Grown by 6 px; the round picture has a radius of 58.
    assert 0.7 < (~made.mask).sum() / (np.pi * 52**2) < 1.1


def test_a_known_camera_is_cropped_with_the_picture(clip: Path, tmp_path: Path) -> None:
    whole = ColmapCamera("OPENCV_FISHEYE", WIDTH, HEIGHT, (150.0, 151.0, 96.0, 72.0, 0.1, 0.01, 0.0, 0.0), True)
    made = open_inspection(clip, tmp_path / "out", DEFAULT, camera=whole)
    camera = made.scene.cameras[1]
    assert camera == ColmapCamera("OPENCV_FISHEYE", 160, 120, (150.0, 151.0, 80.0, 60.0, 0.1, 0.01, 0.0, 0.0))
    point = np.array([[0.1, -0.2, 1.0]])
    np.testing.assert_allclose(camera.project(point) + np.array([LEFT, TOP]), whole.project(point), atol=1e-9)
    with pytest.raises(DataError, match="camera does not fit the video; expected 192 x 144 px; found 160 x 120 px"):
        open_inspection(clip, tmp_path / "other", DEFAULT, camera=camera)


def test_a_mask_of_the_users_takes_the_place_of_what_would_be_found(clip: Path, tmp_path: Path) -> None:
    mask = np.full((120, 160), 255, dtype=np.uint8)
    mask[:, :30] = 0
    Image.fromarray(mask).save(tmp_path / "cropped.png")
    Image.fromarray(np.pad(mask, ((TOP, TOP), (LEFT, LEFT)))).save(tmp_path / "whole.png")
    for name in ("cropped", "whole"):
        made = open_inspection(clip, tmp_path / name, DEFAULT, mask=tmp_path / f"{name}.png")
        np.testing.assert_array_equal(made.mask, mask == 0)
        assert made.static is None


# ---------------------------------------------------------------------------------------- folders


def test_a_folder_of_pictures_is_read_in_natural_order(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "in", FOOTAGE)
    source = frame_source(folder, 10.0)
    assert source.pictures is not None
    assert [path.name for path in source.pictures[:11]] == [f"{i}.png" for i in range(11)]
    assert source.times == pytest.approx(np.arange(101) / 10)
    made = open_inspection(folder, tmp_path / "out", DEFAULT.replace({"folder_rate": 10.0, "rate": 0.0}))
    assert made.numbers.tolist() == [*range(41), *range(61, 101)]
    assert made.scene.frames[-1].time == pytest.approx(10.0)
    picture = load_picture(made.scene.image_path(made.scene.frames[0]))
    assert np.abs(picture[..., 0].astype(float) - CROP.cut(next(FOOTAGE.frames()))).mean() < 2


def test_a_scene_folder_keeps_its_order_and_times(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "in", Footage((2.0,) * 11))
    names = [f"{i}.png" for i in (3, 1, 2)]
    times = (5.0, 5.5, 7.0)
    frames = tuple(Frame(name, 1, time=time) for name, time in zip(names, times, strict=True))
    scene = Scene(folder, {1: ColmapCamera.pinhole(WIDTH, HEIGHT, 100.0)}, frames)
    write_scene(scene, tmp_path / "scene")
    source = frame_source(tmp_path / "scene")
    assert source.times == (0.0, 0.5, 2.0)
    assert [frame.number for frame in source.frames([0, 2])] == [0, 2]
    back = tuple(dataclasses.replace(frame, time=-frame.time) for frame in frames if frame.time is not None)
    write_scene(scene.replace(frames=back), tmp_path / "back")
    with pytest.raises(DataError, match="times of .* do not increase.*set folder_rate"):
        frame_source(tmp_path / "back")
    assert frame_source(tmp_path / "back", 4.0).times == (0.0, 0.25, 0.5)


# ---------------------------------------------------------------------------------------- bad input


def test_a_video_that_ends_early_says_how_far_it_could_be_read(clip: Path, tmp_path: Path) -> None:
    data = clip.read_bytes()
    # The index comes first, so that the file opens; its pictures end before it says so.
    av = pytest.importorskip("av")
    with (
        av.open(str(clip)) as old,
        av.open(str(tmp_path / "fast.mp4"), "w", options={"movflags": "faststart"}) as new,
    ):
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(old.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)
    whole = (tmp_path / "fast.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(data) // 2])
    with pytest.raises(DataError, match=r"cut off or damaged: \d+ of 101 frames could be read.*Copy it again"):
        open_inspection(tmp_path / "cut.mp4", tmp_path / "out", DEFAULT)
    assert not (tmp_path / "out").exists()


def test_a_video_without_motion_is_told(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "in", Footage((0.0,) * 30))
    for settings in (DEFAULT, DEFAULT.replace({"find_static": False})):
        with pytest.raises(StageError, match="Nothing moves in the video; expected .*; found .*right part"):
            open_inspection(folder, tmp_path / "out", settings)
    kept = open_inspection(
        folder, tmp_path / "out", DEFAULT.replace({"find_static": False, "stills.remove": False})
    )
    assert len(kept.numbers) == 31


def test_bad_masks_crops_and_frames_are_refused(clip: Path, tmp_path: Path) -> None:
    def refuse(error: type[Exception], said: str, source: Path = clip, **given: object) -> None:
        settings = given.pop("settings", DEFAULT)
        with pytest.raises(error, match=said):
            open_inspection(source, tmp_path / "out", settings, **given)
        assert not (tmp_path / "out").exists()

    Image.new("L", (160, 120), 0).save(tmp_path / "black.png")
    refuse(DataError, r"black\.png is black everywhere.*Invert it", mask=tmp_path / "black.png")
    outside = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    outside[TOP : HEIGHT - TOP, LEFT : WIDTH - LEFT] = 0
    Image.fromarray(outside).save(tmp_path / "outside.png")
    refuse(DataError, r"outside\.png, cropped, is black everywhere", mask=tmp_path / "outside.png")
    Image.new("L", (100, 120), 255).save(tmp_path / "small.png")
    refuse(DataError, "another size than the pictures; expected 160x120", mask=tmp_path / "small.png")
    refuse(SettingsError, "Nothing of 480 x 360", settings=DEFAULT.replace({"crop.width": 480, "crop.height": 360}))
    refuse(SettingsError, "'folder_rate' has no effect", settings=DEFAULT.replace({"folder_rate": 5.0}))
    refuse(DataError, "Unknown camera model 'HAND'", settings=DEFAULT.replace({"camera_model": "HAND"}))
    refuse(DataError, "is missing", source=tmp_path / "none.mp4")
    folder = pictures(tmp_path / "in", Footage((2.3,) * 20))
    Image.new("L", (90, 70), 99).save(folder / "7.png")
    refuse(DataError, "Frame 7 .* is not like the first", source=folder)
    first = shutil.copytree(folder, tmp_path / "one")
    for path in first.iterdir():
        if path.name != "0.png":
            path.unlink()
    refuse(DataError, "expected at least 2 frames; found 1", source=first)


def test_a_frame_of_another_size_that_no_statistic_saw_is_refused(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "in", Footage((2.3,) * 30))
    settings = DEFAULT.replace({"temporal.frames": 10, "stills.remove": False})
    seen = {0, 30}
    from toolkit.capture.temporal import sampled_numbers

    odd = next(i for i in range(31) if i not in seen | set(sampled_numbers(31, 10, 0)))
    Image.new("L", (90, 70), 99).save(folder / f"{odd}.png")
    with pytest.raises(DataError, match=f"Frame {odd} has another size than the first; expected a crop of 160x120"):
        open_inspection(folder, tmp_path / "out", settings)


def test_much_masked_is_told_and_a_full_folder_and_cancelling_leave_nothing(clip: Path, tmp_path: Path) -> None:
    mask = np.zeros((120, 160), dtype=np.uint8)
    mask[:, :40] = 255
    Image.fromarray(mask).save(tmp_path / "most.png")
    made = open_inspection(clip, tmp_path / "most", DEFAULT, mask=tmp_path / "most.png")
    assert made.warnings == ("75 % of the picture are masked: look at mask.png, and mend it by hand",)
    with pytest.raises(RunError, match="is in the way"):
        open_inspection(clip, tmp_path / "most", DEFAULT)

    for stage in ("statistics", "stills", "frames", "masks"):

        def stop(event: ProgressEvent, stage: str = stage) -> None:
            if event.stage == stage and event.done == 2:
                raise Cancelled("enough")

        with pytest.raises(Cancelled):
            open_inspection(clip, tmp_path / "out", DEFAULT, progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["most", "most.png"]
    assert read_scene(tmp_path / "most").mask_dir is not None
