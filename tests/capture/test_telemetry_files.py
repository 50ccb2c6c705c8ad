"""Readers of telemetry: what they take, and that they say what is wrong with the rest."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from toolkit.capture.priors import TelemetrySettings, telemetry_priors
from toolkit.capture.telemetry import Telemetry
from toolkit.capture.telemetry_files import read_telemetry
from toolkit.errors import DataError, ToolkitError
from toolkit.geometry.rigid import rotation_angle
from toolkit.scene import Scene

CUE = """1
00:00:00,000 --> 00:00:00,033
<font size="28">FrameCnt: 1, DiffTime: 33ms
2026-06-01 10:00:00.000
[iso: 100] [focal_len: 24.00] [latitude: 48.5] [longitude: 9.25] [rel_alt: 30.100 abs_alt: 630.2] \
[gb_yaw: -12.5 gb_pitch: -90.0 gb_roll: 0.5] </font>

2
00:00:00,033 --> 00:00:00,066
<font size="28">[latitude: 48.6] [longitude: 9.35] [rel_alt: 31.000 abs_alt: 631.2] \
[gb_yaw: -12.0 gb_pitch: -89.0 gb_roll: 0.0] </font>
"""
OLD = """1
00:00:01,000 --> 00:00:02,000
HOME(149.02,-20.25) 2017.08.05 14:11:51
GPS(149.0251,-20.2533,16) BAROMETER:1.9
ISO:100 Shutter:60 EV: Fnum:2.2

2
00:00:02,000 --> 00:00:03,000
F/2.8, SS 206, ISO 150, EV 0, GPS (149.0261, -20.2543, 17), D 23.45m, H 45.00m, H.S 0.00m/s, V.S 0.00m/s
"""
LOG = """time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),\
altitude_above_seaLevel(feet),compass_heading(degrees),pitch(degrees),roll(degrees),isVideo,gimbal_heading(degrees),gimbal_pitch(degrees)
0,2026-06-01 10:00:00,48.5,9.25,100,1000,10,1,2,0,20,-45
100,2026-06-01 10:00:00,48.5,9.25,100,1000,10,1,2,1,20,-45
200,2026-06-01 10:00:00,48.6,9.35,200,1100,11,1,2,1,21,-46
"""
TRACK = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="48.5" lon="9.25"><ele>600.5</ele><time>2026-06-01T10:00:00Z</time></trkpt>
<trkpt lat="48.6" lon="9.35"><ele>610.5</ele><time>2026-06-01T12:00:01.5+02:00</time></trkpt>
</trkseg></trk></gpx>
"""
WHOLE = {".srt": CUE, ".csv": LOG, ".gpx": TRACK}


@pytest.fixture
def read(tmp_path: Path) -> Callable[[str, str], Telemetry]:
    def from_text(text: str, ending: str) -> Telemetry:
        (tmp_path / f"log{ending}").write_bytes(text.encode())
        return read_telemetry(tmp_path / f"log{ending}")

    return from_text


Read = Callable[[str, str], Telemetry]


# ------------------------------------------------------------------------------------------- subtitles


def test_subtitles_with_names_in_brackets(read: Read) -> None:
    telemetry = read(CUE, ".srt")
    np.testing.assert_array_equal(telemetry.times, [0.0, 0.033])
    np.testing.assert_array_equal(telemetry.latitude, [48.5, 48.6])
    np.testing.assert_array_equal(telemetry.altitude, [630.2, 631.2])
    np.testing.assert_array_equal(telemetry.height, [30.1, 31.0])
    np.testing.assert_array_equal(telemetry.gimbal, [[-12.5, -90.0, 0.5], [-12.0, -89.0, 0.0]])
    assert np.isnan(telemetry.flight).all()
    assert (telemetry.clock, telemetry.north, telemetry.altitude_reference) == ("video", "unknown", "unstated")
    assert not telemetry.warnings
    np.testing.assert_array_equal(read(CUE.replace("\n", "\r\n"), ".SRT").gimbal, telemetry.gimbal)


def test_the_misspelt_longitude_and_spaces_before_the_colon(read: Read) -> None:
    text = CUE.replace("longitude: ", "longtitude : ").replace("latitude: ", "latitude : ")
    np.testing.assert_array_equal(read(text, ".srt").longitude, [9.25, 9.35])


def test_subtitles_of_older_drones_with_a_doubt_about_their_third_number(read: Read) -> None:
    telemetry = read(OLD, ".srt")
    np.testing.assert_array_equal(telemetry.longitude, [149.0251, 149.0261])
    np.testing.assert_array_equal(telemetry.latitude, [-20.2533, -20.2543])
    np.testing.assert_array_equal(telemetry.altitude, [16, 17])
    np.testing.assert_array_equal(telemetry.height, [1.9, 45.0])
    assert "number of satellites" in telemetry.warnings[0]
    assert not read(OLD.replace(",16)", ",116.5)"), ".srt").warnings


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("[latitude: 48.6]", "[latitude: nan]"), r"line 7: latitude is not finite; expected .* found 'nan'"),
        (("[latitude: 48.6]", "[latitude: x]"), "line 7: latitude is no number"),
        (("[latitude: 48.6]", "[latitude: 98.6]"), "line 7: latitude cannot be; expected -90 to 90; found '98.6'"),
        (("[longitude: 9.35]", ""), "line 7: half of a position; expected latitude and longitude"),
        (("0.0] </font>", "0."), "line 7: the subtitle is cut off; expected text whose brackets are closed"),
        (("00:00:00,033 -->", "00:00:00,033"), "line 7 begins no subtitle"),
        (("itude: ", "itudes: "), "There is no position in"),
    ],
)
def test_wrong_subtitles_are_named(read: Read, change: tuple[str, str], message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(CUE.replace(*change), ".srt")
    with pytest.raises(DataError, match="GPS has 2 numbers; expected longitude, latitude, altitude"):
        read(OLD.replace(",16)", ")"), ".srt")


def test_the_samples_subtitles_give_its_priors_back(town_flight: tuple[Path, Scene]) -> None:
    folder, scene = town_flight
    telemetry = read_telemetry(folder / "video.srt")
    assert len(telemetry) == len(scene) == 12
    times = np.array([0.0 if frame.time is None else frame.time for frame in scene.frames])
    priors, origin, _ = telemetry_priors(telemetry, times, TelemetrySettings(), scene.georeference)
    assert origin == scene.georeference
    for frame, found in zip(scene.frames, priors, strict=True):
        assert frame.prior is not None
        assert found is not None
        assert found.position is not None
        assert found.rotation is not None
        assert frame.prior.rotation is not None
        # Written to 1e-9 degrees (0.1 mm) and 1 mm of height; angles to 1e-4 degrees, of which three add up.
        np.testing.assert_allclose(found.position, frame.prior.position, atol=6e-4)
        assert np.degrees(rotation_angle(found.rotation @ frame.prior.rotation.T)) < 2e-4


# ----------------------------------------------------------------------------------------- flight logs


def test_a_flight_log_with_units_in_its_header(read: Read) -> None:
    telemetry = read(LOG, ".csv")
    # The first row with isVideo is the start of the video.
    np.testing.assert_allclose(telemetry.times, [-0.1, 0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(telemetry.height, np.array([100, 100, 200]) * 0.3048)
    np.testing.assert_allclose(telemetry.altitude, np.array([1000, 1000, 1100]) * 0.3048)
    np.testing.assert_array_equal(telemetry.gimbal[:, :2], [[20, -45], [20, -45], [21, -46]])
    np.testing.assert_array_equal(telemetry.flight[2], [11, 1, 2])
    assert (telemetry.clock, telemetry.altitude_reference, telemetry.north) == ("video", "sea level", "unknown")
    assert telemetry.warnings == ("3 readings of the gimbal attitude have no roll: taken as 0",)


def test_names_of_other_writers_and_other_separators(read: Read) -> None:
    names = "OSD.flyTime [s];OSD.latitude;OSD.longitude;OSD.height [ft];GIMBAL.yaw;true_heading [rad];pitch;roll"
    telemetry = read(f"sep=;\n{names}\n" + "1;48;9;10;7;3.141592653589793;0;0\n2;48;9;;;;;\n", ".csv")
    np.testing.assert_array_equal(telemetry.times, [1, 2])
    np.testing.assert_allclose(telemetry.height, [3.048, np.nan])
    np.testing.assert_allclose(telemetry.flight[0], [180, 0, 0])
    assert (telemetry.clock, telemetry.north) == ("log", "true")


def test_a_log_with_dates_only_counts_from_1970(read: Read) -> None:
    telemetry = read("datetime(utc),latitude,longitude\n1970-01-01 00:01:00.5,48,9\n", ".csv")
    assert telemetry.absolute
    assert telemetry.times.tolist() == [60.5]


def test_missing_units_and_several_recordings_are_told(read: Read) -> None:
    text = "time,latitude,longitude,altitude,isVideo\n0,48,9,100,1\n1,48,9,100,0\n2,48,9,100,1\n"
    warnings = read(text, ".csv").warnings
    assert warnings == (
        "Column 'time' has no unit: taken as seconds",
        "Column 'altitude' has no unit: taken as metres",
        "The log has 2 recordings: times count from the first; set time_offset for the video of another",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (LOG.replace("21,-46", "21"), "line 4 has a wrong number of cells; expected 12 as in the header; found 11"),
        (LOG.replace("48.6", "nan"), "line 4: latitude is not finite"),
        (LOG.replace("48.6", "148.6"), "line 4: latitude cannot be; expected -90 to 90"),
        (
            LOG.replace("takeoff(feet)", "takeoff(furlongs)"),
            r"line 1: column 'height_.*' has an unknown unit; .*ft",
        ),
        (LOG.replace("latitude", "width"), "has no position column; expected latitude or"),
        (LOG.replace("time(m", "date(m").replace("datetime", "day"), "has no time column; expected time or"),
        (LOG[:-1], r"line 4 is cut off; expected a line break after the last line; found '.*21,-46'"),
        (LOG.split("\n")[0] + "\n", "There is no row in"),
        (LOG.replace(",1,20", ",maybe,20"), "line 3: isVideo is neither yes nor no"),
        ("time(s),latitude,longitude\n,48,9\n", "line 2 has no time"),
        ("time(s),datetime,latitude,longitude\n,2026-06-01,48,9\n1,,48,9\n", "Not every row of .* has a time"),
        ("datetime,latitude,longitude\nnow,48,9\n", "line 2: datetime is no date and time; expected like 2026"),
        ('time(s),latitude,longitude\n1,"48,9\n', "is no line of a table"),
    ],
)
def test_wrong_flight_logs_are_named(read: Read, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(text, ".csv")


# ------------------------------------------------------------------------------------------------- GPX


def test_a_gpx_track(read: Read) -> None:
    telemetry = read(TRACK, ".gpx")
    assert telemetry.absolute
    np.testing.assert_allclose(np.diff(telemetry.times), [1.5])
    np.testing.assert_array_equal(telemetry.latitude, [48.5, 48.6])
    np.testing.assert_array_equal(telemetry.altitude, [600.5, 610.5])
    told = read(TRACK.replace("<time>2026-06-01T10:00:00Z</time>", ""), ".gpx").warnings
    assert told == ("1 of 2 track points have no time: left out",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (TRACK[:-40], r"cannot be read; expected a GPX track; found .*line \d"),
        (TRACK.replace('lat="48.6"', ""), "track point 2: lat is no number"),
        (TRACK.replace("610.5", "NaN"), "track point 2: ele is not finite"),
        (TRACK.replace("2026", "year"), "track point 1: time is no date and time"),
        (TRACK.replace("trkpt", "wpt"), "There is no track point in .*found <gpx>"),
        (TRACK.replace("time>", "when>"), "No track point of .* has a time"),
        ('<!DOCTYPE g [<!ENTITY a "b">]><gpx>&a;</gpx>', "cannot be read"),
    ],
)
def test_wrong_tracks_are_named(read: Read, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(text, ".gpx")


# ------------------------------------------------------------------------------------------- all kinds


@pytest.mark.parametrize("ending", WHOLE)
def test_missing_empty_and_binary_files_are_named(read: Read, tmp_path: Path, ending: str) -> None:
    with pytest.raises(DataError, match=rf"none\{ending} is missing"):
        read_telemetry(tmp_path / f"none{ending}")
    with pytest.raises(DataError, match="is empty"):
        read(" \n", ending)
    (tmp_path / f"b{ending}").write_bytes(b"a\n\xff\xfe\n")
    with pytest.raises(DataError, match="line 2 is no text"):
        read_telemetry(tmp_path / f"b{ending}")
    (tmp_path / f"folder{ending}").mkdir()
    with pytest.raises(DataError, match="Cannot read"):
        read_telemetry(tmp_path / f"folder{ending}")


def test_an_unknown_ending_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no known kind; expected a name that ends in \.srt, \.csv, \.gpx"):
        read_telemetry(tmp_path / "log.txt")


@pytest.mark.parametrize("ending", WHOLE)
def test_a_file_that_was_cut_off_is_refused_or_ends_at_a_whole_reading(read: Read, ending: str) -> None:
    whole = read(WHOLE[ending], ending)
    for end in range(len(WHOLE[ending])):
        try:
            part = read(WHOLE[ending][:end], ending)
        except DataError:
            continue
        count = len(part)
        assert count < len(whole) or not WHOLE[ending][end:].strip()
        np.testing.assert_array_equal(part.latitude, whole.latitude[:count])
        np.testing.assert_array_equal(part.gimbal, whole.gimbal[:count])


def telemetry_or_error(text: str, ending: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{ending}"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        try:
            telemetry = read_telemetry(path)
        except ToolkitError:
            return
        assert (np.diff(telemetry.times) > 0).all()


PIECES = st.sampled_from(
    [
        *(
            "1",
            "\n",
            "\n\n",
            "00:00:01,000 --> 00:00:02,000",
            "[latitude: ",
            "48.5",
            "]",
            "[",
            "GPS(",
            ",",
            ")",
            "nan",
        ),
        *(
            "latitude",
            "longitude",
            "time(s)",
            "altitude(feet)",
            '"',
            ";",
            "1e400",
            "datetime(utc)",
            "isVideo",
            "\t",
        ),
        *("<gpx>", '<trkpt lat="1" lon="2">', "<time>2026-06-01</time>", "</trkpt>", "</gpx>", "\0", "sep=;", "-"),
    ]
)


@pytest.mark.parametrize("ending", WHOLE)
@settings(max_examples=60)
@given(text=st.one_of(st.text(max_size=80), st.lists(PIECES, max_size=30).map("".join)))
@example(text="time(s),latitude,longitude\n1,2,3\n")
def test_any_text_is_telemetry_or_an_error_that_is_told(ending: str, text: str) -> None:
    telemetry_or_error(text, ending)


@pytest.mark.parametrize("ending", WHOLE)
@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_file_is_telemetry_or_an_error_that_is_told(ending: str, data: st.DataObject) -> None:
    whole = WHOLE[ending]
    begin = data.draw(st.integers(0, len(whole)))
    end = data.draw(st.integers(begin, min(len(whole), begin + 12)))
    telemetry_or_error(whole[:begin] + data.draw(st.one_of(st.text(max_size=6), PIECES)) + whole[end:], ending)
