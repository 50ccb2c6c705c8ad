"""Views of a scene, whatever its cameras, as unit directions about a focus point."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError, StageError
from toolkit.geometry.cameras import Camera
from toolkit.geometry.rays import ray_equations
from toolkit.scene import Frame, Scene

Array = NDArray[np.float64]

#: Optical axes whose directions are within this of each other, in radians, meet nowhere that could be told.
_PARALLEL = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class SceneViews:
    """Viewing directions of a scene's training frames.

    Attributes
    ----------
    names:
        Of the n frames, in the scene's order.
    directions:
        (n, 3) unit, in world coordinates, away from the sensor: towards the focus point for cameras with a centre
        (satellite paper, section 4.2), along the rays of the picture's middle for cameras without one.
    centres:
        (n, 3) camera centres; NaN where a camera has none (affine, RPC).
    focus:
        (3,) the focus point in world coordinates.
    focus_from:
        ``"points"``, ``"axes"`` or ``"given"``.
    away:
        Frames that are left out because the focus point is behind them.
    unposed:
        Frames that are left out because they have no pose.
    """

    names: tuple[str, ...]
    directions: Array
    centres: Array
    focus: Array
    focus_from: str
    away: tuple[str, ...] = ()
    unposed: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.names)

    def to_dict(self) -> dict[str, Any]:
        """Return all of it, ready for JSON; a camera without centre has None for it."""
        return {
            "names": list(self.names),
            "directions": self.directions.tolist(),
            "centres": [centre.tolist() if np.isfinite(centre).all() else None for centre in self.centres],
            "focus": self.focus.tolist(),
            "focus_from": self.focus_from,
            "away": list(self.away),
            "unposed": list(self.unposed),
        }


def scene_views(scene: Scene, *, focus: ArrayLike | None = None, focus_by: str = "auto") -> SceneViews:
    """Return the viewing directions of a scene's training frames about a focus point.

    A camera whose rays start at one place has a centre, and its direction is that from there to the focus point.
    One whose rays do not (an affine or RPC camera) looks along the ray of its middle pixel, wherever the focus is.

    Parameters
    ----------
    focus:
        (3,) the focus point in world coordinates.
    focus_by:
        Without one, how it is found: ``"points"`` (their median), ``"axes"`` (the place with the least sum of
        squared distances to all optical axes, the rays of the middle pixels), or ``"auto"``: points where there are
        some.

    Raises
    ------
    DataError
        For a focus that is not finite (3,), or where a camera stands.
    StageError
        Where no training frame has a pose, the picture's middle has no ray, there is no way to find the focus, or
        it lies behind every camera.
    """
    frames = [frame for frame in scene.frames if frame.split == "train"]
    unposed = tuple(frame.name for frame in frames if frame.cam_from_world is None)
    posed = [frame for frame in frames if frame.cam_from_world is not None]
    if not posed:
        raise StageError(
            "No training frame has a pose, so no view has a direction",
            found=f"{len(frames)} training frames of {len(scene)}",
            todo="Find the poses first",
        )
    rays = [_middle_ray(scene.camera_of(frame), frame) for frame in posed]
    origins, axes = np.array([ray.origin for ray in rays]), np.array([ray.direction for ray in rays])
    central = np.array([ray.central for ray in rays])
    place, origin = _focus(scene, focus, focus_by, origins, axes, central)
    offset = place - origins
    distance = np.linalg.norm(offset, axis=1)
    at_focus = central & (distance <= 1e-12 * max(1.0, float(np.abs(place).max())))
    if at_focus.any():
        raise DataError(
            f"The camera of frame '{posed[int(np.argmax(at_focus))].name}' stands at the focus point",
            expected="a focus point that cameras look at from some distance",
            found=str(place.tolist()),
        )
    towards = offset / np.where(distance > 0, distance, 1.0)[:, None]
    # A camera without a centre looks along its ray wherever the focus is.
    seen = ~central | ((towards * axes).sum(axis=1) > 0)
    if not seen.any():
        raise StageError(
            "The focus point lies behind every camera",
            expected="cameras that look at one place",
            found=f"focus {np.round(place, 3).tolist()} from {origin}",
            todo="Give the focus point",
        )
    directions, centres = np.where(central[:, None], towards, axes), np.where(central[:, None], origins, np.nan)
    return SceneViews(
        names=tuple(frame.name for frame, good in zip(posed, seen, strict=True) if good),
        directions=directions[seen],
        centres=centres[seen],
        focus=place,
        focus_from=origin,
        away=tuple(frame.name for frame, good in zip(posed, seen, strict=True) if not good),
        unposed=unposed,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Ray:
    """The ray (origin and direction (3,), world) of a picture's middle, and whether all rays have that origin."""

    origin: Array
    direction: Array
    central: bool


def _middle_ray(camera: Camera, frame: Frame) -> _Ray:
    assert frame.cam_from_world is not None
    middle = np.array([camera.width, camera.height]) / 2
    origins, directions = camera.ray(np.stack([middle, middle / 2]))
    if not np.isfinite(directions[0]).all():
        raise StageError(
            f"The middle of picture '{frame.name}' has no viewing ray", todo="Check the camera's distortion"
        )
    world_from_cam = frame.cam_from_world.inverse()
    return _Ray(
        world_from_cam.apply(origins[0]),
        world_from_cam.rotation @ directions[0],
        bool(np.array_equal(origins[0], origins[1])),
    )


def _focus(
    scene: Scene, given: ArrayLike | None, by: str, origins: Array, axes: Array, central: NDArray[np.bool_]
) -> tuple[Array, str]:
    """Return the focus point (3,) and where it comes from."""
    if given is not None:
        place = np.asarray(given, dtype=np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise DataError("The focus point is wrong", expected="three finite coordinates", found=repr(given))
        return place, "given"
    points = scene.points.xyz if scene.points is not None else np.zeros((0, 3))
    if by == "auto":
        by = "points" if len(points) else "axes"
    if by == "points":
        if not len(points):
            raise StageError(
                "The scene has no points to take the focus from",
                todo="Set focus to axes, or give the focus point",
            )
        return np.median(points, axis=0), "points"
    return _nearest_to_axes(origins, axes, need=bool(central.any())), "axes"


def _nearest_to_axes(origins: Array, axes: Array, need: bool) -> Array:
    """Return the place (3,) with the least sum of squared distances to lines.

    Parallel lines have many; they are an error where the place matters (``need``), else the one nearest to the mean
    origin is taken.
    """
    middle = origins.mean(axis=0)
    (normal,), (side,) = ray_equations(origins - middle, axes, np.zeros(len(axes), dtype=np.int64), 1)
    if need and np.linalg.eigvalsh(normal)[0] <= _PARALLEL**2 * len(axes):
        raise StageError(
            "All optical axes are parallel and meet nowhere",
            expected="axes that come near one place, or points",
            found=f"{len(axes)} frames",
            todo="Give the focus point, or a scene with points",
        )
    place: Array = middle + np.linalg.lstsq(normal, side, rcond=_PARALLEL**2)[0]
    return place


def named_views(scene: Scene, views: SceneViews, text: str, must: bool) -> tuple[int, ...]:
    """Return indices in ``views`` of frame names with semicolons between them.

    Parameters
    ----------
    must:
        Whether frames that are no candidates are errors; else they are left out.

    Raises
    ------
    DataError
        For names that are not in the scene, and for frames that cannot be chosen though they must.
    """
    names = dict.fromkeys(name.strip() for name in text.split(";") if name.strip())
    known = [frame.name for frame in scene.frames]
    place = {name: index for index, name in enumerate(views.names)}
    for name in names:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            raise DataError(
                f"No frame '{name}' in the scene",
                expected="names of frames with semicolons between them",
                todo=f"Did you mean '{close[0]}'?" if close else "",
            )
        if must and name not in place:
            raise DataError(f"Frame '{name}' cannot be chosen", found=_why_not(scene, views, name))
    return tuple(place[name] for name in names if name in place)


def _why_not(scene: Scene, views: SceneViews, name: str) -> str:
    if scene.frame(name).split == "test":
        return "a test frame"
    return "no pose" if name in views.unposed else "the focus point behind it"


def with_views(scene: Scene, names: Sequence[str]) -> Scene:
    """Return the scene with only these of its training frames; its test frames stay.

    Observations by other frames go, and points that nothing observes then, so that a map which starts from the
    points knows no more than the chosen views tell. Points without tracks stay.
    """
    chosen = set(names)
    kept = np.array([frame.split == "test" or frame.name in chosen for frame in scene.frames], dtype=bool)
    frames = tuple(frame for frame, keep in zip(scene.frames, kept, strict=True) if keep)
    points = scene.points
    if points is not None and points.tracks is not None:
        points = points.observed(kept[points.tracks.frame])
        assert points.tracks is not None
        number = np.cumsum(kept) - 1
        points = dataclasses.replace(
            points, tracks=dataclasses.replace(points.tracks, frame=number[points.tracks.frame])
        )
    return scene.replace(frames=frames, points=points)
