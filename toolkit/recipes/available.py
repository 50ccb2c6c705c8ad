"""What a recipe needs that this machine lacks, told without loading any of it."""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path

from toolkit.depth.moge_depth import DEFAULT_WEIGHTS as MOGE_WEIGHTS
from toolkit.depth.settings import DepthSettings
from toolkit.depth.transformers_depth import DEFAULT_WEIGHTS as DPT_WEIGHTS
from toolkit.depth.video_depth import DEFAULT_WEIGHTS as VIDEO_WEIGHTS
from toolkit.recipes.colmap_3dgs import Colmap3dgsSettings
from toolkit.recipes.depth_fusion import DepthFusionSettings
from toolkit.recipes.noposegs import NoposegsSettings
from toolkit.recipes.slam_noposegs import OrbslamNoposegsSettings
from toolkit.settings import Settings

_PACKAGES = {"transformers": "transformers", "moge": "moge", "video": "video_depth_anything"}


def missing_here(settings: Settings) -> str:
    """Return what a recipe with these settings lacks on this machine, empty where nothing is known to be missing.

    Packages are looked for without importing them, and weights by the names of their folders and files: that a file
    is there does not say that it is whole. A run says more, before it does anything else.
    """
    if isinstance(settings, OrbslamNoposegsSettings):
        return _no_package("pyorbslam3")
    if isinstance(settings, NoposegsSettings) and settings.start != "depth":
        return ""
    if isinstance(settings, DepthFusionSettings):
        return _no_depth(settings.external.depth, "external.depth")
    if isinstance(settings, Colmap3dgsSettings) and settings.depth_loss.weight == 0:
        return ""
    depth = getattr(settings, "depth", None)
    return _no_depth(depth) if isinstance(depth, DepthSettings) else ""


def _no_depth(depth: DepthSettings, group: str = "depth") -> str:
    if depth.provider == "arrays" and not Path(depth.arrays or "\0").is_dir():
        return f"depth maps missing: {group}.arrays names no folder"
    package = _PACKAGES.get(depth.provider)
    if package is None:
        return ""
    default = {
        "transformers": DPT_WEIGHTS,
        "moge": MOGE_WEIGHTS[depth.moge_version],
        "video": VIDEO_WEIGHTS,
    }[depth.provider]
    weights = depth.weights or default
    lacking = _no_package(package)
    if lacking or depth.download or Path(weights).exists() or _in_hub_cache(weights):
        return lacking
    return f"weights missing: no '{weights}' (hf download {weights}, or set depth.download or depth.weights)"


def _no_package(name: str) -> str:
    return "" if importlib.util.find_spec(name) is not None else f"package missing: {name}"


def _in_hub_cache(name: str) -> bool:
    """Whether the Hugging Face cache has any version of a network by its name there."""
    if importlib.util.find_spec("huggingface_hub") is None:
        return False
    cache = Path(importlib.import_module("huggingface_hub.constants").HF_HUB_CACHE)
    return any((cache / f"models--{name.replace('/', '--')}" / "snapshots").glob("*/*"))
