"""Ours: render again from the pose that was found until it stands still, and say so where the camera is lost.

The paper renders once, at the start (section 3.2). What a render from ten metres away shows is seen at other angles
than in the photo, and each Gaussian that is off its surface moves what it shows: the pose ends metres off. From the
pose itself the render shows what the photo shows, errors of depth along the ray do no harm any more, and only what
remains displaced across the ray counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from toolkit.geometry.rigid import RigidTransform
from toolkit.localize.fan import fan_poses
from toolkit.localize.judge import likeness, objection
from toolkit.localize.matched_round import Clock, match_view, moved_by
from toolkit.localize.pnp import pose_covariance
from toolkit.localize.polish import polish
from toolkit.localize.query import Query, flat_picture, render_camera, shrunk_query
from toolkit.localize.result import Array, Localization, Round
from toolkit.localize.settings import LocalizeSettings, PnpSettings
from toolkit.localize.splat_map import MapView, SplatMap
from toolkit.localize.starts import Start
from toolkit.matching.picture_features import PictureFeatures, PictureMatcher, picture_matcher

# Steps that are this many standard deviations of the pose are no motion, only other matches.
_NOISE = 3.0
# Pixels of the longer side below which a photo is not shrunk: fewer hold no features.
_LEAST_SIDE = 160
# Of the longer side of the matched photo: where the map's blur is wider, matches may not miss by all of it.
_WIDEST_BLUR = 0.025


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """What one photo's search knows from its beginning to its end."""

    query: Query
    photo: PictureFeatures
    pnp: PnpSettings
    seed: int
    clock: Clock


class Localizer:
    """Localises photos in a map.

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

    name = "ours"

    def __init__(
        self,
        splat_map: SplatMap,
        settings: LocalizeSettings,
        *,
        matcher: PictureMatcher | None = None,
        device: str = "cpu",
    ) -> None:
        self._map, self._settings = splat_map, settings
        self.matcher = matcher if matcher is not None else picture_matcher(settings.match, device=device)
        self._detail = splat_map.detail()

    def localize(
        self, query: Query, start: Start, *, features: PictureFeatures | None = None, seed: int = 0
    ) -> Localization:
        """Return the pose of a photo, searched for from a start, or why it was not found.

        Parameters
        ----------
        features:
            Of the photo, by the same matcher; found here where they are None, or where the photo is shrunk.
        seed:
            Of RANSAC.
        """
        clock = Clock()
        search = self._search(query, start.cam_from_world, features, seed, clock)
        trail, reason = self._rounds(search, start)
        told = _on_photo(trail, search.query, query)
        if reason:
            return _not_found(query, reason, told, clock)
        last = trail[-1]
        assert last.cam_from_world is not None  # or there is a reason
        pose = last.cam_from_world
        covariance = self._covariance(search, last)
        view = self._render(search, pose)
        depth = _depth(view)
        if self._settings.polish.use and covariance is not None:
            with clock.part("polish"):
                pose = self._polished(search, pose, covariance, depth)
            if pose is not last.cam_from_world:
                view = self._render(search, pose)
        with clock.part("judge"):
            picture, shown = flat_picture(search.query, view.camera)
            alike = likeness(picture, view.colour, view.reliable & shown)
            reason = objection(
                pose, covariance, start, depth, last.inliers, last.matches, alike, self._settings.judge
            )
        if reason:
            return _not_found(query, reason, told, clock)
        return Localization(query.name, pose, "", last.matches, last.inliers, covariance, told, clock.seconds)

    def _search(
        self, query: Query, start: RigidTransform, features: PictureFeatures | None, seed: int, clock: Clock
    ) -> _Search:
        """Begin with the photo, shrunk where its pixels are finer than what the map can show from the start."""
        settings = self._settings
        with clock.part("render"):
            camera = render_camera(query.camera, settings.fan.side)
            view = self._map.render(camera, start, settings.reliable)
        # How many pixels of the photo the map's small Gaussians take; unknown where none is in view.
        seen = bool((view.depth > 0).any())
        detail = self._detail * float(query.camera.intrinsics[0, 0]) / _depth(view) if seen else 0.0
        shrunk = shrunk_query(query, settings.finest * detail, least_side=_LEAST_SIDE)
        blur = settings.blur * detail * shrunk.camera.width / query.camera.width
        widest = _WIDEST_BLUR * max(shrunk.camera.width, shrunk.camera.height)
        error = max(settings.pnp.max_error, min(blur, widest))
        with clock.part("features"):
            known = features if shrunk is query else None
            photo = known if known is not None else self.matcher.features(shrunk.picture)
        return _Search(shrunk, photo, settings.pnp.replace({"max_error": error}), seed, clock)

    def _rounds(self, search: _Search, start: Start) -> tuple[tuple[Round, ...], str]:
        """Return the rounds, the last of which has the pose, or the reason why there is none."""
        settings, pose = self._settings, start.cam_from_world
        trail: list[Round] = []
        fanned, left, move = False, settings.rounds, np.inf
        while left > 0:
            view = self._render(search, pose)
            done = self._match(search, view)
            trail.append(done)
            if done.cam_from_world is None or done.inliers < settings.judge.min_inliers:
                if fanned:
                    return tuple(trail), _too_few(done, settings.judge.min_inliers)
                with search.clock.part("fan"):
                    better = self._fan(search, start)
                fanned = True
                if better is None:
                    return tuple(trail), _too_few(done, settings.judge.min_inliers)
                pose = better
                continue
            depth = _depth(view)
            move, pose, left = moved_by(pose, done.cam_from_world, depth), done.cam_from_world, left - 1
            if move <= settings.still * depth:
                return tuple(trail), ""
        covariance = self._covariance(search, trail[-1])
        noise = 0.0 if covariance is None else _NOISE * float(np.sqrt(np.trace(covariance[:3, :3])))
        if move <= max(settings.still * depth, noise):
            return tuple(trail), ""
        return tuple(trail), f"the pose still moves by {move:.3g} after {settings.rounds} rounds"

    def _fan(self, search: _Search, start: Start) -> RigidTransform | None:
        """Return the pose that most matches of a small render agree with, or None where none has enough."""
        settings = self._settings
        camera = render_camera(search.query.camera, settings.fan.side)
        picture, _ = flat_picture(search.query, camera)
        photo = self.matcher.features(picture)
        best, most = None, settings.pnp.min_inliers - 1
        for pose in fan_poses(start, settings.fan.most, settings.fan.reach):
            view = self._map.render(camera, pose, settings.reliable)
            if not view.reliable.any():
                continue
            done = match_view(
                view,
                photo,
                camera,
                self.matcher,
                settings.pnp,
                all_depths=False,
                seed=search.seed,
                clock=Clock(),
            )
            if done.cam_from_world is not None and done.inliers > most:
                best, most = done.cam_from_world, done.inliers
            if most >= settings.fan.enough:
                break
        return best

    def _render(self, search: _Search, pose: RigidTransform) -> MapView:
        with search.clock.part("render"):
            camera = render_camera(search.query.camera, self._settings.render_side)
            return self._map.render(camera, pose, self._settings.reliable)

    def _match(self, search: _Search, view: MapView) -> Round:
        return match_view(
            view,
            search.photo,
            search.query.camera,
            self.matcher,
            search.pnp,
            all_depths=False,
            seed=search.seed,
            clock=search.clock,
        )

    def _covariance(self, search: _Search, done: Round) -> Array | None:
        assert done.cam_from_world is not None
        inside = done.inside
        ahead = done.cam_from_world.apply(done.points[inside])[:, 2]
        return pose_covariance(
            done.cam_from_world,
            done.photo_pixels[inside],
            done.points[inside],
            search.query.camera,
            map_sigma=self._settings.judge.map_sigma * float(np.median(ahead)),
        )

    def _polished(self, search: _Search, pose: RigidTransform, covariance: Array, depth: float) -> RigidTransform:
        """Return the polished pose, or the one that it began from where that went too far."""
        settings = self._settings
        done = polish(self._map, search.query, pose, depth, settings.polish, settings.reliable)
        if done.cam_from_world is None:
            return pose
        off = done.cam_from_world.centre - pose.centre
        distance = float(np.sqrt(off @ np.linalg.solve(covariance[:3, :3], off)))
        return done.cam_from_world if distance <= settings.polish.max_move else pose


def _on_photo(trail: tuple[Round, ...], matched: Query, whole: Query) -> tuple[Round, ...]:
    """Return rounds with their pixels on the whole photo, of which a smaller one was matched."""
    factor = np.array([whole.camera.width / matched.camera.width, whole.camera.height / matched.camera.height])
    return tuple(replace(each, photo_pixels=each.photo_pixels * factor) for each in trail)


def _depth(view: MapView) -> float:
    """Return the median depth of what a view shows reliably, or of all that it shows."""
    for chosen in (view.reliable, view.depth > 0):
        if chosen.any():
            return float(np.median(view.depth[chosen]))
    return 1.0


def _too_few(done: Round, least: int) -> str:
    return f"{done.inliers} of {done.matches} matches agree, {least} are needed"


def _not_found(query: Query, reason: str, trail: tuple[Round, ...], clock: Clock) -> Localization:
    last = trail[-1]
    return Localization(query.name, None, reason, last.matches, last.inliers, trail=trail, seconds=clock.seconds)
