"""Heights from chosen views of a small computed city against its truth."""

from __future__ import annotations

from pathlib import Path

import pytest

from toolkit.depth.height_settings import HeightSettings
from toolkit.errors import StageError
from toolkit.poses.satellite import ground_box, with_affine_cameras
from toolkit.recipes.satellite_choices import CHOICES, errors_by_views
from toolkit.samples.city import CitySettings, make_city

pytest.importorskip("rasterio", reason="satellite pictures need rasterio (extra 'geo')")
SMALL = {"plan.size": 48.0, "plan.tallest": 20.0, "orbit.views": 5, "imager.ground_sampling": 0.75}
QUICK = {"resolution": 0.75, "search.levels": 2, "search.iterations": 1}


def test_more_views_are_better_and_all_views_are_the_same_however_chosen(tmp_path: Path) -> None:
    city = make_city(tmp_path / "city", CitySettings().replace(SMALL), seed=3)
    box = ground_box(city.true_scene, heights=(-5.0, 25.0))
    scene, _ = with_affine_cameras(city.true_scene, box)
    settings = HeightSettings().replace(QUICK)
    errors = errors_by_views(scene, box, city.dsm, (2, 5), settings)
    assert set(errors) == set(CHOICES)
    whole = {way: by_count[5] for way, by_count in errors.items()}
    assert whole["most spread"] is whole["least spread"] is whole["random"]
    # Two views that hardly differ in direction against all of them: metres.
    assert whole["random"].median_absolute < errors["least spread"][2].median_absolute
    assert whole["random"].median_absolute < 0.75
    with pytest.raises(StageError, match="6"):
        errors_by_views(scene, box, city.dsm, (6,), settings)
    with pytest.raises(StageError, match="expected a scene with a georeference"):
        errors_by_views(scene.replace(georeference=None), box, city.dsm, (2,), settings)
