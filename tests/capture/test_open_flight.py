"""A video and its telemetry as a scene folder, from end to end."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from toolkit.capture.flight import FlightSettings, open_flight
from toolkit.capture.keyframes import KeyframeSettings
from toolkit.cli import main
from toolkit.errors import DataError, RunError, SettingsError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.ellipsoid import geodetic_from_enu
from toolkit.geometry.rigid import rotation_angle
from toolkit.scene import Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import read_scene

pytest.importorskip("av", reason="PyAV is not installed: pip install 'sightline-toolkit[video]'")

EACH = FlightSettings(keyframes=KeyframeSettings(method="every-nth", every=1))
GPX = """<gpx><trk><trkseg>
<trkpt lat="48.0" lon="9.0"><ele>600</ele><time>2026-06-01T10:00:00Z</time></trkpt>
<trkpt lat="48.001" lon="9.0"><ele>600</ele><time>2026-06-01T10:00:10Z</time></trkpt>
</trkseg></trk></gpx>
"""


def test_a_flight_becomes_the_scene_that_it_was_made_of(town_flight: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, truth = town_flight
    flight = open_flight(folder / "video.mp4", folder / "video.srt", tmp_path / "made", EACH)
    assert [frame.name for frame in flight.scene.frames] == [f"frame_{i:06d}.jpg" for i in range(12)]
    assert [frame.split for frame in flight.scene.frames] == ["test", *["train"] * 7, "test", *["train"] * 3]
    assert "true or magnetic north" in flight.warnings[0]
    assert truth.georeference is not None
    assert flight.scene.georeference is not None
    old, new = truth.georeference, flight.scene.georeference
    shift = geodetic_from_enu(np.zeros((1, 3)), (new.latitude, new.longitude, new.altitude))
    np.testing.assert_allclose(shift[0], dataclasses.astuple(new), atol=1e-9)
    positions, places = [], []
    for frame, made in zip(truth.frames, flight.scene.frames, strict=True):
        assert frame.prior is not None
        assert made.prior is not None
        assert frame.prior.rotation is not None
        assert made.prior.rotation is not None
        assert made.time == pytest.approx(frame.time, abs=1e-3)
        # Both frames are level within 0.01 degrees a kilometre of distance of their origins; angles have 4 digits.
        assert np.degrees(rotation_angle(made.prior.rotation @ frame.prior.rotation.T)) < 2e-3
        positions.append(frame.prior.position)
        places.append(made.prior.position)
    ours = geodetic_from_enu(np.array(places), (new.latitude, new.longitude, new.altitude))
    theirs = geodetic_from_enu(np.array(positions), (old.latitude, old.longitude, old.altitude))
    # The subtitles have 1e-9 degrees and millimetres.
    np.testing.assert_allclose(ours[:, :2], theirs[:, :2], atol=2e-9)
    np.testing.assert_allclose(ours[:, 2], theirs[:, 2], atol=1e-3)
    # The origin is the middle of the trajectory (A-3DGS, section 3.2.2), but for the curvature of the earth.
    np.testing.assert_allclose(np.mean(places, axis=0), 0.0, atol=1e-2)


def test_the_folder_opens_as_a_capture_and_tells_how_it_was_made(
    town_flight: tuple[Path, Scene], tmp_path: Path
) -> None:
    folder, _ = town_flight
    flight = open_flight(folder / "video.mp4", None, tmp_path / "made", EACH)
    capture = open_capture(tmp_path / "made")
    assert capture.scene.frames == flight.scene.frames
    assert capture.reference is None
    camera = capture.scene.cameras[1]
    assert isinstance(camera, ColmapCamera)
    assert (camera.model, camera.width, camera.height) == ("SIMPLE_RADIAL", 160, 120)
    assert camera.params[0] == 1.2 * 160
    assert not camera.prior_focal_length
    assert all(frame.prior is None for frame in flight.scene.frames)
    assert flight.scene.georeference is None
    record = json.loads((tmp_path / "made" / "flight.json").read_text())
    assert (record["video"], record["telemetry"]) == ("video.mp4", None)
    assert record["keyframes"]["numbers"] == list(range(12))
    assert FlightSettings.from_dict(record["settings"]).to_dict() == EACH.to_dict()


def test_a_known_camera_and_given_frames(town_flight: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, _ = town_flight
    (tmp_path / "made").mkdir()  # an empty folder may be there
    camera = ColmapCamera.pinhole(160, 120, 150.0)
    given = FlightSettings(keyframes=KeyframeSettings(method="given"))
    flight = open_flight(
        folder / "video.mp4", None, tmp_path / "made", given, camera=camera, numbers=np.array([2, 9])
    )
    assert [frame.name for frame in flight.scene.frames] == ["frame_000002.jpg", "frame_000009.jpg"]
    assert read_scene(tmp_path / "made").cameras == {1: camera}
    small = ColmapCamera.pinhole(80, 60, 75.0)
    with pytest.raises(DataError, match="The camera does not fit .*expected 160 x 120 px; found 80 x 60 px"):
        open_flight(folder / "video.mp4", None, tmp_path / "other", given, camera=small, numbers=[2])


def test_clocks_that_count_from_1970_need_the_start_of_the_video(
    town_flight: tuple[Path, Scene], tmp_path: Path
) -> None:
    folder, _ = town_flight
    (tmp_path / "a.gpx").write_text(GPX)
    made = EACH.replace({"telemetry.attitude_source": "none", "telemetry.max_gap": 20.0})
    with pytest.raises(SettingsError, match=r"counts time from 1970.*expected video_start"):
        open_flight(folder / "video.mp4", tmp_path / "a.gpx", tmp_path / "made", made)
    with pytest.raises(SettingsError, match=r"'video_start' is no date and time; .*found 'noon'"):
        open_flight(
            folder / "video.mp4", tmp_path / "a.gpx", tmp_path / "made", made.replace({"video_start": "noon"})
        )
    timed = made.replace({"video_start": "2026-06-01T10:00:02"})
    scene = open_flight(folder / "video.mp4", tmp_path / "a.gpx", tmp_path / "made", timed).scene
    north = [frame.prior.position[1] for frame in scene.frames if frame.prior and frame.prior.position is not None]
    # 111.2 m in 10 s, at half a second a frame, seen from their middle.
    np.testing.assert_allclose(np.diff(north), 5.56, atol=0.01)
    assert sum(north) == pytest.approx(0.0, abs=0.01)


def test_a_log_that_begins_by_itself_is_told(town_flight: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, _ = town_flight
    rows = "".join(f"{time},48,9,{time}\n" for time in range(20))
    (tmp_path / "a.csv").write_text("time(s),latitude,longitude,altitude(m)\n" + rows)
    made = EACH.replace({"telemetry.attitude_source": "none", "telemetry.time_offset": 7.0})
    flight = open_flight(folder / "video.mp4", tmp_path / "a.csv", tmp_path / "made", made)
    assert "count from the start of the log: with time_offset 7 s they are taken as those of the video" in str(
        flight.warnings
    )
    assert flight.scene.georeference is not None
    assert flight.scene.georeference.altitude == pytest.approx(7.0 + 5.5 / 2)


def test_a_start_of_the_video_that_nothing_needs_is_refused(
    town_flight: tuple[Path, Scene], tmp_path: Path
) -> None:
    folder, _ = town_flight
    (tmp_path / "a.csv").write_text("time(s),latitude,longitude,altitude(m)\n0,48,9,1\n1,48,9,2\n")
    timed = EACH.replace({"telemetry.attitude_source": "none", "video_start": "2026-06-01T10:00:02Z"})
    for telemetry, clock in ((folder / "video.srt", "video"), (tmp_path / "a.csv", "log")):
        with pytest.raises(SettingsError, match=rf"'video_start' has no effect .*from the start of the {clock}\. "):
            open_flight(folder / "video.mp4", telemetry, tmp_path / "made", timed)


def test_what_the_telemetry_lacks_is_told_before_the_video_is_decoded(
    town_flight: tuple[Path, Scene], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(*_: object, **__: object) -> None:
        pytest.fail("the video was decoded first")

    monkeypatch.setattr("toolkit.capture.flight.choose_keyframes", decode)
    folder, _ = town_flight
    wrong = EACH.replace({"telemetry.attitude_source": "flight"})
    with pytest.raises(SettingsError, match="no flight attitude"):
        open_flight(folder / "video.mp4", folder / "video.srt", tmp_path / "made", wrong)


def test_what_fails_leaves_no_folder(town_flight: tuple[Path, Scene], tmp_path: Path) -> None:
    folder, _ = town_flight
    wrong = EACH.replace({"telemetry.attitude_source": "flight"})
    with pytest.raises(SettingsError, match=r"no flight attitude in .*video\.srt; expected attitude_source gimbal"):
        open_flight(folder / "video.mp4", folder / "video.srt", tmp_path / "made", wrong)
    with pytest.raises(DataError, match="Unknown camera model 'LENS'"):
        open_flight(folder / "video.mp4", None, tmp_path / "made", EACH.replace({"camera_model": "LENS"}))
    assert not list(tmp_path.iterdir())
    with pytest.raises(RunError, match="is in the way"):
        open_flight(folder / "video.mp4", None, folder, EACH)


def test_the_command_makes_a_folder_with_the_flags_of_its_settings(
    town_flight: tuple[Path, Scene], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = town_flight
    command = ["frames", str(folder / "video.mp4"), str(tmp_path / "made")]
    flags = ["--keyframes.method", "every-nth", "--keyframes.every", "5", "--pictures.image-format", "png"]
    assert main([*command, "--telemetry", str(folder / "video.srt"), *flags]) == 0
    said = capsys.readouterr()
    assert "3 of 12 frames (every-nth), 3 with priors, written to" in said.out
    assert "warning: The log does not say" in said.err
    names = ["frame_000000.png", "frame_000005.png", "frame_000010.png"]
    assert sorted(path.name for path in (tmp_path / "made" / "images").iterdir()) == names
    assert main([*command, *flags]) == 2
    assert "is in the way" in capsys.readouterr().err


def test_the_help_of_the_command_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["frames", "--help"])
    said = capsys.readouterr().out
    assert "Example: toolkit frames" in said
    assert "--telemetry.lever-forward" in said
