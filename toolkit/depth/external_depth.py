"""Depth from elsewhere in COLMAP's format: any provider's, fitted to each picture's sparse points.

The paper's attempt to put such maps in place of COLMAP's failed at the format ("blade inspection", section 4.5).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.depth.dense_folder import DenseFolder, DepthViews, open_depth_views
from toolkit.depth.dense_pictures import make_dense_folder
from toolkit.depth.dense_record import begin_record, scene_key
from toolkit.depth.fit import DepthFit, fit_depth
from toolkit.depth.monocular import DepthPrediction, MonocularDepth, load_checked_picture
from toolkit.depth.normals import normals_from_depth
from toolkit.depth.patchmatch import PlaneMaps
from toolkit.depth.reject import border_pixels, depth_edges
from toolkit.depth.stereo_settings import ExternalSettings
from toolkit.depth.stereo_views import load_stereo_view
from toolkit.depth.view_choice import with_tracks
from toolkit.errors import DataError, StageError
from toolkit.files import read_json, write_json
from toolkit.progress import Progress, silent, track
from toolkit.scene import Frame, Scene

Image = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class FrameExternal:
    """What became of one picture's external depth.

    Attributes
    ----------
    name:
        Of the frame.
    fit:
        Scale, shift, residual and the number of points that they rest on, as plain values.
    pixels:
        How many pixels are ``external``, ``both``, ``stereo`` in the written map, and why others were rejected
        (``border``, ``masked``, ``edge``, ``confidence``, ``far``).
    reason:
        Why its external depth was not used; empty where it was.
    """

    name: str
    fit: dict[str, Any]
    pixels: dict[str, int]
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, slots=True)
class ExternalResult:
    """A dense folder with depth from elsewhere, and how it came about.

    Attributes
    ----------
    folder:
        COLMAP's dense workspace.
    provider:
        Name of the depth's source.
    frames:
        One entry for each frame with a pose.
    """

    folder: Path
    provider: str
    frames: tuple[FrameExternal, ...]

    @property
    def views(self) -> DepthViews:
        """The depth views, read from the disk when they are asked for."""
        return open_depth_views(self.folder)

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {
            "provider": self.provider,
            "used": sum(not frame.reason for frame in self.frames),
            "frames": [frame.to_dict() for frame in self.frames],
        }


def external_depth(
    scene: Scene,
    provider: MonocularDepth,
    settings: ExternalSettings,
    folder: Path,
    *,
    longest: int,
    stereo: Path | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> ExternalResult:
    """Write a provider's depth, fitted to the scene's points, into a dense folder, alone or with stereo's.

    A picture with too few points to fit to is left out, with its reason; stereo's map of it stays where there is
    one.
    Maps that are whole from an earlier call with the same scene, settings and seed are not made again.

    Parameters
    ----------
    scene:
        With poses, PINHOLE cameras and points.
    folder:
        Of the dense workspace that is made.
    longest:
        Longest side of the maps in pixels, see :func:`~toolkit.depth.dense_pictures.make_dense_folder`.
    stereo:
        Dense folder of :func:`~toolkit.depth.stereo.stereo_depth` with the same ``longest``; not read where
        ``settings.use`` is ``replace``.
    seed:
        Of the robust fits.

    Raises
    ------
    StageError
        Without frames with poses, without stereo where it is wanted, or where no picture gets a map.
    DataError
        Where a picture, a depth map or a map of stereo is damaged or of the wrong size.
    CapabilityError
        For cameras with distortion.
    """
    if settings.use != "replace" and stereo is None:
        raise StageError(
            f"External depth is to be used as '{settings.use}' with stereo's, but there is none",
            todo="Run stereo first, or set use=replace",
        )
    if not scene.registered:
        raise StageError("No frame has a pose", expected="one or more", found=f"none of {len(scene)}")
    begin_record(folder, scene_key(scene, settings, seed) + f" {provider.name} {stereo}")
    dense = make_dense_folder(scene, folder, longest, progress=progress)
    work = _Maker(
        with_tracks(scene),
        provider,
        settings,
        dense,
        DenseFolder(stereo) if stereo is not None and settings.use != "replace" else None,
    )
    frames = []
    for number, frame in enumerate(track(scene.registered, "depth.external", progress)):
        note = dense.stereo / "external" / f"{frame.name}.json"
        if not note.is_file():
            write_json(note, work.make(frame, seed + number).to_dict())
        frames.append(FrameExternal(**read_json(note)))
    names = [frame.name for frame in frames if dense.has(frame.name)]
    if not names:
        raise StageError(
            f"No picture has a depth map ({provider.name})",
            expected=f"depth that fits to the points in some of {len(frames)} pictures",
            found=f"for '{frames[0].name}': {frames[0].reason}",
            todo="Give the scene more points, or choose another provider",
        )
    dense.write_lists({name: [other for other in names if other != name] for name in names})
    return ExternalResult(folder, provider.name, tuple(frames))


class _Maker:
    """Makes one map after the other."""

    def __init__(
        self,
        scene: Scene,
        provider: MonocularDepth,
        settings: ExternalSettings,
        dense: DenseFolder,
        stereo: DenseFolder | None,
    ) -> None:
        self._scene, self._provider, self._settings = scene, provider, settings
        self._dense, self._stereo = dense, stereo

    def make(self, frame: Frame, seed: int) -> FrameExternal:
        """Write the maps of a frame where it gets any, and return what became of it."""
        fit, confidence = self._fitted(frame, seed)
        reason = "" if fit.rule in ("points", "scene units") and fit else fit.reason or "nothing to scale it by"
        if fit.depth is not None and reason and not fit.pairs:
            reason = f"it sees no points to be scaled by ({fit.reason})"
        pixels: dict[str, int] = {}
        planes, kept = None, None
        if not reason:
            assert fit.depth is not None
            planes, kept, pixels = self._usable(frame, fit, confidence)
            if not kept.any():
                reason = "no pixel has usable depth"
        pixels |= (
            self._merged(frame.name, planes, kept) if kept is not None else self._merged(frame.name, None, None)
        )
        return FrameExternal(frame.name, dataclasses.replace(fit, depth=None).to_dict(), pixels, reason)

    def _fitted(self, frame: Frame, seed: int) -> tuple[DepthFit, Image | None]:
        """Return the depth at the size of the dense folder's pictures, and the provider's confidence."""
        shape = load_checked_picture(self._scene, frame).shape[:2]
        prediction: DepthPrediction = self._provider.predict(self._scene, frame)
        if prediction.values.shape != shape:
            raise DataError(
                f"The depth of frame '{frame.name}' is not of its picture's size ({self._provider.name})",
                expected=str(shape),
                found=str(prediction.values.shape),
            )
        return fit_depth(self._scene, frame, prediction, self._settings.depth, seed=seed), prediction.confidence

    def _usable(
        self, frame: Frame, fit: DepthFit, confidence: Image | None
    ) -> tuple[PlaneMaps, NDArray[np.bool_], dict[str, int]]:
        """Return external planes in the dense folder's size, which pixels are usable, and why others are not."""
        settings, view = self._settings, load_stereo_view(self._dense.scene, frame.name)
        assert fit.depth is not None
        shape = view.grey.shape
        depth = np.nan_to_num(_nearest(fit.depth, shape), nan=0.0).astype(np.float32)
        sure = np.full(shape, settings.confidence, np.float32)
        if confidence is not None:
            sure = _nearest(confidence, shape).astype(np.float32)
        given = sure.copy()
        if np.isfinite(fit.residual):
            sure *= np.float32(max(0.0, 1 - fit.residual / (settings.depth.fit.tolerance / 100)))
        normals = normals_from_depth(depth, view.camera)
        planes = PlaneMaps(depth, normals, 1 - sure, np.ones(shape, np.float32))
        known = (depth > 0) & (normals != 0).any(axis=2)
        far = settings.depth.far * float(np.median(depth[known])) if settings.depth.far and known.any() else np.inf
        reasons = {
            "masked": np.isnan(view.grey),
            "border": border_pixels(shape, settings.border),
            "unknown": ~known,
            "edge": depth_edges(planes, view, np.ones(shape, bool), settings.edge / 100),
            "confidence": given < settings.depth.min_confidence
            if confidence is not None
            else np.zeros(shape, bool),
            "far": depth > far,
        }
        kept = np.ones(shape, bool)
        counts = {}
        for name, holds in reasons.items():
            counts[name] = int((kept & holds).sum())
            kept &= ~holds
        return planes, kept, counts

    def _merged(self, name: str, planes: PlaneMaps | None, kept: NDArray[np.bool_] | None) -> dict[str, int]:
        """Write the map of a frame from external and stereo depth, and return how many pixels are whose."""
        stereo = self._stereo
        if stereo is not None and stereo.has(name):
            depth, normals = stereo.depth(name), stereo.normals(name)
            sure = stereo.extra(name)
            sure = (depth > 0).astype(np.float32) if sure is None else sure
        elif planes is not None:
            depth, normals = np.zeros_like(planes.depth), np.zeros_like(planes.normals)
            sure = np.zeros_like(planes.depth)
        else:
            return {}
        ours = depth > 0
        both = np.zeros_like(ours)
        if planes is not None and kept is not None:
            alone = kept & ~ours
            if self._settings.use == "with":
                with np.errstate(divide="ignore", invalid="ignore"):
                    off = np.abs(planes.depth / depth - 1)
                both = kept & ours & (off <= self._settings.agree / 100)
            share = np.where(both, _share(sure, planes.confidence), alone.astype(np.float32))
            depth = (depth + share * (planes.depth - depth)).astype(np.float32)
            mixed = normals + share[:, :, None] * (planes.normals - normals)
            normals = (mixed / np.maximum(np.linalg.norm(mixed, axis=2, keepdims=True), 1e-12)).astype(np.float32)
            sure = np.where(alone, planes.confidence, np.where(both, np.maximum(sure, planes.confidence), sure))
        else:
            alone = np.zeros_like(ours)
        counts = {"external": int(alone.sum()), "both": int(both.sum()), "stereo": int((ours & ~both).sum())}
        if ours.any() or alone.any():
            self._dense.write(name, depth.astype(np.float32), normals.astype(np.float32), sure.astype(np.float32))
        return counts


def _share(sure: Image, other: Image) -> Image:
    """Return the weight of the other of two depths by their confidences."""
    share: Image = (other / np.maximum(sure + other, 1e-6)).astype(np.float32)
    return share


def _nearest(values: NDArray[np.floating], shape: tuple[int, ...]) -> NDArray[np.floating]:
    """Return a map resampled to another size by the pixel that covers each pixel's centre; depths are not mixed."""
    rows = ((np.arange(shape[0]) + 0.5) * values.shape[0] / shape[0]).astype(np.int64)
    columns = ((np.arange(shape[1]) + 0.5) * values.shape[1] / shape[1]).astype(np.int64)
    return values[np.ix_(rows, columns)]
