"""A map too large for the memory: square tiles in files of their own, of which those in view are loaded."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.errors import DataError, SettingsError, StageError
from toolkit.files import atomic_folder, read_json, write_json
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.splat_map import SplatMap
from toolkit.splat.gaussians import Gaussians
from toolkit.splat.ply import read_splats, write_splats
from toolkit.splat.rasterize import Kind

Array = NDArray[np.float64]

#: The record of a folder of tiles.
TILES: Final = "tiles.json"
_FORMAT: Final = "sightline-tiles"
_VERSION: Final = 1
# Rays that meet the ground farther off than this many times the height are cut there: towards the horizon a view
# has no end.
_FARTHEST: Final = 6.0


@dataclass(frozen=True, slots=True)
class Tile:
    """A square of ground.

    Attributes
    ----------
    column, row:
        Its place: from ``column * side`` east and ``row * side`` north of the world's origin.
    gaussians:
        How many have their centre over it.
    lowest, highest:
        Of these centres, in scene units.
    """

    column: int
    row: int
    gaussians: int
    lowest: float
    highest: float

    @property
    def file(self) -> str:
        """Name of its splat."""
        return f"tile_{self.column}_{self.row}.ply"


def write_tiles(gaussians: Gaussians, kind: Kind, folder: Path, *, side: float) -> tuple[Tile, ...]:
    """Cut a map into tiles and write them to a new folder, which appears whole or not at all.

    Every Gaussian is in the one tile that its centre is over.

    Parameters
    ----------
    gaussians:
        In a world whose third axis is up.
    side:
        Of a tile, in scene units.

    Raises
    ------
    SettingsError
        For a side that is not positive.
    StageError
        Where the folder is there already.
    RunError
        Where the disk refuses.
    """
    if not (side > 0 and math.isfinite(side)):
        raise SettingsError("Tiles need a side", expected="a positive number of scene units", found=str(side))
    if folder.exists():
        raise StageError(f"{folder} is in the way", expected="a new folder", todo="Choose another or move it away")
    means = gaussians.means.detach().cpu().numpy().astype(np.float64)
    places = np.floor(means[:, :2] / side).astype(np.int64)
    squares, of = np.unique(places, axis=0, return_inverse=True)
    tiles = []
    with atomic_folder(folder) as temporary:
        temporary.mkdir(parents=True, exist_ok=True)
        for number, (column, row) in enumerate(squares.tolist()):
            rows = np.flatnonzero(of.ravel() == number)
            chosen = torch.from_numpy(rows).to(gaussians.means.device)
            heights = means[rows, 2]
            tile = Tile(column, row, len(rows), float(heights.min()), float(heights.max()))
            write_splats(gaussians.map(lambda tensor, at=chosen: tensor[at]), temporary / tile.file)
            tiles.append(tile)
        write_json(
            temporary / TILES,
            {
                "format": _FORMAT,
                "version": _VERSION,
                "kind": kind,
                "side": side,
                "tiles": [
                    {name: getattr(tile, name) for name in ("column", "row", "gaussians", "lowest", "highest")}
                    for tile in tiles
                ],
            },
        )
    return tuple(tiles)


class TiledMap:
    """The tiles in a folder, of which the last used are kept in memory.

    Parameters
    ----------
    folder:
        That :func:`write_tiles` wrote.
    most:
        Gaussians that are kept, at most; what one view needs is always loaded.

    Raises
    ------
    DataError
        Where it is no such folder, or damaged.
    """

    def __init__(self, folder: Path, *, most: int = 2_000_000) -> None:
        record = read_json(folder / TILES)
        if not isinstance(record, dict) or record.get("format") != _FORMAT or record.get("version") != _VERSION:
            raise DataError(f"{folder / TILES} is no record of tiles", expected=f"format '{_FORMAT}' {_VERSION}")
        try:
            self.side = float(record["side"])
            self.kind: Kind = "2d" if record["kind"] == "2d" else "3d"
            self.tiles = tuple(_tile(row) for row in record["tiles"])
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{folder / TILES} is damaged", expected="what write_tiles writes", found=repr(error)
            ) from error
        self._folder, self._most = folder, most
        self._kept: OrderedDict[str, Gaussians] = OrderedDict()

    @property
    def kept(self) -> int:
        """Gaussians in memory now."""
        return sum(len(tile) for tile in self._kept.values())

    def seen(self, camera: ColmapCamera, cam_from_world: RigidTransform, *, margin: float) -> tuple[Tile, ...]:
        """Return the tiles in a view, or within ``margin`` scene units of it.

        The view's border is followed down to the lowest and the highest ground of all tiles; the box around both
        counts.
        """
        if not self.tiles:
            return ()
        low, high = _footprint(
            camera,
            cam_from_world,
            min(tile.lowest for tile in self.tiles),
            max(tile.highest for tile in self.tiles),
        )
        return tuple(
            tile
            for tile in self.tiles
            if all(
                place * self.side <= high[axis] + margin and (place + 1) * self.side >= low[axis] - margin
                for axis, place in enumerate((tile.column, tile.row))
            )
        )

    def around(
        self, camera: ColmapCamera, cam_from_world: RigidTransform, *, margin: float = 0.0
    ) -> SplatMap | None:
        """Return the map in a view, or within ``margin`` of it; None where there is none.

        Raises
        ------
        DataError
            Where a tile's file is missing or damaged.
        """
        tiles = self.seen(camera, cam_from_world, margin=margin)
        parts = [self._load(tile) for tile in tiles]
        self._forget(len(tiles))
        if not parts:
            return None
        joined = Gaussians(
            **{name: torch.cat([getattr(part, name) for part in parts]) for name, _ in parts[0].named()}
        )
        return SplatMap(joined, self.kind)

    def _load(self, tile: Tile) -> Gaussians:
        if tile.file in self._kept:
            self._kept.move_to_end(tile.file)
            return self._kept[tile.file]
        found = read_splats(self._folder / tile.file)
        if len(found) != tile.gaussians:
            raise DataError(
                f"{self._folder / tile.file} is not the tile of its record",
                expected=f"{tile.gaussians} Gaussians",
                found=str(len(found)),
                todo="Cut the map into tiles again",
            )
        self._kept[tile.file] = found
        return found

    def _forget(self, needed: int) -> None:
        """Drop the tiles that were not used for longest, but none of the ``needed`` last."""
        while self.kept > self._most and len(self._kept) > needed:
            self._kept.popitem(last=False)


def _tile(row: dict[str, Any]) -> Tile:
    return Tile(
        int(row["column"]), int(row["row"]), int(row["gaussians"]), float(row["lowest"]), float(row["highest"])
    )


def _footprint(
    camera: ColmapCamera, cam_from_world: RigidTransform, lowest: float, highest: float
) -> tuple[Array, Array]:
    """Return the corners (2,) of the box around what a view shows of the ground between two heights."""
    width, height = camera.width, camera.height
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(0, width, 9), np.linspace(0, height, 9)))
    _, rays = camera.ray(np.column_stack([x, y]))
    centre = cam_from_world.centre
    rays = rays[np.isfinite(rays).all(axis=1)] @ cam_from_world.rotation
    ends = [centre[None, :2]]
    for ground in (lowest, highest):
        drop = centre[2] - ground
        reach = _FARTHEST * abs(drop)
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -drop / rays[:, 2]
        along = np.where(along > 0, along, np.inf)
        level = np.linalg.norm(rays[:, :2], axis=1)
        along = np.minimum(along, reach / np.maximum(level, 1e-9))
        ends.append(centre[:2] + along[:, None] * rays[:, :2])
    everything = np.concatenate(ends)
    return everything.min(axis=0), everything.max(axis=0)
