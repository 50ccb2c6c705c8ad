"""Heights over the ground in a map and back."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.depth.height_dsm import heights_at, heights_on, surface_model
from toolkit.errors import StageError
from toolkit.geometry.ground_grid import GroundGrid
from toolkit.scene import Georeference

pytest.importorskip("pyproj", reason="maps need pyproj")
GRID = GroundGrid(-20.0, 15.0, 0.5, 60, 80)
PLACE = Georeference(latitude=43.3, longitude=5.4, altitude=100.0)


def slope() -> np.ndarray:
    x, y = np.moveaxis(GRID.places(), -1, 0)
    return 5 + 0.2 * x - 0.1 * y


def test_heights_between_cells_are_interpolated() -> None:
    found = heights_at(slope(), GRID, [[0.0, 0.0], [3.1, -2.3], [500.0, 0.0]])
    assert found[:2] == pytest.approx([5.0, 5 + 0.62 + 0.23])
    assert np.isnan(found[2])


def test_a_map_holds_the_same_heights_above_the_ellipsoid() -> None:
    model = surface_model(slope(), GRID, PLACE)
    assert model.crs == "EPSG:32631"
    back = heights_on(slope(), GRID, PLACE, model)
    np.testing.assert_array_equal(back, model.heights)
    known = model.heights[np.isfinite(model.heights)]
    # 40 m x 30 m turned by the meridians' convergence of 1.6 degrees: corners of the map's box are empty.
    assert 0.85 < len(known) / (60 * 80) < 1.02
    assert known.mean() == pytest.approx(100 + slope().mean(), abs=0.05)


def test_the_ellipsoid_falls_away_from_the_plane_of_the_origin() -> None:
    far = GroundGrid(2990.0, 2010.0, 1.0, 20, 20)
    model = surface_model(np.full((20, 20), 7.0), far, PLACE)
    fall = (3000.0**2 + 2000.0**2) / (2 * 6.37e6)  # 1.02 m; radii of curvature differ by half a percent here
    known = model.heights[np.isfinite(model.heights)]
    np.testing.assert_allclose(known, 107.0 + fall, atol=0.02)


def test_nothing_known_is_told() -> None:
    with pytest.raises(StageError, match="No height is known"):
        surface_model(np.full((60, 80), np.nan), GRID, PLACE)
