"""The provider that the settings name."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from toolkit.depth.array_depth import ArrayDepth
from toolkit.depth.ground_depth import GroundDepth
from toolkit.depth.moge_depth import MogeDepth
from toolkit.depth.monocular import DepthKind, MonocularDepth
from toolkit.depth.settings import DepthSettings
from toolkit.depth.transformers_depth import TransformersDepth
from toolkit.depth.video_depth import VideoDepth
from toolkit.errors import SettingsError
from toolkit.files import disk_errors


def depth_provider(settings: DepthSettings) -> MonocularDepth:
    """Return the provider of ``settings``, loaded and ready.

    Raises
    ------
    SettingsError
        Where ``kind`` is given for a provider whose values have one meaning only.
    MissingDependencyError
        Where a package is missing; :class:`~toolkit.errors.WeightsMissingError` where weights are.
    DataError
        For weights or folders that are not what they should be.
    """
    kind = None if settings.kind == "auto" else cast(DepthKind, settings.kind)
    if kind is not None and settings.provider in ("moge", "video", "ground"):
        raise SettingsError(
            f"The provider '{settings.provider}' says itself what its values are",
            expected="kind=auto",
            found=f"kind={kind}",
        )
    if settings.provider == "ground":
        return GroundDepth(settings.ground)
    if settings.provider == "arrays":
        if not settings.arrays:
            raise SettingsError(
                "The provider 'arrays' needs a folder", expected="arrays=<folder of .npy or .npz files>"
            )
        return ArrayDepth(Path(settings.arrays), kind or "metric")
    if settings.provider == "moge":
        return MogeDepth(
            settings.weights, version=settings.moge_version, download=settings.download, device=settings.device
        )
    if settings.provider == "video":
        return VideoDepth(settings.weights, download=settings.download, device=settings.device)
    return TransformersDepth(settings.weights, kind=kind, download=settings.download, device=settings.device)


def source_files(settings: DepthSettings) -> dict[str, Any]:
    """Return size and time of every local file that depth is made from: outputs made of older ones are stale.

    Empty for a network that the hub keeps, and for the ground plane.

    Raises
    ------
    RunError
        Where the folder may not be read.
    """
    place = Path(settings.arrays if settings.provider == "arrays" else settings.weights)
    if settings.provider == "ground" or place == Path() or not place.exists():
        return {}
    with disk_errors(place, "reading"):
        files = sorted(path for path in place.rglob("*") if path.is_file()) if place.is_dir() else [place]
        return {str(path): [path.stat().st_size, path.stat().st_mtime_ns] for path in files}
