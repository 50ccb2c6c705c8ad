"""The layouts of the papers' own data sets, on tiny copies made here."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.errors import DataError
from toolkit.samples.layouts import SurfaceFrame, find_dfc2019, find_flights, find_mars_lvig


def make(folder: Path, *names: str, text: str = "") -> None:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


def test_dfc2019_groups_views_by_site_and_number(tmp_path: Path) -> None:
    make(tmp_path, "Track3-RGB-1/JAX_004_010_RGB.tif", "Track3-RGB-1/JAX_004_006_RGB.tif")
    make(tmp_path, "Track3-RGB-2/OMA_132_001_RGB.tif", "Track3-MSI-1/JAX_004_006_MSI.tif", "Track3-RGB-1/notes.tif")
    make(tmp_path, "Track3-Truth/JAX_004_DSM.tif", "Track3-Truth/JAX_004_CLS.tif", "Track3-Truth/OMA_999_DSM.tif")
    make(tmp_path, "Track3-Truth/JAX_004_DSM.txt", text="435525.0\n3354555.5\n512\n0.5\n")
    first, second = find_dfc2019(tmp_path)
    assert (first.name, second.name) == ("JAX_004", "OMA_132")
    assert [view.number for view in first.views] == [6, 10]
    assert first.views[0].rgb == tmp_path / "Track3-RGB-1/JAX_004_006_RGB.tif"
    assert first.views[0].msi == tmp_path / "Track3-MSI-1/JAX_004_006_MSI.tif"
    assert first.views[1].msi is None
    assert first.surface == tmp_path / "Track3-Truth/JAX_004_DSM.tif"
    assert first.classes == tmp_path / "Track3-Truth/JAX_004_CLS.tif"
    assert first.frame == SurfaceFrame(435525.0, 3354555.5, 512, 0.5)
    assert first.missing == ()


def test_dfc2019_says_which_truth_is_missing(tmp_path: Path) -> None:
    make(tmp_path, "Track3-RGB-2/OMA_132_001_RGB.tif", "Track3-Truth/OMA_132_CLS.tif")
    (site,) = find_dfc2019(tmp_path)
    assert site.missing == ("OMA_132_DSM.tif", "OMA_132_DSM.txt")
    assert site.surface is None
    assert site.frame is None


def test_dfc2019_without_pictures_says_what_to_unpack(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"expected files like Track3-RGB-1/JAX_004_006_RGB.tif; found none"):
        find_dfc2019(tmp_path)
    make(tmp_path, "Track3-Truth/JAX_004_DSM.tif")
    with pytest.raises(DataError, match=r"found truth of 1 sites only\. Unpack the Track 3 archives"):
        find_dfc2019(tmp_path)


def test_dfc2019_refuses_a_picture_in_two_places(tmp_path: Path) -> None:
    make(tmp_path, "Track3-RGB-1/JAX_004_006_RGB.tif", "crops/JAX_004_006_RGB.tif")
    with pytest.raises(
        DataError, match=r"JAX_004_006_RGB.tif is ambiguous; expected one file; found .*Track3.* and "
    ):
        find_dfc2019(tmp_path)


@pytest.mark.parametrize("text", ["", "1 2 3", "1 2 512 half", "1 2 512.5 0.5", "1 2 512 0", "nan 2 512 0.5"])
def test_dfc2019_refuses_a_frame_that_is_not_four_sound_numbers(tmp_path: Path, text: str) -> None:
    make(tmp_path, "Track3-RGB-1/JAX_004_006_RGB.tif")
    make(tmp_path, "Track3-Truth/JAX_004_DSM.txt", text=text)
    with pytest.raises(DataError, match=r"JAX_004_DSM.txt is no frame of a surface model; expected four numbers"):
        find_dfc2019(tmp_path)


def test_flights_take_the_telemetry_of_the_same_name(tmp_path: Path) -> None:
    make(tmp_path, "main_stage/DJI_0001.MP4", "main_stage/DJI_0001.SRT", "ruin/DJI_0001.mov", "ruin/._DJI_0001.mov")
    make(tmp_path, "container.mp4", "container.gpx", "other.csv", "readme.txt")
    flights = find_flights(tmp_path)
    assert [flight.name for flight in flights] == ["container", "main_stage/DJI_0001", "ruin/DJI_0001"]
    assert [flight.telemetry for flight in flights] == [
        tmp_path / "container.gpx",
        tmp_path / "main_stage/DJI_0001.SRT",
        None,
    ]
    assert flights[2].video == tmp_path / "ruin/DJI_0001.mov"


def test_flights_refuse_what_is_empty_or_ambiguous(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"No videos below .*; found none"):
        find_flights(tmp_path)
    make(tmp_path, "a.srt")
    with pytest.raises(DataError, match=r"found 1 telemetry files only"):
        find_flights(tmp_path)
    make(tmp_path, "a.mp4", "a.csv")
    with pytest.raises(DataError, match=r"a is ambiguous; expected one telemetry file; found .*a.csv and .*a.srt"):
        find_flights(tmp_path)
    (tmp_path / "a.csv").unlink()
    make(tmp_path, "a.mov")
    with pytest.raises(DataError, match=r"expected one video; found .*a.mov and .*a.mp4"):
        find_flights(tmp_path)
    with pytest.raises(DataError, match=r"nowhere is no folder"):
        find_flights(tmp_path / "nowhere")


def test_mars_lvig_joins_bags_and_what_was_extracted(tmp_path: Path) -> None:
    make(tmp_path, "AMtown01.bag", "HKairport_GNSS02.bag", "calibration.bag")
    make(tmp_path, "AMtown01/images/1658133190.1.jpg", "AMtown01/images/1658133189.4.jpg", "AMtown01/rtk.txt")
    make(tmp_path, "interval5_AMvalley03/interval5_CAM/1.jpg", "interval5_AMvalley03/rtk_positions_raw.csv")
    make(tmp_path, "interval5_AMvalley03/rtk_positions_raw_viz.png", "interval5_AMvalley03/notes.txt")
    town, valley, airport = find_mars_lvig(tmp_path)
    assert (town.name, valley.name, airport.name) == ("AMtown01", "AMvalley03", "HKairport_GNSS02")
    assert town.bag == tmp_path / "AMtown01.bag"
    assert [path.name for path in town.images] == ["1658133189.4.jpg", "1658133190.1.jpg"]
    assert town.rtk == tmp_path / "AMtown01/rtk.txt"
    assert valley.bag is None
    assert [path.name for path in valley.images] == ["1.jpg"]
    assert valley.rtk == tmp_path / "interval5_AMvalley03/rtk_positions_raw.csv"
    assert (airport.images, airport.rtk) == ((), None)


def test_mars_lvig_may_be_the_folder_of_one_sequence(tmp_path: Path) -> None:
    make(tmp_path / "AMtown02", "1.png", "rtk.csv")
    (sequence,) = find_mars_lvig(tmp_path / "AMtown02")
    assert (sequence.name, len(sequence.images)) == ("AMtown02", 1)


def test_mars_lvig_refuses_what_is_empty_or_ambiguous(tmp_path: Path) -> None:
    make(tmp_path, "holiday/1.jpg")
    with pytest.raises(DataError, match=r"No MARS-LVIG sequences below .*expected bags like AMtown01.bag"):
        find_mars_lvig(tmp_path)
    make(tmp_path, "AMtown01/left/1.jpg", "AMtown01/right/1.jpg")
    with pytest.raises(DataError, match=r"Sequence AMtown01 is ambiguous; expected one folder of pictures; found "):
        find_mars_lvig(tmp_path)
    make(tmp_path, "AMtown02/rtk_a.txt", "AMtown02/rtk_b.txt", "AMtown03.bag", "old/AMtown03.bag")
    (tmp_path / "AMtown01/right/1.jpg").unlink()
    with pytest.raises(DataError, match=r"AMtown02 is ambiguous; expected one file of RTK positions"):
        find_mars_lvig(tmp_path)
    (tmp_path / "AMtown02/rtk_b.txt").unlink()
    with pytest.raises(DataError, match=r"AMtown03 is ambiguous; expected one bag"):
        find_mars_lvig(tmp_path)
