"""Which RPC file belongs to which picture, and which part of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rpc_samples import RPC, apart, gdal_reads, geom, sample_rpc, write, write_picture

from toolkit.errors import DataError
from toolkit.scene.rpc_files import picture_rpc, side_file

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed: pip install 'sightline-toolkit[geo]'")


@pytest.mark.parametrize(
    ("picture", "beside"),
    [
        ("a.tif", "a.RPB"),
        ("a.TIF", "A.rpb"),
        ("a.tif", "a_rpc.txt"),
        ("a.tif", "a.rpc"),
        ("a.tif", "a.geom"),
        ("a.tif", "a.xml"),
        ("a.tif", "a.json"),
        ("a.ntf", "a_rpc.json"),
        ("IMG_PHR1A_R1C1.TIF", "RPC_PHR1A.XML"),
        ("IMG_PHR1A_R1C1.TIF", "RPC_PHR1A_R1C1.XML"),
    ],
)
def test_the_file_of_a_picture_is_found_by_its_name(tmp_path: Path, picture: str, beside: str) -> None:
    (tmp_path / beside).write_text("RPC00B")
    assert side_file(tmp_path / picture) == tmp_path / beside
    assert side_file(tmp_path / f"b{picture}") is None
    assert side_file(tmp_path / picture, {}) is None


def test_json_and_xml_without_an_rpc_are_passed_over(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"fov": 3}')
    (tmp_path / "a.xml").write_text("<flight/>" * 300_000)
    assert side_file(tmp_path / "a.tif") is None
    # The mark may lie across two pieces of the file.
    (tmp_path / "a.xml").write_text(" " * (2**20 - 3) + "RPC00B")
    assert side_file(tmp_path / "a.tif") == tmp_path / "a.xml"


def test_a_file_beside_counts_more_than_tags(tmp_path: Path) -> None:
    picture = write_picture(tmp_path / "a.tif", sample_rpc(1))
    write(tmp_path, "a.RPB")
    found = picture_rpc(picture, side_file(picture))
    assert found is not None
    assert found.rpc == RPC
    assert (found.width, found.height) == (400, 300)


def part_of_whole(path: Path, left: float, top: float, crs: str | None = None) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=400, height=300, count=1, dtype="uint16",
        transform=rasterio.Affine(1, 0, left, 0, 1, top), crs=crs,
    ) as dataset:  # fmt: skip
        dataset.write(np.ones((1, 300, 400), np.uint16))
    return path


def test_a_part_of_a_picture_takes_the_rpc_of_the_whole(tmp_path: Path) -> None:
    picture = part_of_whole(tmp_path / "a.tif", 5000, 6000)
    write(tmp_path, "a.geom", geom(RPC, width=40000, height=30000))
    found = picture_rpc(picture, side_file(picture))
    assert found is not None
    assert found.rpc == RPC.cropped(5000, 6000)
    assert (found.width, found.height) == (400, 300)


@pytest.mark.parametrize(
    ("left", "top", "crs"), [(0, 0, None), (39900, 0, None), (-5, 3, None), (5, 3, "EPSG:32631")]
)
def test_an_rpc_of_another_size_is_refused(tmp_path: Path, left: float, top: float, crs: str | None) -> None:
    if (left, top) == (0, 0):
        picture = write_picture(tmp_path / "a.tif")
    else:
        picture = part_of_whole(tmp_path / "a.tif", left, top, crs)
    write(tmp_path, "a.geom", geom(RPC, width=40000, height=30000))
    with pytest.raises(
        DataError, match=r"a\.geom belongs to another picture than .*expected 400x300.*found 40000x30000"
    ):
        picture_rpc(picture, side_file(picture))


def tiles(overlap: int = 0) -> str:
    """Return a description of a picture of 2 x 2 tiles, as GDAL looks for them."""
    files = "".join(
        f'<Data_File tile_R="{r}" tile_C="{c}"><DATA_FILE_PATH href="IMG_a_R{r}C{c}.TIF"/></Data_File>'
        for r in (1, 2)
        for c in (1, 2)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<Dimap_Document><Raster_Data><Data_Access><Data_Files>'
        f"{files}</Data_Files></Data_Access><Raster_Dimensions><NROWS>600</NROWS><NCOLS>800</NCOLS>"
        f'<Tile_Set><NTILES>4</NTILES><Regular_Tiling><NTILES_SIZE ncols="400" nrows="300"/>'
        f"<OVERLAP_COL>{overlap}</OVERLAP_COL><OVERLAP_ROW>{overlap}</OVERLAP_ROW></Regular_Tiling></Tile_Set>"
        "</Raster_Dimensions></Raster_Data></Dimap_Document>\n"
    )


@pytest.mark.parametrize(("name", "corner"), [("R1C1", (0, 0)), ("R1C2", (400, 0)), ("R2C1", (0, 300))])
def test_a_tile_has_its_part_of_the_rpc_as_gdal_has_it(tmp_path: Path, name: str, corner: tuple[int, int]) -> None:
    picture = write_picture(tmp_path / f"IMG_a_{name}.TIF")
    write(tmp_path, "RPC_a.XML")
    (tmp_path / "DIM_a.XML").write_text(tiles())
    found = picture_rpc(picture, side_file(picture))
    assert found is not None
    assert found.rpc == RPC.cropped(*corner)
    assert (found.width, found.height) == (400, 300)
    assert apart(gdal_reads(picture), found.rpc) < 1e-11


@pytest.mark.parametrize("description", [None, "<Dimap_Document/>", tiles(overlap=16)])
def test_a_tile_of_an_unknown_place_is_refused(tmp_path: Path, description: str | None) -> None:
    picture = write_picture(tmp_path / "IMG_a_R1C2.TIF")
    write(tmp_path, "RPC_a.XML")
    if description is not None:
        (tmp_path / "DIM_a.XML").write_text(description)
    with pytest.raises(DataError, match=r"is one tile of several.*found row 1, column 2.*join the tiles"):
        picture_rpc(picture, side_file(picture))
