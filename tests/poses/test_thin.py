"""Fewer points that still hold every picture."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from synthetic_matches import synthetic_matches

from toolkit.poses.thin import thin_points
from toolkit.scene import scene_to_pycolmap


def test_every_picture_keeps_its_points_and_long_tracks_stay(tmp_path: Path) -> None:
    truth, _ = synthetic_matches(tmp_path, frames=8, points=300)
    model = scene_to_pycolmap(truth)
    lengths = {number: point.track.length() for number, point in model.points3D.items()}
    had = Counter(e.image_id for point in model.points3D.values() for e in point.track.elements)
    removed = thin_points(model, 40)
    assert removed == len(lengths) - model.num_points3D() > 100
    has = Counter(e.image_id for point in model.points3D.values() for e in point.track.elements)
    assert all(has[image] >= min(40, had[image]) for image in had)
    kept = [lengths[number] for number in model.point3D_ids()]
    assert np.mean(kept) >= np.mean(list(lengths.values()))
    assert thin_points(model, 10_000) == 0
