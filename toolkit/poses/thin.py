"""Fewer points for a coarse adjustment: as many as hold each picture, those first that most pictures see."""

from __future__ import annotations

from collections import Counter

import pycolmap


def thin_points(reconstruction: pycolmap.Reconstruction, per_image: int) -> int:
    """Remove points that no picture needs, in place, and return how many.

    Points are gone through by the number of pictures that see them, the most first. One is kept where a picture
    that sees it has fewer than ``per_image`` points so far.
    """
    tracks = {
        point_id: [element.image_id for element in point.track.elements]
        for point_id, point in reconstruction.points3D.items()
    }
    kept: Counter[int] = Counter()
    removed = 0
    for point_id, images in sorted(tracks.items(), key=lambda item: (-len(item[1]), item[0])):
        if any(kept[image] < per_image for image in images):
            kept.update(images)
        else:
            reconstruction.delete_point3D(point_id)
            removed += 1
    return removed
