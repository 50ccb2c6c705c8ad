"""Localising a photo of which nothing is known in a map of tiles: retrieval, then render, match and solve."""

from __future__ import annotations

import dataclasses

import numpy as np

from toolkit.localize.localizer import Localizer
from toolkit.localize.matched_round import Clock
from toolkit.localize.query import Query, render_camera
from toolkit.localize.result import Localization
from toolkit.localize.retrieval import PlaceIndex
from toolkit.localize.settings import LocalizeSettings
from toolkit.localize.starts import Start
from toolkit.localize.tiles import TiledMap
from toolkit.matching.picture_features import PictureMatcher


def localize_anywhere(
    tiled: TiledMap,
    places: PlaceIndex,
    query: Query,
    settings: LocalizeSettings,
    matcher: PictureMatcher,
    *,
    tries: int = 5,
    seed: int = 0,
) -> Localization:
    """Return the pose of a photo that may be of any part of a map, or why it was not found.

    The pictures of the index that look most like it are tried one after the other: their poses are starts of which
    nothing is sure (no gate, no fan), and the tiles around their views are the map.

    Parameters
    ----------
    matcher:
        Of method ``sift``, by which the index was made.
    tries:
        Pictures of the index that are tried.
    """
    clock = Clock()
    with clock.part("features"):
        features = matcher.features(query.picture)
    with clock.part("retrieval"):
        chosen = places.nearest(features, tries)
    # A start of infinite sigma has no fan that could be drawn.
    alone = settings.replace({"fan.most": 0})
    camera = render_camera(query.camera, settings.render_side)
    last = Localization(query.name, None, "the photo looks like no part of the map")
    for number in chosen:
        pose = places.poses[number]
        with clock.part("tiles"):
            # Half a view more on all sides: the pose will move.
            part = tiled.around(camera, pose, margin=0.5 * tiled.side)
        if part is None:
            continue
        start = Start(query.name, pose, np.inf, np.inf)
        last = Localizer(part, alone, matcher=matcher).localize(query, start, features=features, seed=seed)
        for name, seconds in last.seconds.items():
            clock.seconds[name] = clock.seconds.get(name, 0.0) + seconds
        if last:
            break
    return dataclasses.replace(last, seconds=clock.seconds)
