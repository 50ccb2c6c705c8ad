"""The sample's video and telemetry: as many frames, the same pictures, and the priors in DJI's subtitles."""

from __future__ import annotations

import dataclasses
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import Cancelled, DataError, MissingDependencyError, RunError, SettingsError
from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.geodesy import enu_from_geodetic
from toolkit.geometry.rigid import rotation_angle
from toolkit.progress import ProgressEvent
from toolkit.samples.make import ORIGIN, SampleSettings, make_sample
from toolkit.samples.video import write_srt, write_video
from toolkit.scene import Frame, PosePrior, Scene
from toolkit.scene.pictures import load_picture

av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")

SMALL = SampleSettings().replace(
    {
        "town.trees": 0,
        "flight.frames": 7,
        "flight.image_width": 80,
        "flight.image_height": 60,
        "flight.samples": 1,
        "points": 0,
        "video": True,
    }
)
BLOCK = re.compile(
    r"(?P<index>\d+)\n(?P<begin>[\d:,]+) --> (?P<end>[\d:,]+)\n"
    r'<font size="28">FrameCnt: (?P<count>\d+), DiffTime: (?P<step>\d+)ms\n'
    r"(?P<date>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3})\n"
    r"(?P<rest>\[iso: .*)</font>\n"
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Scene]:
    folder = tmp_path_factory.mktemp("video") / "town"
    return folder, make_sample(folder, SMALL, seed=2)


def plain_scene(folder: Path, sizes: list[tuple[int, int]], **changes: object) -> Scene:
    rng = np.random.default_rng(0)
    frames = []
    for number, size in enumerate(sizes):
        colour = tuple(int(value) for value in rng.integers(40, 200, 3))
        Image.new("RGB", size, colour).save(folder / f"{number}.png")
        frames.append(Frame(f"{number}.png", 1))
    return Scene(folder, {1: ColmapCamera.pinhole(*sizes[0], 50.0)}, tuple(frames)).replace(**changes)


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def telemetry(path: Path) -> list[dict[str, str]]:
    blocks = [found.groupdict() for found in BLOCK.finditer(path.read_text())]
    return [block | dict(re.findall(r"(\w+): ([^\s\]]+)", block["rest"])) for block in blocks]


# -------------------------------------------------------------------------------------------------------- video


def test_the_video_holds_the_pictures_in_their_order_and_time(made: tuple[Path, Scene]) -> None:
    folder, scene = made
    with av.open(str(folder / "video.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name in ("h264", "mpeg4")
        assert stream.average_rate == 2  # a picture each half second
        frames = list(container.decode(video=0))
    assert [frame.time for frame in frames] == pytest.approx([0.5 * i for i in range(7)])
    shown = [frame.to_ndarray(format="rgb24").astype(float) for frame in frames]
    pictures = [load_picture(scene.image_path(frame)).astype(float) for frame in scene.frames]
    gap = np.array([[np.abs(a - b).mean() for b in pictures] for a in shown])
    assert list(gap.argmin(axis=1)) == list(range(7))
    # Chroma has half the resolution; other pictures differ by more than twice as much.
    assert np.diag(gap).max() < 8


def test_odd_sides_are_continued_and_all_frames_arrive(tmp_path: Path) -> None:
    scene = plain_scene(tmp_path, 25 * [(33, 21)])
    write_video(scene, tmp_path / "a.mp4", frames_per_second=30000 / 1001)
    frames = decoded(tmp_path / "a.mp4")
    assert len(frames) == 25
    for frame, source in zip(frames, scene.frames, strict=True):
        assert frame.shape == (22, 34, 3)
        flat = load_picture(scene.image_path(source))[0, 0].astype(float)
        assert np.abs(frame - flat).max() < 12  # 8-bit YUV and quantisation of a flat colour


@pytest.mark.parametrize("rate", [0.0167, 1, 23.976, 59.94, 1000])
def test_rates_are_kept(tmp_path: Path, rate: float) -> None:
    scene = plain_scene(tmp_path, 3 * [(32, 32)])
    write_video(scene, tmp_path / "a.mp4", frames_per_second=rate)
    with av.open(str(tmp_path / "a.mp4")) as container:
        times = [frame.time for frame in container.decode(video=0)]
    assert times == pytest.approx([0.0, 1 / rate, 2 / rate], rel=1e-3)


def test_without_x264_it_is_mpeg4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", av.codecs_available - {"libx264"})
    write_video(plain_scene(tmp_path, 4 * [(32, 24)]), tmp_path / "a.mp4", frames_per_second=29.97)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "mpeg4"
        assert len(list(container.decode(video=0))) == 4


def test_pictures_of_two_sizes_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    scene = plain_scene(tmp_path, [(32, 24), (24, 32)])
    before = sorted(tmp_path.iterdir())
    with pytest.raises(DataError, match=r"'1\.png' has another size.*32 x 24 px; found 24 x 32 px.*each size"):
        write_video(scene, tmp_path / "a.mp4")
    assert sorted(tmp_path.iterdir()) == before


def test_a_scene_without_frames_makes_no_video(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="without frames makes no video; expected at least one frame"):
        write_video(plain_scene(tmp_path, [(8, 8)], frames=()), tmp_path / "a.mp4")


@pytest.mark.parametrize("rate", [0, -1, math.nan, math.inf, 1001, 1e-9])
def test_rates_out_of_range_are_refused(tmp_path: Path, rate: float) -> None:
    scene = plain_scene(tmp_path, [(8, 8)], georeference=ORIGIN)
    with pytest.raises(SettingsError, match="Frames per second are out of range; expected .*; found"):
        write_video(scene, tmp_path / "a.mp4", frames_per_second=rate)
    with pytest.raises(SettingsError, match="Frames per second are out of range"):
        write_srt(scene, tmp_path / "a.srt", frames_per_second=rate)


def test_a_file_in_the_way_of_the_folder_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match="in the way"):
        write_video(plain_scene(tmp_path, [(8, 8)]), tmp_path / "file" / "a.mp4")


def test_progress_is_told_and_cancels(tmp_path: Path) -> None:
    scene = plain_scene(tmp_path, 3 * [(32, 24)])
    events: list[ProgressEvent] = []
    write_video(scene, tmp_path / "a.mp4", progress=events.append)
    assert [(event.stage, event.done, event.total) for event in events] == [
        ("sample.video", done, 3) for done in range(4)
    ]

    def stop(event: ProgressEvent) -> None:
        if event.done == 1:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        write_video(scene, tmp_path / "b.mp4", progress=stop)
    assert not [path for path in tmp_path.iterdir() if path.suffix == ".mp4" and path.name != "a.mp4"]


def test_without_pyav_the_cure_is_told_before_anything_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'sightline-toolkit\[video\]'"):
        make_sample(tmp_path / "town", SMALL)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------------------------------------- telemetry


def test_the_subtitles_are_the_priors(made: tuple[Path, Scene]) -> None:
    folder, scene = made
    blocks = telemetry(folder / "video.srt")
    assert len(blocks) == len(scene)
    origin = (ORIGIN.latitude, ORIGIN.longitude, ORIGIN.altitude)
    for number, (block, frame) in enumerate(zip(blocks, scene.frames, strict=True)):
        prior = frame.prior
        assert prior is not None
        assert prior.position is not None
        assert prior.rotation is not None
        assert int(block["index"]) == int(block["count"]) == number + 1
        assert block["step"] == "500"
        place = [float(block[key]) for key in ("latitude", "longitude", "abs_alt")]
        np.testing.assert_allclose(enu_from_geodetic([place], origin)[0], prior.position, atol=1e-3)
        assert float(block["rel_alt"]) == pytest.approx(prior.position[2], abs=6e-4)
        gimbal = Attitude(*(float(block[f"gb_{angle}"]) for angle in ("yaw", "pitch", "roll")))
        assert math.degrees(rotation_angle(cam_from_enu(gimbal) @ prior.rotation.T)) < 5e-4
    assert [block["begin"] for block in blocks[:3]] == ["00:00:00,000", "00:00:00,500", "00:00:01,000"]
    assert blocks[2]["end"] == "00:00:01,500"
    assert [block["date"][-12:] for block in blocks[:2]] == ["10:00:00.000", "10:00:00.500"]
    assert blocks[0]["date"].startswith("2026-06-01 ")
    # 65 degrees across 80 px are 62.8 px, of 100 px diagonal and 43.27 mm.
    assert {block["focal_len"] for block in blocks} == {"27.17"}


def test_the_text_is_djis(tmp_path: Path) -> None:
    prior = PosePrior(position=np.zeros(3), rotation=cam_from_enu(Attitude(-12.3, -45.6, 0.5)))
    scene = plain_scene(tmp_path, [(30, 40)], georeference=ORIGIN)
    scene = scene.replace(frames=tuple(dataclasses.replace(frame, prior=prior) for frame in scene.frames))
    write_srt(scene, tmp_path / "a.srt")
    assert (tmp_path / "a.srt").read_text() == (
        "1\n00:00:00,000 --> 00:00:00,100\n"
        '<font size="28">FrameCnt: 1, DiffTime: 100ms\n'
        "2026-06-01 10:00:00.000\n"
        "[iso: 100] [shutter: 1/1000.0] [fnum: 2.8] [focal_len: 43.27] [latitude: 48.000000000] "
        "[longitude: 9.000000000] [rel_alt: 0.000 abs_alt: 600.000] "
        "[gb_yaw: -12.3000 gb_pitch: -45.6000 gb_roll: 0.5000] </font>\n"
    )


def test_what_a_prior_lacks_is_left_out(tmp_path: Path) -> None:
    scene = plain_scene(tmp_path, 3 * [(32, 24)], georeference=ORIGIN)
    priors = [None, PosePrior(position=np.array([1.0, 2.0, 3.0])), PosePrior(rotation=np.eye(3))]
    frames = [dataclasses.replace(f, prior=prior) for f, prior in zip(scene.frames, priors, strict=True)]
    write_srt(scene.replace(frames=tuple(frames)), tmp_path / "a.srt", frames_per_second=4)
    blocks = telemetry(tmp_path / "a.srt")
    assert [("latitude" in block, "gb_yaw" in block) for block in blocks] == [
        (False, False),
        (True, False),
        (False, True),
    ]
    assert [block["date"][-6:] for block in blocks] == ["00.000", "00.250", "00.500"]  # by the frame rate


def test_long_recordings_have_hours(tmp_path: Path) -> None:
    scene = plain_scene(tmp_path, 62 * [(8, 8)], georeference=ORIGIN)
    write_srt(scene, tmp_path / "a.srt", frames_per_second=1 / 60)
    assert telemetry(tmp_path / "a.srt")[-1]["begin"] == "01:01:00,000"


def test_without_georeference_there_is_no_telemetry(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="without georeference has no telemetry.*Add a georeference"):
        write_srt(plain_scene(tmp_path, [(8, 8)]), tmp_path / "a.srt")


# ------------------------------------------------------------------------------------------------ in the sample


def test_the_video_does_not_change_the_rest_and_is_the_same_each_time(
    made: tuple[Path, Scene], tmp_path: Path
) -> None:
    folder, _ = made
    make_sample(tmp_path / "again", SMALL, seed=2)
    make_sample(tmp_path / "silent", SMALL.replace({"video": False}), seed=2)
    names = {path.name for path in folder.iterdir()}
    assert names - {path.name for path in (tmp_path / "silent").iterdir()} == {"video.mp4", "video.srt"}
    for name in ("video.mp4", "video.srt", "scene.json", "images/frame_0003.jpg"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes()
    for name in ("scene.json", "images/frame_0003.jpg"):
        assert (tmp_path / "silent" / name).read_bytes() == (folder / name).read_bytes()
