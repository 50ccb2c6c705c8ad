"""RPC cameras in all the files that they come in."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rpc_samples import (
    RPC,
    WRITERS,
    apart,
    digital_globe_xml,
    dimap,
    gdal_reads,
    rpb,
    rpc_txt,
    sample_rpc,
    write,
    write_picture,
)

from toolkit.errors import DataError, MissingDependencyError
from toolkit.geometry.rpc import Rpc
from toolkit.scene import raster_io
from toolkit.scene.rpc_fields import LARGEST, fields_from_rpc, rpc_from_fields
from toolkit.scene.rpc_files import picture_rpc, read_rpc, side_file

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'sightline-toolkit[geo]'")

FORMATS = sorted(WRITERS)


def outcome_of(path: Path) -> Rpc | str:
    """Return the RPC in a file, or why there is none."""
    try:
        return read_rpc(path).rpc
    except DataError as error:
        return str(error)


# ------------------------------------------------------------------------------------------------ what is written


@pytest.mark.parametrize("name", FORMATS)
def test_every_number_is_read_to_the_bit(tmp_path: Path, name: str) -> None:
    found = read_rpc(write(tmp_path, name))
    assert found.rpc == RPC
    assert found.path == tmp_path / name


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from(FORMATS))
def test_any_rpc_is_read_to_the_bit(tmp_path_factory: pytest.TempPathFactory, seed: int, name: str) -> None:
    rpc = sample_rpc(seed)
    path = tmp_path_factory.mktemp("rpc") / name
    path.write_text(WRITERS[name](rpc))
    assert read_rpc(path).rpc == rpc


def test_a_tag_keeps_fifteen_digits(tmp_path: Path) -> None:
    found = read_rpc(write_picture(tmp_path / "a.tif", RPC))
    assert (found.kind, found.width, found.height) == ("GeoTIFF tags", 400, 300)
    # GDAL hands the tag's doubles on as text of 15 digits; the numbers are of size 1, the picture of size 200.
    assert apart(found.rpc, RPC) < 1e-11


def test_fields_are_their_own_inverse() -> None:
    assert rpc_from_fields(fields_from_rpc(RPC), "here") == RPC


def test_what_else_files_tell(tmp_path: Path) -> None:
    def told(name: str) -> tuple[object, ...]:
        found = read_rpc(write(tmp_path, name))
        return found.kind, found.width, found.height, found.sun_elevation, found.sun_azimuth, found.acquired

    utc = UTC
    assert told("a_RPC.TXT") == ("RPC text", None, None, None, None, None)
    assert told("a.json") == ("JSON", 400, 300, 50.8, 150.3, datetime(2014, 10, 5, 16, 1, 38, tzinfo=utc))
    assert told("a.geom") == ("OTB geometry", 400, 300, 59.8, 149.0, datetime(2013, 8, 5, 10, 42, 19, 497058, utc))
    west = datetime(2015, 9, 30, 10, 56, 56, 973685, utc)
    assert told("a.xml") == ("DigitalGlobe XML", 400, 300, 40.3, 162.1, west)
    assert told("DIM_a.XML")[:3] == ("DIMAP 1", 400, 300)
    assert told("RPC_a.XML")[0] == "DIMAP 2"


def test_the_description_beside_tells_size_sun_and_time(tmp_path: Path) -> None:
    sun = "<Solar_Incidences><SUN_AZIMUTH>{0}</SUN_AZIMUTH><SUN_ELEVATION>{1}</SUN_ELEVATION></Solar_Incidences>"
    (tmp_path / "DIM_a.XML").write_text(
        "<Dimap_Document><Raster_Data><Raster_Dimensions><NROWS>300</NROWS><NCOLS>400</NCOLS></Raster_Dimensions>"
        "</Raster_Data><Strip_Source><IMAGING_DATE>2013-08-05</IMAGING_DATE>"
        "<IMAGING_TIME>10:42:19.4Z</IMAGING_TIME></Strip_Source>"
        + "".join(sun.format(149 + i, 60 + i) for i in range(3))
        + "</Dimap_Document>"
    )
    found = read_rpc(write(tmp_path, "RPC_a.XML"))
    assert (found.width, found.height, found.sun_azimuth, found.sun_elevation) == (400, 300, 150, 61)
    assert found.acquired == datetime(2013, 8, 5, 10, 42, 19, 400000, UTC)
    (tmp_path / "a.IMD").write_text(
        "numRows = 300;\nnumColumns = 400;\nBEGIN_GROUP = IMAGE_1\n\tfirstLineTime = 2009-10-08T15:51:45.123456Z;\n"
        "\tmeanSunAz = 160.1;\n\tmeanSunEl = 50.2;\nEND_GROUP = IMAGE_1\nEND;\n"
    )
    found = read_rpc(write(tmp_path, "a.RPB"))
    assert (found.width, found.height, found.sun_azimuth, found.sun_elevation) == (400, 300, 160.1, 50.2)
    assert found.acquired == datetime(2009, 10, 8, 15, 51, 45, 123456, UTC)


def test_nonsense_about_sun_and_time_is_left_out(tmp_path: Path) -> None:
    record = json.loads(WRITERS["a.json"](RPC))
    record |= {"sun_elevation": "n/a", "sun_azimuth": 4000, "acquisition_date": "yesterday"}
    found = read_rpc(write(tmp_path, "a.json", json.dumps(record)))
    assert (found.sun_elevation, found.sun_azimuth, found.acquired) == (None, None, None)


def test_names_of_rasterio_and_lists_of_numbers_are_read(tmp_path: Path) -> None:
    fields = {key.lower(): value for key, value in fields_from_rpc(RPC).items()}
    assert read_rpc(write(tmp_path, "b.json", json.dumps({"rpc": fields}))).rpc == RPC
    lists = {
        k: [float(v) for v in value.split()] if "COEFF" in k else float(value)
        for k, value in fields_from_rpc(RPC).items()
    }
    assert read_rpc(write(tmp_path, "c.json", json.dumps(lists))).rpc == RPC


# -------------------------------------------------------------------------------------------------- GDAL as judge


@pytest.mark.parametrize(
    ("picture", "beside", "text"),
    [
        ("a.tif", "a_RPC.TXT", rpc_txt(RPC)),
        ("a.tif", "a.RPB", rpb(RPC)),
        ("a.tif", "a.XML", digital_globe_xml(RPC)),
        ("IMG_a_R1C1.TIF", "RPC_a.XML", dimap(RPC)),
    ],
)
def test_gdal_reads_the_same(tmp_path: Path, picture: str, beside: str, text: str) -> None:
    write_picture(tmp_path / picture)
    (tmp_path / beside).write_text(text)
    mine = picture_rpc(tmp_path / picture, side_file(tmp_path / picture))
    assert mine is not None
    assert mine.path == tmp_path / beside
    assert mine.rpc == RPC
    # GDAL writes DIMAP's offsets, from which it takes 1, with 15 digits.
    assert apart(gdal_reads(tmp_path / picture), RPC) < 1e-11


def test_gdal_reads_what_is_written_into_tags(tmp_path: Path) -> None:
    path = write_picture(tmp_path / "a.tif", RPC)
    assert gdal_reads(path) == read_rpc(path).rpc


# ------------------------------------------------------------------------------------------------ bad files


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_cut_off_anywhere_is_an_error_or_whole(tmp_path: Path, name: str) -> None:
    whole = WRITERS[name](RPC).encode()
    path = tmp_path / name
    # The end, where only the last number could suffer, at every byte.
    for length in [*range(0, len(whole) - 60, 53), *range(max(0, len(whole) - 60), len(whole))]:
        path.write_bytes(whole[:length])
        outcome = outcome_of(path)
        assert outcome == RPC or str(path) in str(outcome), length


WORDS = {word.encode() for value in fields_from_rpc(RPC).values() for word in value.split()}
# Where they stand, after the declaration of XML, whose version is 1.0, too.
PLACES = {
    name: [
        mark.span()
        for mark in re.finditer(rb"-?\d+\.\d+(e-\d+)?", WRITERS[name](RPC).encode())
        if mark[0] in WORDS and mark.start() > 60
    ]
    for name in FORMATS
}


@settings(max_examples=150)
@given(
    name=st.sampled_from(FORMATS),
    where=st.integers(0, 200),
    value=st.sampled_from(["nan", "inf", "-Infinity", "1e999", "", "x", "1_0.5", "0x10", "1,5", "--1", "null"]),
)
def test_a_number_that_is_none_is_an_error(
    tmp_path_factory: pytest.TempPathFactory, name: str, where: int, value: str
) -> None:
    text = WRITERS[name](RPC).encode()
    start, end = PLACES[name][where % len(PLACES[name])]
    path = tmp_path_factory.mktemp("bad") / name
    path.write_bytes(text[:start] + value.encode() + text[end:])
    with pytest.raises(DataError, match=re.escape(str(path))):
        read_rpc(path)


@settings(max_examples=150)
@given(name=st.sampled_from([*FORMATS, "a.tif", "a.ntf"]), data=st.binary(max_size=300))
def test_junk_is_an_error(tmp_path_factory: pytest.TempPathFactory, name: str, data: bytes) -> None:
    path = tmp_path_factory.mktemp("junk") / name
    path.write_bytes(data)
    with pytest.raises(DataError, match=re.escape(str(path))):
        read_rpc(path)


@settings(max_examples=150)
@given(
    name=st.sampled_from(FORMATS),
    where=st.floats(0, 1),
    junk=st.binary(min_size=1, max_size=8),
    cut=st.integers(0, 40),
)
def test_damage_in_the_middle_is_an_error_or_an_rpc(
    tmp_path_factory: pytest.TempPathFactory, name: str, where: float, junk: bytes, cut: int
) -> None:
    whole = WRITERS[name](RPC).encode()
    at = int(where * len(whole))
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_bytes(whole[:at] + junk + whole[at + cut :])
    outcome = outcome_of(path)
    if isinstance(outcome, Rpc):
        assert np.isfinite([outcome.line_scale, *outcome.line_num]).all()
    else:
        assert path.name in outcome


def swap(old: str, new: str) -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "a_RPC.TXT",
            swap("LINE_SCALE: 150.0", "LINE_SCALE: 0.0"),
            r"RPC in .*a_RPC\.TXT cannot be used; found RPC has line_scale zero",
        ),
        ("a_RPC.TXT", swap("LAT_SCALE:", "LAT_SCALA:"), r"has no LAT_SCALE; .*Was the file cut off\?"),
        (
            "a_RPC.TXT",
            swap("LINE_NUM_COEFF_7:", "LINE_NUM_COEFF_27:"),
            r"Cannot read LINE_NUM_COEFF in .*expected 20 coefficients; found 0",
        ),
        (
            "a_RPC.TXT",
            swap("SAMP_DEN_COEFF_20:", "SAMP_DEN_COEFF_21:"),
            r"Cannot read SAMP_DEN_COEFF in .*expected 20",
        ),
        (
            "a_RPC.TXT",
            swap("LAT_OFF: 43.26", "LAT_OFF: 143.26"),
            r"RPC in .* is of no place on Earth; .*found 143\.26",
        ),
        (
            "a_RPC.TXT",
            swap("LINE_OFF: 149.5", "LINE_OFF: 149.5\nLINE_OFF: 3"),
            r"has 'LINE_OFF' twice; found 149\.5 and 3",
        ),
        ("a_RPC.TXT", swap("LINE_DEN_COEFF_1: 1.0", "LINE_DEN_COEFF_1: 0.0"), r"line_den changes its sign"),
        ("a.RPB", swap("RPC00B", "RPC00A"), r"SpecId of .*a\.RPB is no RPC00B; .*found 'RPC00A'"),
        (
            "a.RPB",
            swap("lineNumCoef = (", "lineNumCoef = (1.0,"),
            r"Cannot read LINE_NUM_COEFF in .*found 21 of them",
        ),
        ("a.RPB", swap("END_GROUP = IMAGE", ""), r"a\.RPB is cut off or no \.RPB file"),
        ("a.geom", swap("polynomial_format:  B", "polynomial_format:  A"), r"polynomial_format of .* is no RPC00B"),
        ("a.geom", swap("type:  ossimPleiadesModel", "kind:  x"), r"cut off or no geometry of the Orfeo ToolBox"),
        (
            "a.geom",
            swap("number_lines:  300", "number_lines:  3.5"),
            r"Cannot read the height in .*a\.geom; expected 1 to",
        ),
        (
            "RPC_a.XML",
            swap('version="2.15"', 'version="3.0"'),
            r"version of DIMAP that is not read; expected version 1 or 2; found version 3",
        ),
        ("RPC_a.XML", swap(' version="2.15"', ""), r"expected version 1 or 2; found no version"),
        (
            "RPC_a.XML",
            swap("<Inverse_Model><LINE_NUM_COEFF_1>", "<Inverse_Model><X>"),
            r"RPC_a\.XML is cut off or no XML; found mismatched tag",
        ),
        ("RPC_a.XML", swap("Global_RFM>", "Global_XXX>"), r"mismatched tag"),
        ("DIM_a.XML", swap("<F_COL>", "<F_COL>1.0 "), r"Cannot read SAMP_DEN_COEFF in .*found 21 of them"),
        ("a.xml", swap("<SPECID>RPC00B", "<SPECID>RPC00A"), r"SPECID of .* is no RPC00B"),
        ("a.json", swap('"row_scale": 150.0', '"row_scale": 0'), r"line_scale zero"),
        ("a.json", swap('"row_scale": 150.0', '"row_scale": true'), r"Cannot read LINE_SCALE in .*found True"),
        ("a.json", swap('"row_num": [', '"row_num": [1, '), r"Cannot read LINE_NUM_COEFF in .*found 21 of them"),
        ("a.json", swap('"rpc": {', '"other": {'), r"a\.json has no RPC; expected a table with 'LINE_OFF'"),
        ("a.json", swap('"width": 400', '"width": -4'), r"Cannot read the width in .*a\.json"),
    ],
)
def test_each_fault_is_named(tmp_path: Path, name: str, change: Callable[[str], str], message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_rpc(write(tmp_path, name, change(WRITERS[name](RPC))))


def test_a_text_without_its_last_line_break_may_be_cut_off(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"may be cut off; expected a line break .*Copy it again"):
        read_rpc(write(tmp_path, "a_RPC.TXT", rpc_txt(RPC).rstrip()))


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;">]><isd>&b;</isd>'
OUTSIDE = '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><isd>&a;</isd>'


@pytest.mark.parametrize("text", [BOMB, OUTSIDE])
def test_entities_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(DataError, match=r"a\.xml declares entities, which no RPC needs"):
        read_rpc(write(tmp_path, "a.xml", text))


@pytest.mark.parametrize("name", FORMATS)
def test_a_huge_file_is_not_read(tmp_path: Path, name: str) -> None:
    with (tmp_path / name).open("wb") as handle:
        handle.truncate(LARGEST + 1)
    with pytest.raises(DataError, match=r"is too large for a file with an RPC; expected at most 32 MiB"):
        read_rpc(tmp_path / name)


@pytest.mark.parametrize("name", [*FORMATS, "a.tif"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=rf"{re.escape(name)} is missing"):
        read_rpc(tmp_path / name)


def test_deeply_nested_json_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a JSON file"):
        read_rpc(write(tmp_path, "a.json", "[" * 100_000))


def test_a_picture_cut_off_is_an_error_or_whole_in_its_tags(tmp_path: Path) -> None:
    whole = write_picture(tmp_path / "a.tif", RPC).read_bytes()
    path = tmp_path / "b.tif"
    outcomes = []
    for length in (0, 3, 8, 100, 200, 500, 1000, 2000, len(whole) - 1):
        path.write_bytes(whole[:length])
        outcomes.append(outcome_of(path))
    assert all("b.tif is cut off, damaged or neither" in str(outcome) for outcome in outcomes[:3])
    right = read_rpc(tmp_path / "a.tif").rpc
    assert all(outcome == right or "b.tif" in str(outcome) for outcome in outcomes)


def test_a_picture_without_rpc_says_so(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Picture .*a\.tif has no RPC in its tags"):
        read_rpc(write_picture(tmp_path / "a.tif"))
    assert picture_rpc(tmp_path / "a.tif", side_file(tmp_path / "a.tif")) is None


def test_a_list_of_other_files_dressed_as_tiff_is_not_followed(tmp_path: Path) -> None:
    secret = write_picture(tmp_path / "secret.tif", RPC)
    (tmp_path / "a.tif").write_text(
        '<VRTDataset rasterXSize="400" rasterYSize="300"><VRTRasterBand dataType="UInt16" band="1"><SimpleSource>'
        f"<SourceFilename>{secret}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with pytest.raises(DataError, match="neither GeoTIFF nor NITF"):
        read_rpc(tmp_path / "a.tif")


def test_without_rasterio_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(module: str) -> None:
        raise MissingDependencyError(f"The package '{module}' cannot be imported")

    path = write_picture(tmp_path / "a.tif", RPC)
    monkeypatch.setattr(raster_io, "require", missing)
    with pytest.raises(MissingDependencyError, match="'rasterio' cannot be imported"):
        read_rpc(path)
