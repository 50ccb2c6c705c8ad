"""A run's splat and cameras as a viewer shows them: around the origin, with everything that is seen from there."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import RunError, StageError
from toolkit.files import disk_errors
from toolkit.runs.folder import RunFolder
from toolkit.runs.run_map import splat_kind
from toolkit.scene.folder import SCENE_FILE

if TYPE_CHECKING:
    from torch import Tensor

    from toolkit.geometry.cameras import ColmapCamera
    from toolkit.geometry.rigid import RigidTransform
    from toolkit.scene import Scene
    from toolkit.splat.gaussians import Gaussians
    from toolkit.splat.rasterize import Kind

Array = NDArray[np.float64]
Use = Literal["train", "test", "query", "start"]
Stamp = tuple[int, int, int]

_SOLID = 0.5
# As many points tell distances well enough, for each of hundreds of cameras.
_MOST_POINTS = 4000
_FEWEST_SEEN = 10
# Sides of the drawn pyramids as a share of the scene's radius.
_SMALLEST_FRUSTUM, _LARGEST_FRUSTUM = 0.03, 0.1


@dataclass(frozen=True, slots=True)
class QueryPose:
    """A picture that was localised in a run's splat.

    Attributes
    ----------
    name:
        What it is called on the page.
    camera:
        That took it.
    cam_from_world:
        In the world of the run's scene.
    photo:
        Its file, or None.
    """

    name: str
    camera: ColmapCamera
    cam_from_world: RigidTransform
    photo: Path | None = None


@dataclass(frozen=True, slots=True)
class ViewCamera:
    """A camera of the run, in the viewer's coordinates: the world's axes around :attr:`ViewScene.centre`.

    Attributes
    ----------
    name:
        Of its frame.
    use:
        ``"train"``, ``"test"``, ``"query"``, or ``"start"``: where the search for the query's pose began.
    position:
        (3,) of its centre.
    rotation:
        (4,) ``wxyz`` of ``world_from_cam`` (x right, y down, z forward).
    focal, principal:
        In pixels, without distortion.
    size:
        Width and height in pixels.
    distance:
        Depth of what it looks at.
    photo:
        Its file, which need not be there; None where none is known.
    """

    name: str
    use: Use
    position: Array
    rotation: Array
    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]
    distance: float
    photo: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return what the browser draws; it is not told where the photo lies."""
        (fx, fy), (cx, cy), (width, height) = self.focal, self.principal, self.size
        return {
            "name": self.name,
            "use": self.use,
            "position": self.position.tolist(),
            "rotation": self.rotation.tolist(),
            "lens": {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height},
            "distance": self.distance,
        }


@dataclass(frozen=True, slots=True, eq=False)
class ViewScene:
    """What a viewer needs of one run, but its Gaussians.

    Attributes
    ----------
    run, stamp:
        The run, and its :func:`splat_stamp` when it was read.
    kind, count:
        Of its Gaussians.
    centre:
        (3,) float64 world coordinates of the viewer's origin, the median of what is solid.
    up:
        (3,) unit vector.
    radius:
        How far from the origin the run's cameras are, in scene units: the measure for steps and sizes.
    frustum:
        Length of a drawn pyramid.
    cameras:
        Training and test cameras in order of capture, then the query.
    remarks:
        What is not shown as it is.
    unposed:
        Names of the frames without a pose.
    """

    run: RunFolder
    stamp: Stamp
    kind: Kind
    count: int
    centre: Array
    up: Array
    radius: float
    frustum: float
    cameras: tuple[ViewCamera, ...]
    remarks: tuple[str, ...]
    unposed: tuple[str, ...] = ()

    def home(self) -> ViewCamera:
        """Return where the viewer begins: at the first camera, or before the splat where there is none."""
        if self.cameras:
            return self.cameras[0]
        from toolkit.geometry.rigid import RigidTransform

        # Any direction that is not straight from above.
        aside = np.eye(3)[int(np.argmin(np.abs(self.up)))]
        aside = aside - (aside @ self.up) * self.up
        position = self.radius * (0.9 * aside / np.linalg.norm(aside) + 0.45 * self.up)
        turned = RigidTransform.look_at(position, np.zeros(3), self.up).inverse()
        distance = float(np.linalg.norm(position))
        return ViewCamera("", "train", position, turned.quaternion, (600, 600), (400, 300), (800, 600), distance)


@dataclass(frozen=True, slots=True)
class ViewSplat:
    """A run as it is drawn.

    Attributes
    ----------
    scene:
        All but the Gaussians.
    gaussians:
        Around the origin: their world coordinates less the scene's centre, subtracted in float64.
    """

    scene: ViewScene
    gaussians: Gaussians


def splat_stamp(run: RunFolder) -> Stamp | None:
    """Return what changes when a run's splat or scene is written again, None where it has no splat."""
    try:
        splat = run.splat_file.stat()
        scene = (run.scene_folder / SCENE_FILE).stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return splat.st_mtime_ns, splat.st_size, scene.st_mtime_ns


def read_view(run: RunFolder, query: QueryPose | None = None) -> ViewSplat:
    """Return a run's splat and cameras.

    Raises
    ------
    RunError
        Where the run has no splat.
    DataError
        Where splat or scene is damaged.
    """
    stamp = splat_stamp(run)
    if stamp is None:
        raise RunError(
            f"Run {run.id} has no splat",
            expected="a finished run of a method that makes one",
            todo="Choose another run",
        )
    from toolkit.scene.folder import read_scene
    from toolkit.splat.ply import read_splats

    with disk_errors(run.path, "reading"):
        gaussians, scene = read_splats(run.splat_file), read_scene(run.scene_folder)
    if not len(gaussians):
        raise RunError(f"The splat of run {run.id} is empty", expected="at least one Gaussian")
    remarks: list[str] = []
    means = gaussians.means.numpy().astype(np.float64)
    solid = gaussians.opacity_logits.sigmoid().numpy() > _SOLID
    points = means[solid] if solid.any() else means
    points = points[:: -(-len(points) // _MOST_POINTS)]
    centre = np.median(points, axis=0)
    up = _up(scene, remarks)
    shots = _shots(scene, query, remarks)
    # Where parallel rays come from is nowhere: an affine camera's pose is a place among the points.
    centres = np.array([pose.centre for _, use, _, pose, _ in shots if use != "query"]).reshape(-1, 3)
    radius = _radius(points - centre, centres - centre)
    frustum = _frustum(centres, radius)
    cameras = tuple(_view_camera(shot, points, centre, radius) for shot in shots)
    unposed = tuple(frame.name for frame in scene.frames if frame.cam_from_world is None)
    kind, told = splat_kind(run), tuple(remarks)
    view = ViewScene(run, stamp, kind, len(means), centre, up, radius, frustum, cameras, told, unposed)
    shifted = _tensor(means - centre)
    return ViewSplat(view, dataclasses.replace(gaussians, means=shifted))


def _tensor(values: Array) -> Tensor:
    import torch

    return torch.from_numpy(values.astype(np.float32))


def _up(scene: Scene, remarks: list[str]) -> Array:
    from toolkit.splat.camera_path import up_direction

    try:
        return up_direction(scene)
    except StageError as error:
        remarks.append(f"{error} The z axis is drawn upwards.")
        return np.array([0.0, 0.0, 1.0])


_Shot = tuple[str, Use, "ColmapCamera", "RigidTransform", Path | None]


def _shots(scene: Scene, query: QueryPose | None, remarks: list[str]) -> list[_Shot]:
    """Return name, use, camera, pose and photo of everything that is drawn as a camera."""
    from toolkit.geometry.cameras import ColmapCamera

    shots: list[_Shot] = []
    others, bent = 0, 0
    for frame in scene.registered:
        camera, pose = scene.camera_of(frame), frame.cam_from_world
        if not isinstance(camera, ColmapCamera) or pose is None:
            others += 1
            continue
        bent += not camera.is_pinhole
        shots.append((frame.name, frame.split, camera, pose, scene.image_path(frame)))
    if others:
        remarks.append(f"{others} cameras are no perspective cameras and are not drawn.")
    if bent:
        remarks.append("Lens distortion is not drawn: photos differ from the view at their edges.")
    if query is not None:
        shots.append((query.name, "query", query.camera, query.cam_from_world, query.photo))
    return shots


def _radius(points: Array, centres: Array) -> float:
    """Return the median distance of the cameras; where there are none, one from which the points are seen."""
    spread = float(np.quantile(np.linalg.norm(points, axis=1), 0.9))
    if not len(centres):
        return max(2 * spread, 1e-6)
    return max(float(np.median(np.linalg.norm(centres, axis=1))), 1e-2 * spread, 1e-6)


def _view_camera(shot: _Shot, points: Array, centre: Array, radius: float) -> ViewCamera:
    name, use, camera, cam_from_world, photo = shot
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    seen = cam_from_world.apply(points)
    seen = seen[seen[:, 2] > 1e-3 * radius]
    across = np.abs(seen[:, :2] / seen[:, 2:]) <= (camera.width / fx / 2, camera.height / fy / 2)
    depths = seen[across.all(axis=1), 2]
    return ViewCamera(
        name=name,
        use=use,
        position=cam_from_world.centre - centre,
        rotation=cam_from_world.inverse().quaternion,
        focal=(fx, fy),
        principal=(cx, cy),
        size=(camera.width, camera.height),
        distance=float(np.median(depths)) if len(depths) >= _FEWEST_SEEN else radius,
        photo=photo,
    )


def _frustum(centres: Array, radius: float) -> float:
    """Return half the usual step between cameras, within bounds."""
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    usual = 0.5 * float(np.median(steps)) if len(steps) else 0.0
    return float(np.clip(usual, _SMALLEST_FRUSTUM * radius, _LARGEST_FRUSTUM * radius))
