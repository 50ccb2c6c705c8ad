"""The paper's localisation: render once, match, back-project, PnP (uav-splat-localization, section 3.2).

Nothing is repeated and nothing is judged but the number of inliers: what it finds is as good as its start. With
SuperPoint and LightGlue this is the paper's method; with other features it runs under a name of its own
(:func:`one_shot_name`).
"""

from __future__ import annotations

from toolkit.localize.matched_round import Clock, match_view
from toolkit.localize.pnp import pose_covariance
from toolkit.localize.query import Query, render_camera
from toolkit.localize.result import Localization
from toolkit.localize.settings import OneShotSettings, ReliabilitySettings
from toolkit.localize.splat_map import SplatMap
from toolkit.localize.starts import Start
from toolkit.matching.picture_features import PictureFeatures, PictureMatcher, picture_matcher

_NAMES = {
    "superpoint-lightglue": "paper",
    "sift": "one-shot-sift",
    "aliked-lightglue": "one-shot-aliked",
    "disk-lightglue": "one-shot-disk",
}


def one_shot_name(method: str) -> str:
    """Return what the one shot with these features is called in tables: ``paper`` with the paper's own."""
    return _NAMES[method]


class OneShot:
    """Localises photos in one render each.

    Parameters
    ----------
    splat_map:
        The map.
    settings:
        As declared.
    matcher:
        One that is there already; by default it is made from the settings.
    device:
        Where networks compute.

    Raises
    ------
    MissingDependencyError, WeightsMissingError
        As :func:`toolkit.matching.picture_features.picture_matcher`.
    """

    def __init__(
        self,
        splat_map: SplatMap,
        settings: OneShotSettings,
        *,
        matcher: PictureMatcher | None = None,
        device: str = "cpu",
    ) -> None:
        self._map, self._settings = splat_map, settings
        self.matcher = matcher if matcher is not None else picture_matcher(settings.match, device=device)

    @property
    def name(self) -> str:
        """What it is called in tables."""
        return one_shot_name(self.matcher.method)

    def localize(
        self, query: Query, start: Start, *, features: PictureFeatures | None = None, seed: int = 0
    ) -> Localization:
        """Return the pose of a photo, found from the pose of a start; how sure that is plays no part.

        Parameters
        ----------
        features:
            Of the photo, by the same matcher; found here where they are None.
        seed:
            Of RANSAC.
        """
        settings, clock = self._settings, Clock()
        with clock.part("features"):
            photo = features if features is not None else self.matcher.features(query.picture)
        with clock.part("render"):
            camera = render_camera(query.camera, settings.render_side)
            view = self._map.render(camera, start.cam_from_world, ReliabilitySettings())
        done = match_view(
            view, photo, query.camera, self.matcher, settings.pnp, all_depths=True, seed=seed, clock=clock
        )
        pose, reason, covariance = done.cam_from_world, "", None
        if pose is None or done.inliers < settings.pnp.min_inliers:
            reason = f"{done.inliers} of {done.matches} matches agree, {settings.pnp.min_inliers} are needed"
            pose = None
        else:
            inside = done.inside
            covariance = pose_covariance(pose, done.photo_pixels[inside], done.points[inside], query.camera)
        return Localization(
            query.name, pose, reason, done.matches, done.inliers, covariance, (done,), clock.seconds
        )
