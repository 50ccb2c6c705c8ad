"""A map in tiles shows what the whole map shows, keeps what it may, and finds photos of which nothing is known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from splat_ground import CAMERA, down, ground_map, photo

from toolkit.errors import DataError, SettingsError, StageError
from toolkit.files import read_json, write_json
from toolkit.localize.anywhere import localize_anywhere
from toolkit.localize.query import Query
from toolkit.localize.retrieval import PlaceIndex, build_place_index, describe
from toolkit.localize.settings import LocalizeSettings, ReliabilitySettings
from toolkit.localize.splat_map import SplatMap
from toolkit.localize.tiles import TiledMap, write_tiles
from toolkit.matching.picture_features import PictureMatcher, picture_matcher
from toolkit.matching.picture_settings import PictureMatchSettings
from toolkit.metrics.localization import pose_errors

FAST = LocalizeSettings().replace({"polish.use": False})


@pytest.fixture(scope="module")
def ground() -> SplatMap:
    return ground_map(side=150.0, spacing=0.75)


@pytest.fixture(scope="module")
def tiles(ground: SplatMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiles") / "map"
    write_tiles(ground.gaussians, ground.kind, folder, side=25.0)
    return folder


@pytest.fixture(scope="module")
def matcher() -> PictureMatcher:
    return picture_matcher(PictureMatchSettings())


@pytest.fixture(scope="module")
def places(ground: SplatMap, matcher: PictureMatcher) -> PlaceIndex:
    names, poses = [], []
    for x in range(-50, 51, 25):
        for y in range(-50, 51, 25):
            names.append(f"{x} {y}")
            poses.append(down(float(x), float(y)))
    features = [matcher.features(photo(ground, pose).picture) for pose in poses]
    return build_place_index(names, poses, features, words=24)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (25.0, -10.0, 70.0)])
def test_a_view_of_the_tiles_is_that_of_the_map(
    ground: SplatMap, tiles: Path, turn: tuple[float, float, float]
) -> None:
    pose = down(12.0, -20.0, turn=turn)
    part = TiledMap(tiles).around(CAMERA, pose)
    assert part is not None
    assert len(part.gaussians) < 0.6 * len(ground.gaussians)
    one, other = (each.render(CAMERA, pose, ReliabilitySettings()) for each in (ground, part))
    # Disks beyond the view's border reach into its first pixels; the order of equal depths may differ inside.
    inside = (slice(6, -6), slice(6, -6))
    assert np.abs(one.colour[inside].astype(int) - other.colour[inside]).max() <= 1
    np.testing.assert_allclose(one.depth[inside], other.depth[inside], atol=1e-3)


def test_every_gaussian_is_in_one_tile(ground: SplatMap, tiles: Path) -> None:
    opened = TiledMap(tiles)
    assert sum(tile.gaussians for tile in opened.tiles) == len(ground.gaussians)
    assert len(opened.tiles) == 36
    assert opened.around(CAMERA, down(1000.0, 0.0)) is None
    everything = opened.around(CAMERA, down(0.0, 0.0, height=400.0))
    assert everything is not None
    assert len(everything.gaussians) == len(ground.gaussians)


def test_a_level_view_ends_somewhere(tiles: Path) -> None:
    seen = TiledMap(tiles).seen(CAMERA, down(-60.0, -60.0, height=5.0, turn=(88.0, 0.0, 0.0)), margin=0.0)
    assert 0 < len(seen) < 36


def test_old_tiles_are_forgotten(tiles: Path) -> None:
    opened = TiledMap(tiles, most=9000)
    for x in range(-50, 51, 10):
        opened.around(CAMERA, down(float(x), 0.0))
        needed = sum(tile.gaussians for tile in opened.seen(CAMERA, down(float(x), 0.0), margin=0.0))
        assert opened.kept <= max(9000, needed)


def test_damaged_tiles_are_refused(ground: SplatMap, tiles: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="side"):
        write_tiles(ground.gaussians, "2d", tmp_path / "none", side=0.0)
    with pytest.raises(StageError, match="in the way"):
        write_tiles(ground.gaussians, "2d", tiles, side=25.0)
    folder = tmp_path / "map"
    write_tiles(ground_map(side=9.0).gaussians, "2d", folder, side=5.0)
    record = read_json(folder / "tiles.json")
    record["tiles"][0]["gaussians"] += 1
    write_json(folder / "tiles.json", record)
    with pytest.raises(DataError, match="not the tile of its record"):
        TiledMap(folder).around(CAMERA, down())
    del record["side"]
    write_json(folder / "tiles.json", record)
    with pytest.raises(DataError, match="damaged"):
        TiledMap(folder)
    write_json(folder / "tiles.json", {"format": "another"})
    with pytest.raises(DataError, match="no record of tiles"):
        TiledMap(folder)


def test_a_photo_of_anywhere_is_found(
    ground: SplatMap, tiles: Path, places: PlaceIndex, matcher: PictureMatcher
) -> None:
    true = down(31.0, -17.0, turn=(3.0, 2.0, 130.0))
    done = localize_anywhere(TiledMap(tiles), places, photo(ground, true), FAST, matcher)
    assert done.cam_from_world is not None
    assert pose_errors(done.cam_from_world, true)[0] < 0.03  # the stillness asked for is 0.02 m
    assert {"retrieval", "tiles", "render"} <= set(done.seconds)


def test_a_photo_of_nowhere_is_not(
    tiles: Path, places: PlaceIndex, ground: SplatMap, matcher: PictureMatcher
) -> None:
    other = photo(ground_map(seed=5), down())
    done = localize_anywhere(TiledMap(tiles), places, other, FAST, matcher, tries=2)
    assert done.cam_from_world is None
    assert "are needed" in done.reason
    black = Query("black", np.zeros_like(other.picture), CAMERA)
    assert "no part of the map" in localize_anywhere(TiledMap(tiles), places, black, FAST, matcher).reason


def test_neighbours_look_most_alike(ground: SplatMap, places: PlaceIndex, matcher: PictureMatcher) -> None:
    hits = 0
    for number, name in enumerate(places.names):
        pose = places.poses[number]
        near = down(pose.centre[0] + 4.0, pose.centre[1] - 3.0, turn=(0.0, 0.0, 40.0))
        hits += name in {places.names[k] for k in places.nearest(matcher.features(photo(ground, near).picture), 2)}
    assert hits >= 23  # of 25


def test_an_index_needs_pictures(places: PlaceIndex, matcher: PictureMatcher) -> None:
    black = matcher.features(np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(DataError, match="as many of each"):
        build_place_index([], [], [])
    with pytest.raises(DataError, match="too few features"):
        build_place_index(["a"], [down()], [dataclasses.replace(black)])
    assert not describe(np.zeros((0, 128), np.float32), places.words).any()
