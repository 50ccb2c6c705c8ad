"""What a recipe needs that this machine lacks, told without loading any of it."""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path

from toolkit.depth.moge_depth import DEFAULT_WEIGHTS as MOGE_WEIGHTS
from toolkit.depth.settings import DepthSettings
from toolkit.depth.transformers_depth import DEFAULT_WEIGHTS as DPT_WEIGHTS
from toolkit.depth.video_depth import DEFAULT_WEIGHTS as VIDEO_WEIGHTS
from toolkit.poses.feedforward.depth_anything import DEFAULT_WEIGHTS as DA3_WEIGHTS
from toolkit.poses.feedforward.dust3r import DEFAULT_WEIGHTS as DUST3R_WEIGHTS
from toolkit.poses.feedforward.mast3r import DEFAULT_WEIGHTS as MAST3R_WEIGHTS
from toolkit.poses.feedforward.settings import FeedForwardSettings
from toolkit.poses.feedforward.vggt import DEFAULT_WEIGHTS as VGGT_WEIGHTS
from toolkit.recipes.colmap_3dgs import Colmap3dgsSettings
from toolkit.recipes.depth_fusion import DepthFusionSettings
from toolkit.recipes.noposegs import NoposegsSettings
from toolkit.recipes.slam_noposegs import OrbslamNoposegsSettings
from toolkit.settings import Settings

_PACKAGES = {"transformers": "transformers", "moge": "moge", "video": "video_depth_anything"}
#: Of networks that say cameras and points: their packages and their usual weights.
_NETWORKS = {
    "vggt": ("vggt", VGGT_WEIGHTS),
    "dust3r": ("dust3r", DUST3R_WEIGHTS),
    "mast3r": ("mast3r", MAST3R_WEIGHTS),
    "depth-anything-3": ("depth_anything_3", DA3_WEIGHTS),
}


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
    network = getattr(settings, "network", None)
    if isinstance(network, FeedForwardSettings):
        return _no_network(network)
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
    return _no_package(package) or _no_weights(weights, depth.download, "depth")


def _no_network(network: FeedForwardSettings) -> str:
    if network.provider == "file":
        there = Path(network.file or "\0").exists()
        return "" if there else "predictions missing: network.file names no file or folder"
    package, default = _NETWORKS[network.provider]
    return _no_package(package) or _no_weights(network.weights or default, network.download, "network")


def _no_weights(weights: str, download: bool, group: str) -> str:
    if download or Path(weights).exists() or _in_hub_cache(weights):
        return ""
    return f"weights missing: no '{weights}' (hf download {weights}, or set {group}.download or {group}.weights)"


def _no_package(name: str) -> str:
    return "" if importlib.util.find_spec(name) is not None else f"package missing: {name}"


def _in_hub_cache(name: str) -> bool:
    """Whether the Hugging Face cache has any version of a network by its name there."""
    if importlib.util.find_spec("huggingface_hub") is None:
        return False
    cache = Path(importlib.import_module("huggingface_hub.constants").HF_HUB_CACHE)
    return any((cache / f"models--{name.replace('/', '--')}" / "snapshots").glob("*/*"))
