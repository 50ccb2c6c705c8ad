"""Video files in, pictures out: which frames, when, and what is said of damaged files."""

from __future__ import annotations

import struct
import sys
import time
import wave
from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from toolkit.capture import video as video_module
from toolkit.capture.frames import PictureSettings, check_numbers, video_frames
from toolkit.capture.video import decoded_frames, video_info
from toolkit.errors import Cancelled, DataError, MissingDependencyError, RunError
from toolkit.progress import ProgressEvent
from toolkit.scene import Scene
from toolkit.scene.pictures import load_picture
from toolkit.scene.video import encode_video

av = pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")

ALL = PictureSettings()


def gradient(number: int, width: int = 64, height: int = 48) -> np.ndarray:
    """Return a picture that tells its number and which side is up."""
    across, down = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([across * 3, down * 4, np.full_like(across, 20 * number)], axis=2).astype(np.uint8)


def made(path: Path, count: int = 8, fps: float = 10.0) -> Path:
    encode_video((gradient(number) for number in range(count)), path, fps)
    return path


def remuxed(source: Path, target: Path, **options: str) -> Path:
    """Copy a video without decoding it."""
    with av.open(str(source)) as old, av.open(str(target), "w", options=options) as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(old.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)
    return target


def psnr(found: np.ndarray, truth: np.ndarray) -> float:
    error = np.mean((found.astype(float) - truth.astype(float)) ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


# -------------------------------------------------------------------------------------------- decoding


def test_the_samples_pictures_come_back_in_order_and_time(town_flight: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, scene = town_flight
    info = video_info(folder / "video.mp4")
    assert (info.frames, info.width, info.height, info.rotation) == (12, 160, 120, 0)
    found = video_frames(folder / "video.mp4", tmp_path / "out", ALL)
    assert found.names == tuple(f"frame_{number:06d}.jpg" for number in range(12))
    assert found.numbers.tolist() == list(range(12))
    np.testing.assert_allclose(found.times, [frame.time for frame in scene.frames], atol=1e-3)
    assert info.duration == pytest.approx(found.times[-1] + 1 / info.fps, abs=1e-3)
    for name, frame in zip(found.names, scene.frames, strict=True):
        # 4:2:0, crf 18 and JPEG leave 31 dB of these small, sharp pictures; the frame before or after is at 13 dB.
        assert psnr(load_picture(tmp_path / "out" / name), load_picture(scene.image_path(frame))) > 28.0


def test_png_keeps_the_decoded_pixels_and_jpeg_nearly(tmp_path: Path) -> None:
    clip = made(tmp_path / "a.mp4", 2)
    exact = [frame.rgb() for frame in decoded_frames(clip)]
    video_frames(clip, tmp_path / "png", PictureSettings(image_format="png"))
    video_frames(clip, tmp_path / "jpeg", PictureSettings())
    np.testing.assert_array_equal(load_picture(tmp_path / "png" / "frame_000001.png"), exact[1])
    assert psnr(load_picture(tmp_path / "jpeg" / "frame_000001.jpg"), exact[1]) > 35.0


def test_frames_of_a_variable_rate_have_their_own_times(tmp_path: Path) -> None:
    stamps = [0, 100, 150, 700, 705]
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, stamp in enumerate(stamps):
            picture = av.VideoFrame.from_ndarray(gradient(number), format="rgb24")
            picture.pts, picture.time_base = stamp, Fraction(1, 1000)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    times = [frame.time for frame in decoded_frames(tmp_path / "a.mp4")]
    np.testing.assert_allclose(times, np.array(stamps) / 1000, atol=1e-3)


def test_a_video_that_is_shown_turned_gives_upright_pictures(tmp_path: Path) -> None:
    data = bytearray(made(tmp_path / "a.mp4", 2).read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40
    # ISO 14496-12: x' = a x + c y, y' = b x + d y; this one turns clockwise by a quarter.
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 0, 0, 1 << 30)
    (tmp_path / "turned.mp4").write_bytes(bytes(data))
    info = video_info(tmp_path / "turned.mp4")
    assert (info.width, info.height, info.rotation) == (48, 64, 270)
    shown = next(decoded_frames(tmp_path / "turned.mp4"))
    assert psnr(shown.rgb(), np.rot90(gradient(0), -1)) > 30.0
    assert shown.grey().shape == (64, 48)


@pytest.fixture
def new_york(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Put the machine in a zone five hours behind UTC."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "EST5")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("new_york")
@pytest.mark.parametrize("told", [b"1970-01-01T00:01:00.000000Z", b"1970-01-01T00:01:00.0000000"])
def test_the_start_of_the_recording_is_read_as_utc_where_no_zone_is_told(tmp_path: Path, told: bytes) -> None:
    clip = made(tmp_path / "a.mp4", 2)
    assert video_info(clip).start is None
    # FFmpeg writes dates with a zone; in this container they are text, which other writers leave without.
    with av.open(str(clip)) as old, av.open(str(tmp_path / "b.flv"), "w") as new:
        new.metadata["creation_time"] = "1970-01-01T00:02:00Z"
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(old.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)
    data, written = (tmp_path / "b.flv").read_bytes(), b"1970-01-01T00:02:00.000000Z"
    assert data.count(written) == 1
    (tmp_path / "b.flv").write_bytes(data.replace(written, told))
    assert video_info(tmp_path / "b.flv").start == 60.0


def test_frames_are_counted_where_the_file_has_no_index(tmp_path: Path) -> None:
    assert video_info(remuxed(made(tmp_path / "a.mp4", 5), tmp_path / "a.mkv")).frames == 5


# --------------------------------------------------------------------------------------- damaged files


def test_a_video_that_was_cut_off_tells_how_many_frames_were_read(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, 48, 64, 3), dtype=np.uint8)  # frames of equal size
    encode_video(iter(noise), tmp_path / "a.mp4", 10)
    clip = remuxed(tmp_path / "a.mp4", tmp_path / "fast.mp4", movflags="faststart")
    data = clip.read_bytes()
    clip.write_bytes(data[: int(0.6 * len(data))])
    with pytest.raises(DataError, match=r"fast\.mp4 is cut off or damaged: 1\d of 30 frames could be read"):
        video_frames(clip, tmp_path / "out", ALL)
    assert not (tmp_path / "out").exists()
    # The frames before the cut can still be had by their numbers.
    assert len(video_frames(clip, tmp_path / "out", ALL, numbers=[0, 1]).names) == 2


def test_a_video_without_its_index_and_files_that_are_none(tmp_path: Path) -> None:
    data = made(tmp_path / "a.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.mp4").write_text("no video\n" * 100)
    for name in ("cut.mp4", "text.mp4"):
        with pytest.raises(
            DataError, match=f"{name} cannot be read as a video; expected a video file that is whole"
        ):
            video_info(tmp_path / name)
    with pytest.raises(DataError, match=r"Video .*none\.mp4 is missing"):
        video_info(tmp_path / "none.mp4")
    with wave.open(str(tmp_path / "sound.wav"), "wb") as sound:
        sound.setnchannels(1)
        sound.setsampwidth(2)
        sound.setframerate(8000)
        sound.writeframes(b"\0" * 1600)
    with pytest.raises(DataError, match=r"There are no pictures in .*sound\.wav"):
        video_info(tmp_path / "sound.wav")


class FakeFrame:
    width = height = rotation = 0

    def __init__(self, time: float | None, is_corrupt: bool = False) -> None:
        self.time, self.is_corrupt = time, is_corrupt


def fake(monkeypatch: pytest.MonkeyPatch, frames: list[Any], rate: Fraction | None = None) -> None:
    """Let every video be one of these frames, or of errors of the decoder."""

    def decode(frame: Any) -> list[Any]:
        if isinstance(frame, Exception):
            raise frame
        return [frame]

    packets = [SimpleNamespace(size=1, is_corrupt=False, decode=lambda f=frame: decode(f)) for frame in frames]
    stream = SimpleNamespace(frames=len(frames), average_rate=rate, guessed_rate=None, duration=None)
    container = SimpleNamespace(demux=lambda stream: iter(packets))

    @contextmanager
    def opened(path: Path) -> Any:
        yield container, stream

    monkeypatch.setattr(video_module, "_opened", opened)


def test_damaged_frames_and_times_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    fake(monkeypatch, [FakeFrame(0.0), FakeFrame(0.1, is_corrupt=True)])
    with pytest.raises(DataError, match=r"1 of 2 frames could be read; found a damaged frame"):
        list(decoded_frames(Path("a.mp4")))
    fake(monkeypatch, [FakeFrame(0.0), av.error.InvalidDataError(1, "bad data")])
    with pytest.raises(DataError, match=r"1 of 2 frames could be read; found .*bad data"):
        list(decoded_frames(Path("a.mp4")))
    fake(monkeypatch, [FakeFrame(0.0), FakeFrame(0.0)])
    with pytest.raises(DataError, match=r"do not increase; .*found frame 1 at 0 s after 0 s"):
        list(decoded_frames(Path("a.mp4")))
    fake(monkeypatch, [FakeFrame(None)])
    with pytest.raises(DataError, match="have no times; expected time stamps or a frame rate"):
        list(decoded_frames(Path("a.mp4")))
    fake(monkeypatch, [FakeFrame(None), FakeFrame(None)], Fraction(4))
    assert [frame.time for frame in decoded_frames(Path("a.mp4"))] == [0.0, 0.25]
    fake(monkeypatch, [])
    with pytest.raises(DataError, match=r"There is no frame in a\.mp4"):
        video_info(Path("a.mp4"))


def test_the_missing_package_names_its_cure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'sightline-toolkit\[video\]'"):
        video_info(tmp_path / "a.mp4")


# ---------------------------------------------------------------------------------------- which frames


def test_frames_are_taken_by_number(tmp_path: Path) -> None:
    clip = made(tmp_path / "a.mp4", 9)
    found = video_frames(clip, tmp_path / "numbers", ALL, numbers=np.array([1, 3]))
    assert found.names == ("frame_000001.jpg", "frame_000003.jpg")
    assert sorted(path.name for path in (tmp_path / "numbers").iterdir()) == list(found.names)


def test_wrong_wishes_are_refused(tmp_path: Path) -> None:
    clip = made(tmp_path / "a.mp4", 3)
    with pytest.raises(DataError, match=r"has no frame 7; expected numbers from 0; found 3 frames"):
        video_frames(clip, tmp_path / "out", ALL, numbers=[0, 7])
    for wrong in ([], [-1], [1, 1], [0.5], [[1]]):
        with pytest.raises(DataError, match="no frame numbers; expected increasing whole numbers from 0"):
            check_numbers(wrong)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    with pytest.raises(RunError, match="is in the way; expected a new or an empty folder"):
        video_frames(clip, tmp_path / "full", ALL)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mp4", "full"]


def test_progress_is_told_and_cancelling_leaves_nothing(tmp_path: Path) -> None:
    clip = made(tmp_path / "a.mp4", 3)
    events: list[ProgressEvent] = []
    video_frames(clip, tmp_path / "out", ALL, progress=events.append)
    assert [(event.stage, event.done, event.total) for event in events] == [("frames", i, 3) for i in range(4)]

    def stop(event: ProgressEvent) -> None:
        if event.done == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        video_frames(clip, tmp_path / "other", ALL, progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mp4", "out"]


@pytest.mark.real
def test_a_real_video(real_data: Path, tmp_path: Path) -> None:
    clip = real_data / "video_kitti_03" / "video.mp4"
    info = video_info(clip)
    assert (info.frames, info.width, info.height, info.fps) == (801, 828, 250, 10.0)
    found = video_frames(clip, tmp_path / "out", ALL, numbers=[0, 7, 60])
    np.testing.assert_allclose(found.times, [0.0, 0.7, 6.0], atol=1e-3)
    pictures = [load_picture(tmp_path / "out" / name) for name in found.names]
    assert {picture.shape for picture in pictures} == {(250, 828, 3)}
    assert all(picture.std() > 30 for picture in pictures)
    assert psnr(pictures[0], pictures[1]) > psnr(pictures[0], pictures[2])
