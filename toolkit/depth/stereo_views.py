"""Pictures of a scene as stereo sees them."""

from __future__ import annotations

import numpy as np

from toolkit.depth.patchmatch import StereoView
from toolkit.geometry.cameras import ColmapCamera
from toolkit.scene import Scene
from toolkit.scene.pictures import load_grey, load_mask


def load_stereo_view(scene: Scene, name: str) -> StereoView:
    """Return a frame's picture as stereo sees it, NaN where its mask leaves it out."""
    frame = scene.frame(name)
    camera = scene.camera_of(frame)
    assert isinstance(camera, ColmapCamera)
    assert frame.cam_from_world is not None
    grey = load_grey(scene.image_path(frame)).astype(np.float32) / np.float32(255)
    mask = load_mask(scene, frame)
    if mask is not None:
        grey[~mask] = np.nan
    return StereoView(grey, camera, frame.cam_from_world)
