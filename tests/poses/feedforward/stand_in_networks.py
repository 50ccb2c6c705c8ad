"""Stand-ins for the packages of feed-forward networks: the calls that they document, with made-up answers.

They know nothing of pictures. Each says what cameras of its own maps are, so that a test can follow them back.
"""

from __future__ import annotations

import enum
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

#: What the stand-ins were called with, last.
asked = SimpleNamespace()


def install(monkeypatch: pytest.MonkeyPatch, **modules: dict[str, Any]) -> None:
    """Put modules, named with __ for dots, where packages would be, and packages above them."""
    for name, content in modules.items():
        dotted = name.replace("__", ".")
        for part in range(1, dotted.count(".") + 1):
            parent = ".".join(dotted.split(".")[:part])
            if parent not in sys.modules:
                monkeypatch.setitem(sys.modules, parent, ModuleType(parent))
        module = ModuleType(dotted)
        for key, value in content.items():
            setattr(module, key, value)
        monkeypatch.setitem(sys.modules, dotted, module)


def world_from_cam(index: int) -> np.ndarray:
    """Return the pose (4, 4) that every stand-in gives the picture ``index``: turned about y, and moved."""
    angle = 0.1 * index
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = [0.5 * index, 0.1, -0.2 * index]
    return pose


class Network(torch.nn.Module):
    """Two tensors, read strictly or from a folder as huggingface's mixin does."""

    def __init__(self, width: int = 3) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(width, 1)

    @classmethod
    def from_pretrained(cls, place: str) -> Network:
        made = cls(**json.loads((Path(place) / "config.json").read_text()))
        made.load_state_dict(load_file(Path(place) / "model.safetensors"), strict=False)
        return made


def weights_folder(folder: Path, **config: Any) -> Path:
    """Write weights of :class:`Network`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config))
    save_file({"layer.weight": torch.ones(1, 3), "layer.bias": torch.ones(1)}, folder / "model.safetensors")
    return folder


class Vggt(Network):
    """Its poses are encoded as VGGT's: translation, quaternion (xyzw), vertical and horizontal field of view."""

    FIELDS = (0.7, 0.9)

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        asked.images = images
        count, _, height, width = images.shape
        encoding = torch.zeros(1, count, 9)
        for i in range(count):
            cam_from_world = np.linalg.inv(world_from_cam(i))
            encoding[0, i, :3] = torch.from_numpy(cam_from_world[:3, 3])
            half = -0.05 * i
            encoding[0, i, 3:7] = torch.tensor([0, np.sin(half), 0, np.cos(half)])
            encoding[0, i, 7:] = torch.tensor(self.FIELDS)
        shape = (1, count, height, width)
        return {
            "pose_enc": encoding,
            "depth": torch.full((*shape, 1), 2.0),
            "depth_conf": torch.full(shape, 1.5),
            "world_points": torch.full((*shape, 3), 0.25),
            "world_points_conf": torch.full(shape, 3.0),
        }


def decode(encoding: torch.Tensor, size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (B, S, 3, 4) and (B, S, 3, 3) as VGGT's ``pose_encoding_to_extri_intri`` does, for turns about y."""
    count = encoding.shape[1]
    extrinsics, intrinsics = torch.zeros(1, count, 3, 4), torch.zeros(1, count, 3, 3)
    for i in range(count):
        sine, cosine = encoding[0, i, 4], encoding[0, i, 6]
        angle = 2 * torch.atan2(sine, cosine)
        extrinsics[0, i, :, :3] = torch.tensor(
            [[torch.cos(angle), 0, torch.sin(angle)], [0, 1, 0], [-torch.sin(angle), 0, torch.cos(angle)]]
        )
        extrinsics[0, i, :, 3] = encoding[0, i, :3]
        height, width = size
        intrinsics[0, i] = torch.tensor(
            [
                [width / 2 / torch.tan(encoding[0, i, 8] / 2), 0, width / 2],
                [0, height / 2 / torch.tan(encoding[0, i, 7] / 2), height / 2],
                [0, 0, 1],
            ]
        )
    return extrinsics, intrinsics


class Dust3r(Network):
    """The network itself is asked by ``inference`` only."""


class Mode(enum.Enum):
    """As ``GlobalAlignerMode``."""

    PointCloudOptimizer = "PointCloudOptimizer"
    PairViewer = "PairViewer"


def make_pairs(views: list[dict[str, Any]], scene_graph: str, prefilter: None, symmetrize: bool) -> list[Any]:
    """Return all pairs."""
    asked.views, asked.scene_graph, asked.symmetrize = views, scene_graph, symmetrize
    return [(a, b) for a in views for b in views if a is not b]


def inference(pairs: list[Any], model: Any, device: str, batch_size: int, verbose: bool) -> dict[str, Any]:
    """Return the pictures' sizes where the package has predictions of pairs."""
    assert isinstance(model, Network)
    return {"views": asked.views}


class Aligned:
    """As the package's optimisers: poses are ``world_from_cam``, pixel centres at whole numbers."""

    FOCAL = 300.0

    def __init__(self, views: list[dict[str, Any]], mode: Mode) -> None:
        self._sizes = [tuple(view["img"].shape[-2:]) for view in views]
        asked.mode, asked.noise = mode, float(torch.randn(()))
        self._done = mode is Mode.PairViewer
        self.im_conf = [torch.full(size, 1.0 + i) for i, size in enumerate(self._sizes)]

    def compute_global_alignment(self, init: str, niter: int, schedule: str, lr: float) -> float:
        asked.alignment = (init, niter, schedule, lr)
        self._done = True
        return 0.0

    def get_intrinsics(self) -> torch.Tensor:
        assert self._done
        made = torch.zeros(len(self._sizes), 3, 3)
        for i, (height, width) in enumerate(self._sizes):
            made[i] = torch.tensor([[self.FOCAL, 0, width / 2], [0, self.FOCAL, height / 2], [0, 0, 1]])
        return made

    def get_im_poses(self) -> torch.Tensor:
        return torch.tensor(np.array([world_from_cam(i) for i in range(len(self._sizes))]), requires_grad=True)

    def get_depthmaps(self) -> list[torch.Tensor]:
        return [torch.full(size, 2.0 + i, requires_grad=True) for i, size in enumerate(self._sizes)]


def global_aligner(output: dict[str, Any], device: str, mode: Mode, verbose: bool) -> Aligned:
    """As the package's."""
    return Aligned(output["views"], mode)


class SparseAligned(Aligned):
    """As ``SparseGA``: intrinsics are an attribute, dense depth comes flat."""

    @property
    def intrinsics(self) -> list[torch.Tensor]:
        return list(self.get_intrinsics())

    def get_dense_pts3d(self, clean_depth: bool) -> tuple[list[Any], list[torch.Tensor], list[torch.Tensor]]:
        assert clean_depth
        depth = self.get_depthmaps()
        return [None] * len(depth), [values.ravel() for values in depth], self.im_conf


def sparse_global_alignment(
    names: list[str], pairs: list[Any], cache: str, model: Any, **options: Any
) -> SparseAligned:
    """As the package's."""
    assert Path(cache).is_dir()
    assert len(set(names)) == len(names)
    asked.options = options
    return SparseAligned(asked.views, Mode.PairViewer)


class DepthAnything3(Network):
    """Scales pictures as the package does, in effect: to the size that the test says."""

    sky: np.ndarray | None = None
    cameras = True
    size = (378, 504)

    def inference(self, image: list[np.ndarray], process_res: int, process_res_method: str) -> SimpleNamespace:
        asked.image, asked.process = image, (process_res, process_res_method)
        height, width = self.size
        count = len(image)
        k = np.array([[400.0, 0, width / 2], [0, 410.0, height / 2], [0, 0, 1]], dtype=np.float32)
        poses = np.array([np.linalg.inv(world_from_cam(i))[:3] for i in range(count)])
        return SimpleNamespace(
            depth=np.full((count, height, width), 3.0, np.float32),
            conf=np.full((count, height, width), 2.0, np.float32),
            sky=self.sky,
            extrinsics=poses if self.cameras else None,
            intrinsics=np.repeat(k[None], count, 0) if self.cameras else None,
        )


def install_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put every stand-in where its package would be."""
    install(
        monkeypatch,
        vggt__models__vggt={"VGGT": Vggt},
        vggt__utils__pose_enc={"pose_encoding_to_extri_intri": decode},
        dust3r__model={"AsymmetricCroCo3DStereo": Dust3r},
        dust3r__inference={"inference": inference},
        dust3r__image_pairs={"make_pairs": make_pairs},
        dust3r__cloud_opt={"global_aligner": global_aligner, "GlobalAlignerMode": Mode},
        mast3r__model={"AsymmetricMASt3R": Dust3r},
        mast3r__cloud_opt__sparse_ga={"sparse_global_alignment": sparse_global_alignment},
        depth_anything_3__api={"DepthAnything3": DepthAnything3},
    )
