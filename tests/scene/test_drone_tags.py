"""What a drone writes of itself: XMP in both spellings, damaged, hostile or odd, and what a scene makes of it."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import DataError
from toolkit.geometry.attitude import Attitude, cam_from_enu
from toolkit.scene.exif import PhotoTags, read_tags
from toolkit.scene.photos import scene_from_photos
from toolkit.scene.pictures import open_picture
from toolkit.scene.xmp import DroneTags, read_drone_tags

VALUES = {
    "AltitudeType": "RtkAlt",
    "AbsoluteAltitude": "+612.25",
    "RelativeAltitude": "+59.50",
    "GimbalRollDegree": "+0.50",
    "GimbalYawDegree": "-12.30",
    "GimbalPitchDegree": "-45.60",
    "FlightRollDegree": "-2.00",
    "FlightYawDegree": "+170.00",
    "FlightPitchDegree": "+1.00",
    "RtkFlag": "50",
    "RtkStdLon": "0.01",
    "RtkStdLat": "0.02",
    "RtkStdHgt": "0.03",
}
EXPECTED = DroneTags(
    gimbal=Attitude(-12.3, -45.6, 0.5),
    flight=Attitude(170.0, 1.0, -2.0),
    relative_altitude=59.5,
    above_ellipsoid=True,
    position_sigma=(0.01, 0.02, 0.03),
)
GPS: dict[int, Any] = {1: "N", 2: (48.0, 30.0, 0.0), 3: "E", 4: (9.0, 0.0, 0.0), 5: b"\x00", 6: 600.0}

_HEAD = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">'
    '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description '
    'rdf:about="DJI Meta Data" xmlns:tiff="http://ns.adobe.com/tiff/1.0/" '
    'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" tiff:Make="DJI"'
)
_TAIL = '</rdf:RDF></x:xmpmeta>\n<?xpacket end="w"?>'


def by_attributes(values: dict[str, str]) -> bytes:
    inside = "".join(f' drone-dji:{name}="{text}"' for name, text in values.items())
    return f"{_HEAD}{inside}/>{_TAIL}".encode()


def by_elements(values: dict[str, str]) -> bytes:
    inside = "".join(f"<drone-dji:{name}> {text}\n</drone-dji:{name}>" for name, text in values.items())
    return f"{_HEAD}>{inside}</rdf:Description>{_TAIL}".encode()


def photo(
    path: Path,
    values: dict[str, str] | None = None,
    *,
    size: tuple[int, int] = (40, 30),
    gps: dict[int, Any] | None = None,
    base: dict[int, Any] | None = None,
    taken: dict[int, Any] | None = None,
) -> None:
    exif = Image.Exif()
    for number, value in (base or {}).items():
        exif[number] = value
    if taken:
        exif[0x8769] = taken
    if gps:
        exif[0x8825] = gps
    Image.new("RGB", size, (90, 120, 40)).save(path, exif=exif, xmp=by_attributes(values or {}))


def tags_of(path: Path) -> PhotoTags:
    with Image.open(path) as picture:
        return read_tags(picture)


# ---------------------------------------------------------------------------------------------------------- XMP


@pytest.mark.parametrize("spelling", [by_attributes, by_elements])
def test_both_spellings_of_xmp_are_read(spelling: Any) -> None:
    packet = spelling(VALUES)
    assert read_drone_tags(packet) == EXPECTED
    assert read_drone_tags(packet.decode()) == EXPECTED
    assert read_drone_tags(b"\n \0" + packet + b"\0\0\n") == EXPECTED  # padding


def test_no_packet_and_a_foreign_one_say_nothing() -> None:
    assert read_drone_tags(None) == read_drone_tags(b"") == read_drone_tags("") == DroneTags()
    assert read_drone_tags(by_attributes({})) == DroneTags()
    other = by_attributes(VALUES).replace(b"http://www.dji.com/drone-dji/1.0/", b"http://example.org/other/")
    assert read_drone_tags(other) == DroneTags()


@pytest.mark.parametrize("spelling", [by_attributes, by_elements])
def test_a_packet_cut_off_anywhere_is_a_doubt_and_no_crash(spelling: Any) -> None:
    packet = spelling(VALUES)
    end = packet.index(b"</x:xmpmeta>") + len(b"</x:xmpmeta>")
    for length in range(1, len(packet)):
        got = read_drone_tags(packet[:length])
        if length < end:
            assert got.doubts == ("its XMP packet is damaged",) or got == DroneTags(), length
            assert got.gimbal is None
        else:
            assert got == EXPECTED or got.doubts == ("its XMP packet is damaged",)


def test_a_packet_with_a_byte_changed_is_values_or_a_doubt() -> None:
    packet, rng = by_attributes(VALUES), np.random.default_rng(7)
    doubted = 0
    for _ in range(1500):
        damaged = bytearray(packet)
        damaged[rng.integers(len(damaged))] = rng.integers(256)
        got = read_drone_tags(bytes(damaged))
        doubted += bool(got.doubts)
        if got.position_sigma is not None:
            assert min(got.position_sigma) > 0
            assert np.isfinite(got.position_sigma).all()
    assert doubted > 300


BOMB = b"""<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">
<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;"><!ENTITY d "&c;&c;&c;&c;&c;&c;&c;&c;&c;&c;">]><r>&d;&d;&d;&d;</r>"""
EXTERNAL = b'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/hostname">]><r>&f;</r>'
DTD_ONLY = b'<!DOCTYPE r SYSTEM "http://127.0.0.1/none.dtd"><r/>'


@pytest.mark.parametrize("packet", [BOMB, EXTERNAL, DTD_ONLY], ids=["bomb", "file", "dtd"])
def test_entities_and_dtds_are_refused_with_a_doubt(packet: bytes, tmp_path: Path) -> None:
    assert read_drone_tags(packet) == DroneTags(doubts=("its XMP packet is damaged",))
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", xmp=packet)
    assert scene_from_photos(tmp_path).warnings == ("1 of 1 photos: its XMP packet is damaged (a.jpg)",)


def test_a_packet_of_a_mebibyte_is_not_parsed_and_one_deep_as_a_well_is_no_crash() -> None:
    large = by_attributes({**VALUES, "Comment": "x" * (1 << 20)})
    assert read_drone_tags(large).doubts == ("its XMP packet is longer than a mebibyte and was left out",)
    deep = b"<a>" * 100_000 + b"</a>" * 100_000
    assert read_drone_tags(deep) == DroneTags()
    assert read_drone_tags(b"<a>" * 100_000).doubts == ("its XMP packet is damaged",)


@pytest.mark.parametrize(
    ("text", "doubt"),
    [
        ("NaN", "GimbalPitchDegree is nan, which cannot be"),
        ("inf", "GimbalPitchDegree is inf, which cannot be"),
        ("-Infinity", "GimbalPitchDegree is -inf, which cannot be"),
        ("1e999", "GimbalPitchDegree is inf, which cannot be"),
        ("361", "GimbalPitchDegree is 361, which cannot be"),
        ("steep", "GimbalPitchDegree is no number"),
        ("-45,6", "GimbalPitchDegree is no number"),
        ("0x10", "GimbalPitchDegree is no number"),
    ],
)
def test_a_gimbal_angle_that_cannot_be_leaves_the_gimbal_out(text: str, doubt: str) -> None:
    got = read_drone_tags(by_attributes({**VALUES, "GimbalPitchDegree": text}))
    assert got.gimbal is None
    assert got.doubts == (doubt,)
    assert got.flight == EXPECTED.flight  # the rest is kept


@pytest.mark.parametrize("text", ["NaN", "1e999", "-1e999", "50001", "high"])
def test_a_relative_altitude_that_cannot_be_is_left_out(text: str) -> None:
    got = read_drone_tags(by_attributes({**VALUES, "RelativeAltitude": text}))
    assert got.relative_altitude is None
    assert len(got.doubts) == 1
    assert got.doubts[0].startswith("RelativeAltitude is ")


@pytest.mark.parametrize("missing", ["GimbalPitchDegree", "GimbalYawDegree"])
def test_without_pitch_or_yaw_there_is_no_attitude(missing: str) -> None:
    for values in ({k: v for k, v in VALUES.items() if k != missing}, {**VALUES, missing: " "}):
        got = read_drone_tags(by_attributes(values))
        assert got.gimbal is None
        assert got.doubts == ()


def test_without_roll_it_is_level() -> None:
    values = {name: text for name, text in VALUES.items() if name != "GimbalRollDegree"}
    assert read_drone_tags(by_attributes(values)).gimbal == Attitude(-12.3, -45.6, 0.0)


@pytest.mark.parametrize(
    ("sigma", "doubt"),
    [
        (("0", "0", "0"), None),  # written so without RTK
        (("0.01", "0", "0.02"), "an RTK accuracy is not above 0"),
        (("-0.01", "0.01", "0.02"), "an RTK accuracy is not above 0"),
        (("-1", "-1", "-1"), "an RTK accuracy is not above 0"),
        (("0.01", "nan", "0.02"), "RtkStdLat is nan, which cannot be"),
        (("0.01", "1001", "0.02"), "RtkStdLat is 1001, which cannot be"),
        (("0.01", "?", "0.02"), "RtkStdLat is no number"),
    ],
)
def test_rtk_accuracies_that_cannot_be_are_left_out(sigma: tuple[str, str, str], doubt: str | None) -> None:
    names = ("RtkStdLon", "RtkStdLat", "RtkStdHgt")
    got = read_drone_tags(by_attributes({**VALUES, **dict(zip(names, sigma, strict=True))}))
    assert got.position_sigma is None
    assert got.doubts == (() if doubt is None else (doubt,))


@pytest.mark.parametrize(("kind", "expected"), [("RtkAlt", True), ("GpsFusionAlt", False), ("", None)])
def test_the_kind_of_altitude_is_read(kind: str, expected: bool | None) -> None:
    assert read_drone_tags(by_attributes({**VALUES, "AltitudeType": kind})).above_ellipsoid is expected


# ----------------------------------------------------------------------------------------- EXIF beside the XMP


@pytest.mark.parametrize("value", [0, 9])
def test_an_orientation_that_cannot_be_is_a_doubt(tmp_path: Path, value: int) -> None:
    photo(tmp_path / "a.jpg", base={0x0112: value})
    tags = tags_of(tmp_path / "a.jpg")
    assert tags.orientation is None
    assert tags.doubts == (f"its orientation tag is {value}, expected 1 to 8; it is taken as upright",)


def test_turned_photos_and_mixed_formats_are_told(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg", base={0x0112: 1})
    photo(tmp_path / "2.jpg", base={0x0112: 6})
    assert scene_from_photos(tmp_path).warnings == (
        "1 of 2 photos: to be shown turned, by their orientation tag; the pixels are used as they are stored "
        "(2.jpg)",
    )
    photo(tmp_path / "2.jpg", size=(30, 40))
    found = scene_from_photos(tmp_path)
    assert found.warnings == (
        "1 of 2 photos: portrait format among landscape ones; each format gets a camera of its own (2.jpg)",
    )
    assert [frame.camera_id for frame in found.scene.frames] == [1, 2]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({2: (0.0, 0.0, 0.0), 4: (0.0, 0.0, 0.0)}, "it is 0, 0, which receivers without a fix write"),
        ({6: 99_999.0}, "the altitude is 99999 m, expected -1000 to 50000"),
        ({5: b"\x01", 6: 5000.0}, "the altitude is -5000 m, expected -1000 to 50000"),
    ],
)
def test_places_that_cannot_be_are_left_out_and_the_attitude_is_kept(
    tmp_path: Path, change: dict[int, Any], why: str
) -> None:
    photo(tmp_path / "1.jpg", VALUES, gps=GPS)
    photo(tmp_path / "2.jpg", VALUES, gps={**GPS, **change})
    found = scene_from_photos(tmp_path)
    assert found.warnings == (
        f"1 of 2 photos: GPS position left out: {why} (2.jpg)",
        "1 of 2 photos: no GPS position, which 1 others have (2.jpg)",
    )
    prior = found.scene.frames[1].prior
    assert prior is not None
    assert prior.position is None
    assert prior.position_sigma is None  # an accuracy of nothing
    np.testing.assert_array_equal(prior.rotation, cam_from_enu(Attitude(-12.3, -45.6, 0.5)))


def test_a_photo_without_gps_among_photos_with_it_has_no_position(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg")
    photo(tmp_path / "2.jpg", gps=GPS)
    found = scene_from_photos(tmp_path)
    assert found.warnings == ("1 of 2 photos: no GPS position, which 1 others have (1.jpg)",)
    assert found.scene.frames[0].prior is None
    origin, second = found.scene.georeference, found.scene.frames[1].prior
    assert origin is not None
    assert (origin.latitude, origin.longitude, origin.altitude) == (48.5, 9.0, 600.0)  # of the first that has one
    assert second is not None
    np.testing.assert_allclose(second.position, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("reference", "kind", "expected"),
    [(b"\x00", "", False), (b"\x02", "", True), (None, "", None), (b"\x00", "RtkAlt", True)],
)
def test_xmp_overrules_exif_on_what_the_altitude_is_above(
    tmp_path: Path, reference: bytes | None, kind: str, expected: bool | None
) -> None:
    gps = {number: value for number, value in {**GPS, 5: reference}.items() if value is not None}
    photo(tmp_path / "a.jpg", {"AltitudeType": kind}, gps=gps)
    assert tags_of(tmp_path / "a.jpg").above_ellipsoid is expected


# -------------------------------------------------------------------------------------------------------- times


@pytest.mark.parametrize(
    ("fraction", "offset", "expected"),
    [
        (None, None, 0.0),
        ("5", None, 0.5),
        ("050 ", None, 0.05),
        ("123456789123", None, 0.123456789),
        ("x", None, 0.0),
        (None, "+02:00", -7200.0),
        ("25", "-05:30", 19800.25),
        (None, "   :  ", 0.0),  # EXIF's way to say that it is unknown
    ],
)
def test_the_capture_time_has_fraction_and_offset(
    tmp_path: Path, fraction: str | None, offset: str | None, expected: float
) -> None:
    taken = {0x9003: "2026:06:01 10:00:00", 0x9291: fraction, 0x9011: offset}
    photo(tmp_path / "a.jpg", taken={number: text for number, text in taken.items() if text is not None})
    tags = tags_of(tmp_path / "a.jpg")
    assert tags.doubts == ()
    start = datetime(2026, 6, 1, 10, tzinfo=UTC).timestamp()
    assert tags.time == pytest.approx(start + expected, abs=1e-6, rel=0)


@pytest.mark.parametrize("text", ["2026:13:01 10:00:00", "yesterday", "2026-06-01T10:00:00"])
def test_a_capture_time_that_is_none_is_a_doubt(tmp_path: Path, text: str) -> None:
    photo(tmp_path / "a.jpg", taken={0x9003: text})
    tags = tags_of(tmp_path / "a.jpg")
    assert tags.time is None
    assert tags.doubts == (f"capture time left out: '{text}' is not year:month:day hour:minute:second",)


@pytest.mark.parametrize("text", ["0000:00:00 00:00:00", "    :  :     :  :  "])
def test_a_clock_that_was_never_set_says_nothing(tmp_path: Path, text: str) -> None:
    photo(tmp_path / "a.jpg", taken={0x9003: text})
    assert tags_of(tmp_path / "a.jpg") == PhotoTags()


def test_times_of_frames_count_from_the_first_taken(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg", taken={0x9003: "2026:06:01 12:00:02", 0x9291: "5", 0x9011: "+02:00"})
    photo(tmp_path / "2.jpg", taken={0x9003: "2026:06:01 10:00:01", 0x9011: "+00:00"})
    photo(tmp_path / "3.jpg")
    times = [frame.time for frame in scene_from_photos(tmp_path).scene.frames]
    assert times == [pytest.approx(1.5, abs=1e-6), 0.0, None]


# ------------------------------------------------------------------------------------------------------- priors


def test_priors_have_the_gimbals_rotation_and_the_receivers_accuracy(tmp_path: Path) -> None:
    photo(tmp_path / "1.jpg", VALUES, gps=GPS)
    photo(tmp_path / "2.jpg", {"GimbalYawDegree": "90", "GimbalPitchDegree": "-90"}, gps=GPS)
    photo(tmp_path / "3.jpg", gps=GPS)
    found = scene_from_photos(tmp_path)
    # Only the first has an RTK height.
    assert [text.split(": ", 1)[1].split(",")[0] for text in found.warnings] == ["altitude above the ellipsoid"]
    first, second, third = (frame.prior for frame in found.scene.frames)
    assert first is not None
    assert second is not None
    assert third is not None
    np.testing.assert_array_equal(first.rotation, cam_from_enu(Attitude(-12.3, -45.6, 0.5)))
    np.testing.assert_array_equal(first.position_sigma, [0.01, 0.02, 0.03])  # east, north, up
    # Straight down, heading east: right is south, the picture's lower edge is west.
    np.testing.assert_allclose(second.rotation, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-12)
    assert second.position_sigma is None
    assert third.rotation is None
    assert all(prior.rotation_sigma is None for prior in (first, second, third))


def test_damage_to_a_whole_photo_is_a_doubt_or_values(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    photo(path, VALUES, gps=GPS, base={0x0112: 1}, taken={0x9003: "2026:06:01 10:00:00"})
    whole, rng = path.read_bytes(), np.random.default_rng(2)
    end, doubted = whole.index(b"\xff\xdb"), 0
    for _ in range(400):
        damaged = bytearray(whole)
        for place in rng.integers(24, end, size=2):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            with open_picture(path) as picture:
                tags = read_tags(picture)
        except DataError:
            continue
        doubted += bool(tags.doubts)
        for number in (tags.relative_altitude, tags.time, *(tags.position or ()), *(tags.position_sigma or ())):
            assert number is None or math.isfinite(number)
    assert doubted > 50
