"""COLMAP's own PatchMatch stereo, where pycolmap was built with CUDA."""

from __future__ import annotations

import time
from collections.abc import Mapping

import numpy as np
import pycolmap

from toolkit.depth.dense_folder import DenseFolder
from toolkit.depth.patchmatch import PlaneMaps
from toolkit.depth.reject import rejected_pixels
from toolkit.depth.stereo_settings import StereoSettings
from toolkit.depth.stereo_views import load_stereo_view
from toolkit.depth.view_choice import ViewChoice
from toolkit.errors import CapabilityError, StageError
from toolkit.files import write_json
from toolkit.progress import Progress, ProgressEvent, silent


def require_cuda() -> None:
    """Raise :class:`CapabilityError` where pycolmap has no CUDA; nothing else is done in its place."""
    if not pycolmap.has_cuda:
        raise CapabilityError(
            "COLMAP's PatchMatch stereo cannot run here",
            expected="pycolmap built with CUDA, and a GPU",
            found="pycolmap without CUDA",
            todo="Choose method=cpu, or install pycolmap-cuda12",
        )


def colmap_patch_match(
    dense: DenseFolder, choices: Mapping[str, ViewChoice], settings: StereoSettings, *, progress: Progress = silent
) -> dict[str, float]:
    """Write maps by ``pycolmap.patch_match_stereo``, then reject pixels as for our own; return seconds by picture.

    COLMAP gives no confidence and no texture: what it filters by correlation takes their place.

    Raises
    ------
    CapabilityError
        Where pycolmap has no CUDA.
    StageError
        Where COLMAP fails or leaves a map out.
    """
    require_cuda()
    ranges = [choice.depth_range for choice in choices.values() if choice.depth_range is not None]
    options = pycolmap.PatchMatchOptions(
        depth_min=min(low for low, _ in ranges),
        depth_max=max(high for _, high in ranges),
        window_radius=settings.search.radius,
        window_step=min(settings.search.step, 2),  # COLMAP's kernels know no more
        num_iterations=settings.search.iterations + 2,
        geom_consistency=True,
        filter_min_ncc=settings.reject.min_confidence,
        filter_min_num_consistent=settings.reject.min_views,
    )
    start = time.perf_counter()
    if not all(dense.has(name) for name in choices):
        progress(ProgressEvent("stereo.colmap", 0, 1, "COLMAP's PatchMatch on the GPU"))
        try:
            pycolmap.patch_match_stereo(dense.root, options=options)
        except RuntimeError as error:
            raise StageError("COLMAP's PatchMatch stereo failed", found=str(error)) from error
    lost = [name for name in choices if not dense.has(name)]
    if lost:
        raise StageError("COLMAP left out depth maps", expected="one for each picture", found=f"none of {lost[0]}")
    share = (time.perf_counter() - start) / len(choices)
    found = {name: (dense.depth(name), dense.normals(name)) for name in choices}
    for name, (depth, normals) in found.items():
        view = load_stereo_view(dense.scene, name)
        known = (depth > 0).astype(np.float32)
        planes = PlaneMaps(depth, normals, 1 - known, known)
        kept, counts = rejected_pixels(planes, view, [], settings.reject)
        write_json(dense.stereo / "rejected" / f"{name}.json", counts)
        dense.write(name, np.where(kept, depth, 0), np.where(kept[:, :, None], normals, 0), None)
    return dict.fromkeys(choices, share)
