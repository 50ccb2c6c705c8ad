"""Surface models drawn: where their cells lie, what is cut, what cannot be drawn."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.plots.surface_model import LONGEST_SIDE, surface_models_figure, view_count_figure
from toolkit.scene.dsm_files import SurfaceModel


def model(rows: int, columns: int, west: float = 500.0, north: float = 900.0, side: float = 0.5) -> SurfaceModel:
    heights = np.add.outer(10.0 * np.arange(rows), np.arange(columns)).astype(np.float32)
    return SurfaceModel(heights, (west, north), side, "EPSG:32617")


def test_models_of_different_grids_lie_where_the_map_has_them() -> None:
    found, true = model(40, 60, west=495.0, north=905.0), model(20, 40)
    drawn = surface_models_figure({"<found>": found, "true": true}, true, most=3.0, title="city")
    images, maps = drawn.layout.images, drawn.data
    assert [trace.type for trace in maps] == ["heatmap"] * 3
    assert [
        (one.xref, one.yref, one.x, one.y, one.sizex, one.sizey, one.xanchor, one.yanchor) for one in images
    ] == [
        ("x", "y", 0, 10, 20, 10, None, None),  # from the left and the top, by default
        ("x2", "y2", 0, 10, 20, 10, None, None),
    ]
    # Both begin in the north-west corner of the true one, which is the smaller: rows go south from there.
    for trace in maps:
        assert (trace.x0, trace.dx, trace.y0, trace.dy) == (0.25, 0.5, 9.75, -0.5)
        assert np.asarray(trace.z).shape == (20, 40)
    np.testing.assert_array_equal(maps[0].z, found.heights[10:30, 10:50])
    np.testing.assert_array_equal(maps[1].z, true.heights)
    assert drawn.layout.xaxis.range == (0, 20)
    assert drawn.layout.yaxis.range == (0, 10)
    assert (drawn.layout.coloraxis2.cmin, drawn.layout.coloraxis2.cmax) == (-3.0, 3.0)
    titles = [one.text for one in drawn.layout.annotations]
    assert titles == ["&lt;found&gt;", "true", "found minus true"]


def test_slopes_towards_the_light_are_bright_and_the_unknown_stays_empty() -> None:
    import base64
    import io

    from PIL import Image

    heights = np.zeros((30, 60), np.float32)
    heights[:, :20] = np.arange(20)  # rises to the east: faces west
    heights[:, 40:] = -np.arange(20)  # falls to the east
    heights[:, 30] = np.nan
    drawn = surface_models_figure({"a": SurfaceModel(heights, (0.0, 0.0), 1.0, "EPSG:32617")})
    (image,) = drawn.layout.images
    grey = np.asarray(Image.open(io.BytesIO(base64.b64decode(image.source.split(",")[1]))).convert("L"), float)
    assert grey[15, 10] > grey[15, 25] + 20 > grey[15, 50] + 40
    (map_,) = [trace for trace in drawn.data if trace.type == "heatmap"]
    assert np.isnan(np.asarray(map_.z)[:, 30]).all()
    assert "coloraxis2" not in drawn.layout.to_plotly_json()


def test_large_models_are_thinned() -> None:
    drawn = surface_models_figure({"a": model(3, 2 * LONGEST_SIDE + 1)})
    (map_,) = [trace for trace in drawn.data if trace.type == "heatmap"]
    assert np.asarray(map_.z).shape[1] <= LONGEST_SIDE
    assert map_.dx == 1.5


def test_a_model_smaller_than_a_cell_of_another_is_drawn() -> None:
    drawn = surface_models_figure({"fine": model(2, 2, side=0.1), "coarse": model(4, 4)})
    sizes = [np.asarray(trace.z).shape for trace in drawn.data if trace.type == "heatmap"]
    assert sizes == [(2, 2), (1, 1)]


def test_models_that_share_no_ground_are_refused() -> None:
    other = SurfaceModel(model(4, 4).heights, (500.0, 900.0), 0.5, "EPSG:32631")
    with pytest.raises(DataError, match="found 2 models on EPSG:32617, EPSG:32631"):
        surface_models_figure({"a": model(4, 4), "b": other})
    with pytest.raises(DataError, match="found 2 models on EPSG:32617, apart"):
        surface_models_figure({"a": model(4, 4), "b": model(4, 4, west=600.0)})
    with pytest.raises(DataError, match="found 0 models on no map"):
        surface_models_figure({})
    empty = SurfaceModel(np.full((4, 4), np.nan, np.float32), (500.0, 900.0), 0.5, "EPSG:32617")
    with pytest.raises(DataError, match="nothing to draw; expected known heights"):
        surface_models_figure({"a": empty})


def test_errors_are_lines_over_the_number_of_views() -> None:
    drawn = view_count_figure({"most <spread>": {6: 0.8, 3: 1.5}, "random": {3: 2.0}}, measure="error in m")
    first, second = drawn.data
    assert first.name == "most &lt;spread&gt;"
    assert (list(first.x), list(first.y)) == ([3, 6], [1.5, 0.8])
    assert list(second.x) == [3]
    assert list(drawn.layout.xaxis.tickvals) == [3, 6]
    assert drawn.layout.yaxis.title.text == "error in m"
    with pytest.raises(DataError, match="No errors to draw; expected some by number of views; found 1 empty lists"):
        view_count_figure({"a": {}})
