"""Ground control points as OpenDroneMap's gcp_list.txt."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.errors import DataError
from toolkit.scene.ground_control import GroundControl, read_gcp_list, write_gcp_list

UTM = "+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
LIST = f"""{UTM}
333158.20\t3102916.18\t3\t539.886\t333.744\tDJI_0065.JPG\tnorth
333187.62 3102954.46 3.5 286.936 0 DJI_0065.JPG
333158.20\t3102916.18\t3\t541.372\t392.054\tDJI_0066.JPG\tnorth\tsome more words

# 1 2 3 4 5 a comment
333187.620 3102954.46 3.50 100 200 DJI_0067.JPG
"""


def read(tmp_path: Path, content: str | bytes) -> GroundControl:
    path = tmp_path / "gcp_list.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_gcp_list(path)


def assert_same(mine: GroundControl, theirs: GroundControl) -> None:
    assert (mine.crs, mine.names, mine.images) == (theirs.crs, theirs.names, theirs.images)
    for name in ("xyz", "point_indices", "pixels"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name), err_msg=name)


def test_rows_become_points_and_observations(tmp_path: Path) -> None:
    gcp = read(tmp_path, LIST)
    assert gcp.crs == UTM
    assert gcp.names == ("north", "")
    assert gcp.xyz.tolist() == [[333158.2, 3102916.18, 3], [333187.62, 3102954.46, 3.5]]
    assert gcp.point_indices.tolist() == [0, 1, 0, 1]
    assert gcp.images == ("DJI_0065.JPG", "DJI_0065.JPG", "DJI_0066.JPG", "DJI_0067.JPG")
    # As they stand in the file: both count from the picture's corner.
    assert gcp.pixels.tolist() == [[539.886, 333.744], [286.936, 0], [541.372, 392.054], [100, 200]]


@pytest.mark.parametrize(
    "changed",
    [
        LIST.replace("\n", "\r\n"),
        "\ufeff" + LIST,
        "\n\n# made by hand\n" + LIST,
        LIST.rstrip(),
        LIST.replace(UTM, f"  {UTM}\t"),
        LIST.replace(UTM, f"'{UTM}'"),
    ],
)
def test_other_editors_files_are_read_the_same(tmp_path: Path, changed: str) -> None:
    assert_same(read(tmp_path, LIST), read(tmp_path, changed))


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
WORDS = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=8)


@st.composite
def lists(draw: st.DrawFn) -> GroundControl:
    names = draw(st.lists(WORDS, min_size=1, max_size=5, unique=True))
    unnamed = draw(st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), max_size=3, unique=True))
    points = len(names) + len(unnamed)
    xyz = [*(draw(st.tuples(NUMBERS, NUMBERS, NUMBERS)) for _ in names), *unnamed]
    indices = sorted([*range(points), *draw(st.lists(st.integers(0, points - 1), max_size=8))])
    pixels = st.floats(min_value=0, allow_infinity=False)
    return GroundControl(
        crs=draw(st.sampled_from([UTM, "EPSG:2180", "WGS84 UTM 16N", "epsg:4326"])),
        xyz=np.array(xyz),
        names=(*names, *[""] * len(unnamed)),
        point_indices=np.array(indices),
        images=tuple(draw(WORDS) for _ in indices),
        pixels=np.array([[draw(pixels), draw(pixels)] for _ in indices]),
    )


@settings(max_examples=80)
@given(lists())
def test_a_list_survives_to_the_bit(gcp: GroundControl) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_gcp_list(gcp, Path(folder) / "a.txt")
        assert_same(read_gcp_list(Path(folder) / "a.txt"), gcp)


def test_observations_of_a_point_are_written_beside_each_other(tmp_path: Path) -> None:
    write_gcp_list(read(tmp_path, LIST), tmp_path / "b.txt")
    again = read_gcp_list(tmp_path / "b.txt")
    assert again.point_indices.tolist() == [0, 0, 1, 1]
    assert again.images == ("DJI_0065.JPG", "DJI_0066.JPG", "DJI_0065.JPG", "DJI_0067.JPG")
    assert (tmp_path / "b.txt").read_text().splitlines()[1] == (
        "333158.2\t3102916.18\t3.0\t539.886\t333.744\tDJI_0065.JPG\tnorth"
    )


def test_a_file_cut_off_at_any_byte_is_an_error_or_whole_rows(tmp_path: Path) -> None:
    """A text without end mark: only the last row may be shorter than it was, and nothing is made up."""
    content = LIST.encode()
    whole = read(tmp_path, content)
    read_well = 0
    for length in range(len(content)):
        try:
            gcp = read(tmp_path, content[:length])
        except DataError as error:
            assert "gcp_list.txt" in str(error)  # noqa: PT017
            continue
        read_well += 1
        rows = len(gcp.images) - 1
        assert gcp.images[:rows] == whole.images[:rows]
        assert whole.images[rows].startswith(gcp.images[rows])
        np.testing.assert_array_equal(gcp.pixels, whole.pixels[: rows + 1])
    assert read_well > 50


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", r"gcp_list\.txt is empty; expected a coordinate system in its first line: 'EPSG:n'"),
        ("\n # nothing\n", r"gcp_list\.txt is empty"),
        (UTM, r"has no ground control points; expected rows after the coordinate system"),
        (b"EPSG:4326\n\xff\xfe", r"Cannot read .*; expected a gcp_list\.txt; found 'utf-8' codec"),
        (
            LIST.replace(UTM, "EPSG:99999999"),
            r"Unknown coordinate system in line 1 of .*; found 'EPSG:99999999'\. epsg",
        ),
        (LIST.replace(UTM, "+proj=nonsense"), r"expected 'EPSG:n', 'WGS84 UTM 16N' .*; found '\+proj=nonsense'"),
        (LIST.replace(UTM, "WGS84 UTM 61N"), r"Unknown coordinate system .*; found 'WGS84 UTM 61N'"),
        (LIST.replace(UTM, "WGS84 UTM 16"), r"Unknown coordinate system .*; found 'WGS84 UTM 16'"),
        (LIST.replace(UTM, "Gauss-Krüger"), r"Unknown coordinate system .*; found 'Gauss-Krüger'"),
        (LIST.replace(UTM, "\n" + "+proj" * 999), r"Unknown coordinate system in line 2 of"),
        (LIST.split("\n", 1)[1], r"Unknown coordinate system in line 1 of .*; found '333158"),
        (
            LIST.replace(UTM, "EPSG:4978"),
            r"line 1 of .* has no east and north; .*found 'EPSG:4978' \(Geocentric CRS\)",
        ),
        (
            LIST.replace(" DJI_0067.JPG", ""),
            r"Too few columns in line 7 of .*geo_x .*; found 5 columns: '333187\.620",
        ),
        (LIST.replace("3.50", "3,50"), r"geo_z is no finite number in line 7 of .*; found '3,50'"),
        (LIST.replace("333187.620", "nan"), r"geo_x is no finite number in line 7 of .*; found 'nan'"),
        (LIST.replace("100 200", "inf 200"), r"im_x is no finite number in line 7 of .*; found 'inf'"),
        (
            LIST.replace("100 200", "100 -0.5"),
            r"negative pixel im_y in line 7 of .*; expected 0 or more .*found -0\.5",
        ),
        (
            LIST.replace("333158.20\t3102916.18\t3\t541", "333158.20\t3102916.18\t4\t541"),
            r"Lines 2 and 4 of .* give the point 'north' different coordinates; expected \[333158\.2, .*, 3\.0\]; "
            r"found \[333158\.2, .*, 4\.0\]\. Correct one",
        ),
    ],
)
def test_each_fault_is_named_with_its_line(tmp_path: Path, content: str | bytes, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(tmp_path, content)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.txt is missing; expected a gcp_list\.txt"):
        read_gcp_list(tmp_path / "none.txt")


SOUND: dict[str, Any] = {
    "crs": UTM,
    "xyz": np.array([[333158.2, 3102916.18, 3.0], [333187.0, 3102954.0, 3.5]]),
    "names": ("a", ""),
    "point_indices": np.array([0, 1]),
    "images": ("1.jpg", "1.jpg"),
    "pixels": np.ones((2, 2)),
}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"xyz": np.ones((2, 2))}, r"control's xyz do not fit; expected shape \(2, 3\); found shape \(2, 2\)"),
        (
            {"pixels": np.ones((3, 2))},
            r"control's pixels do not fit; expected shape \(2, 2\); found shape \(3, 2\)",
        ),
        ({"point_indices": np.array([0])}, r"control's point_indices do not fit; expected shape \(2,\)"),
        ({"point_indices": np.array([0, 2])}, r"observations of no point; expected indices below 2"),
        ({"point_indices": np.array([-1, 1])}, r"observations of no point"),
        ({"xyz": np.full((2, 3), np.nan)}, r"coordinates that are not finite"),
        ({"pixels": np.full((2, 2), -1.0)}, r"pixels that are not finite, or negative"),
        ({"images": ("my photo.jpg", "1.jpg")}, r"name 'my photo\.jpg' cannot stand in .*without spaces"),
        ({"images": ("", "1.jpg")}, r"name '' cannot stand in a gcp_list\.txt"),
        ({"images": ("a\nb", "1.jpg")}, r"name 'a\\nb' cannot be stored"),
        ({"names": ("a b", "c")}, r"name 'a b' cannot stand in"),
        ({"names": ("a", "a")}, r"has the point a twice; expected names that differ"),
        ({"names": ("", ""), "xyz": np.ones((2, 3))}, r"has the point \(1\.0, 1\.0, 1\.0\) twice"),
    ],
)
def test_what_contradicts_itself_is_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        GroundControl(**{**SOUND, **changed})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"point_indices": np.array([0, 0])}, r"expected points with one observation at least; found \(333187\.0"),
        ({"point_indices": np.array([1, 1])}, r"expected points with one observation at least; found a without"),
        ({"crs": "hello"}, r"Unknown coordinate system in this ground control; .*found 'hello'"),
        ({"crs": "+proj=utm\n+zone=17"}, r"Unknown coordinate system in this ground control"),
        (
            {name: value[:0] for name, value in SOUND.items() if name != "crs"},
            r"expected points with one observation at least; found no point",
        ),
    ],
)
def test_what_the_file_cannot_hold_is_not_written(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        write_gcp_list(GroundControl(**{**SOUND, **changed}), tmp_path / "a.txt")
    assert not (tmp_path / "a.txt").exists()


def placed(crs: str, *xyz: float) -> GroundControl:
    return dataclasses.replace(
        GroundControl(**SOUND), crs=crs, xyz=np.array([xyz]), names=("p",), point_indices=np.zeros(2, np.int64)
    )


@pytest.mark.parametrize(
    "crs",
    ["WGS84 UTM 31N", "wgs84 utm 31n", "EPSG:32631", "+proj=utm +zone=31 +datum=WGS84 +units=m +no_defs"],
)
def test_all_ways_to_write_a_system_say_the_same(crs: str) -> None:
    """On the central meridian at the equator UTM is 500 km, 0 by definition; 1e-9 degrees are 0.1 mm."""
    np.testing.assert_allclose(placed(crs, 500_000, 0, 12.5).geodetic(), [[0, 3, 12.5]], atol=1e-9)


def test_the_southern_half_counts_from_ten_million() -> None:
    np.testing.assert_allclose(placed("WGS84 UTM 31S", 5e5, 1e7, 0).geodetic(), [[0, 3, 0]], atol=1e-9)


def test_x_is_east_even_where_the_system_names_north_first() -> None:
    np.testing.assert_allclose(placed("EPSG:4326", -82.7, 28.04, 5).geodetic(), [[28.04, -82.7, 5]], atol=1e-12)
    # Warsaw's Palace of Culture; EPSG:2180 lists north first.
    east, north = pyproj.Proj("EPSG:2180")(21.0061, 52.2319)
    np.testing.assert_allclose(placed("EPSG:2180", east, north, 0).geodetic(), [[52.2319, 21.0061, 0]], atol=1e-6)


def test_heights_are_passed_on_as_they_are_written() -> None:
    """Neither feet of the horizontal system nor a geoid change them."""
    for crs in ("EPSG:2236", "+proj=utm +zone=17 +datum=NAD83 +units=us-ft +vunits=us-ft"):
        assert placed(crs, 500_000, 500_000, 100).geodetic()[0, 2] == 100


def test_metres_around_an_origin() -> None:
    gcp = dataclasses.replace(GroundControl(**SOUND), crs="WGS84 UTM 31N")
    gcp = dataclasses.replace(gcp, xyz=np.array([[5e5, 0, 7.0], [500_100, 50, 17]]))
    enu = gcp.enu((0.0, 3.0, 7.0))
    np.testing.assert_allclose(enu[0], 0, atol=1e-6)
    # UTM's scale is 0.9996 there; the earth's curve over 112 m is below a millimetre.
    np.testing.assert_allclose(enu[1], [100 / 0.9996, 50 / 0.9996, 10], atol=2e-3)


def test_points_outside_of_the_system_are_named() -> None:
    with pytest.raises(
        DataError, match=r"The point p lies outside of 'EPSG:32616'; found .*1e\+30.* and 0 more\. Check"
    ):
        placed("EPSG:32616", 1e30, 5e6, 0).geodetic()
    with pytest.raises(DataError, match=r"lies outside of 'EPSG:4326'; .* x \(east\) stands before y"):
        placed("EPSG:4326", 28.04, -182.7, 0).geodetic()


# Points with their own coordinates, observations, and where the README or the photos' GPS say that it is.
# Boruszyn's README counts six places: the source gives one of them two heights, and one has no photo left.
REAL = [
    ("uav_copr_gcp/gcp_list.txt", 10, 27, (34.4085, -119.8801)),
    ("uav_copr_gcp/source_gcp_list.txt", 10, 27, (34.4085, -119.8801)),
    ("uav_sheffield_cross/gcp_list.txt", 5, 25, (28.041, -82.698)),
    ("uav_sheffield_cross/source_gcp_file.txt", 5, 25, (28.041, -82.698)),
    ("uav_oblique_kap_boruszyn/gcp_list.txt", 5, 9, (52.7753, 16.6365)),
    ("uav_oblique_kap_boruszyn/source_gcp_list.txt", 7, 18, (52.775, 16.6365)),
]


@pytest.mark.real
@pytest.mark.parametrize(("name", "points", "marks", "place"), REAL)
def test_real_lists_lie_where_their_photos_do(
    real_data: Path, tmp_path: Path, name: str, points: int, marks: int, place: tuple[float, float]
) -> None:
    gcp = read_gcp_list(real_data / name)
    assert (len(gcp.names), len(gcp.images)) == (points, marks)
    enu = gcp.enu((*place, 0.0))
    # Sites are smaller than 400 m; the photos' GPS and the READMEs are good to some metres.
    assert np.linalg.norm(enu[:, :2], axis=1).max() < 400
    write_gcp_list(gcp, tmp_path / "a.txt")
    again = read_gcp_list(tmp_path / "a.txt")
    assert sorted(zip(again.images, again.pixels.tolist(), strict=True)) == sorted(
        zip(gcp.images, gcp.pixels.tolist(), strict=True)
    )


@pytest.mark.real
def test_surveyed_points_lie_at_their_longitudes(real_data: Path) -> None:
    """The source gives each point in degrees, too. The rows have centimetres: half of one is 5e-8 degrees."""
    folder = real_data / "uav_copr_gcp"
    gcp = read_gcp_list(folder / "gcp_list.txt")
    rows = [line.split() for line in (folder / "source_gcp_list_noimg.txt").read_text().splitlines()[1:]]
    # That file numbers the points from one, the other from nought.
    degrees = {f"gcp{int(name[3:]) - 1:02}": (float(y), float(x)) for name, x, y, _ in rows}
    np.testing.assert_allclose(gcp.geodetic()[:, :2], [degrees[name] for name in gcp.names], atol=1e-7, rtol=0)


@pytest.mark.real
def test_a_list_without_pictures_is_refused(real_data: Path) -> None:
    with pytest.raises(DataError, match=r"Too few columns in line 2 of .*noimg\.txt; .*found 4 columns: 'gcp01"):
        read_gcp_list(real_data / "uav_copr_gcp/source_gcp_list_noimg.txt")
