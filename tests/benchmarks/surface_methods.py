"""Measures what surface each method makes of a computed engine, a computed town and real facades.

``TOOLKIT_DATA=<folder> python tests/benchmarks/surface_methods.py [--data engine fountain] [--work DIR]``
prints a table for each data set and writes ``<work>/pictures/<data>.png``: photo, mesh from the same camera, its
distance, for every method; and for the engine and the town how far the mesh is from the truth. Poses are the
reference's, so that the surface alone differs. Real facades have no true surface here: of them there are times,
sizes and pictures.

The external depth that ``depth-fusion`` takes is that of the splat which ``splat-mesh`` trained: no network's
weights are needed, and nothing of it is known from the truth.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import ToolkitError
from toolkit.geometry.ray_casting import MeshCaster
from toolkit.notebook import measures_text, surface_measures
from toolkit.notebook import sample_folder as made
from toolkit.poses.undistort import undistort
from toolkit.progress import TqdmProgress
from toolkit.recipes.splat_mesh import SplatMeshSettings
from toolkit.runs.folder import RunFolder
from toolkit.runs.recipe_run import recipe_run
from toolkit.samples.engine import EngineSettings, open_engine
from toolkit.samples.make import SampleSettings
from toolkit.samples.registry import locate
from toolkit.samples.surfaces import sample_folder, true_surface
from toolkit.scene import Frame, Scene
from toolkit.scene.dataset import open_capture
from toolkit.scene.folder import read_scene
from toolkit.scene.mesh_files import read_mesh
from toolkit.scene.pictures import load_picture
from toolkit.splat.depth_views import splat_depth_views
from toolkit.splat.ply import read_splats

METHODS = ("mvs-poisson", "splat-mesh", "depth-fusion", "ds-nerf")
#: Width of a picture on the sheet; the error at the end of the colours, in shares of the median depth.
_WIDE, _WORST = 320, 0.03
#: From where meshes are lit, in camera axes.
_SUN = np.array([-0.4, -0.5, -0.77])

Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Data:
    """A data set, and the settings that every method has there."""

    folder: Callable[[Path], Path]
    settings: Callable[[Path], Mapping[str, Any]] = field(default=lambda folder: {})


def _engine(work: Path) -> Path:
    film = {"film.frames": 24, "film.stride": 6, "points": 0}
    size = {"borescope.image_width": 320, "borescope.image_height": 240}
    return made(work, EngineSettings().replace({**film, **size}), progress=TqdmProgress())


def _of_engine(folder: Path) -> Mapping[str, Any]:
    near = {"method": "sequential", "overlap": open_engine(folder).window, "quadratic": False}
    faint = {"peak_threshold": 0.003, "first_octave": -1}
    return {"scene.masks.find": True, "scene.points": {"pairs": near, "sift": faint}}


def _town(work: Path) -> Path:
    return made(work, SampleSettings().replace({"flight.frames": 30}), progress=TqdmProgress())


def _real(name: str) -> Callable[[Path], Path]:
    def folder(_: Path) -> Path:
        found = locate(name)
        if found is None:
            raise SystemExit(f"{name} is not here: set TOOLKIT_DATA to the folder that has it")
        return found

    return folder


DATA = {
    "engine": Data(_engine, _of_engine),
    "town": Data(_town, lambda _: {"stereo.max_side": 320}),
    "fountain": Data(_real("strecha_fountain_p11"), lambda _: {"stereo.max_side": 576}),
    "herz-jesus": Data(_real("strecha_herz_jesus_p25"), lambda _: {"stereo.max_side": 384}),
}


def settings_of(method: str, common: Mapping[str, Any], steps: int, depth: Path | None) -> dict[str, Any]:
    """Return what changes in a method's settings; ``depth`` is the folder of maps that ``depth-fusion`` takes."""
    stereo = {name: value for name, value in common.items() if name.startswith("stereo.")}
    rest = {"scene.way": "given", **{name: value for name, value in common.items() if name not in stereo}}
    if method == "ds-nerf":
        return {**rest, "train.steps": steps, "train.max_side": 320}
    if method == "splat-mesh":
        return {**rest, "train.steps": steps, "train.max_side": 480}
    if method == "mvs-poisson":
        return {**rest, **stereo}
    arrays = {"provider": "arrays", "arrays": str(depth), "kind": "affine-depth"}
    return {**rest, **stereo, "external.use": "fill", "external.depth": arrays}


def splat_depth(run: RunFolder, work: Path) -> Path:
    """Write the median depth of a run's splat for every picture, of its undistorted size; return the folder."""
    folder = work / f"depth-{run.id}"
    if folder.is_dir():
        return folder
    part = work / f"flat-{run.id}"
    flat = undistort(read_scene(run.scene_folder), part)
    # Test pictures take part in the fusion of the other methods, too.
    everything = flat.replace(frames=tuple(dataclasses.replace(frame, split="train") for frame in flat.frames))
    settings = SplatMeshSettings().replace(run.record().settings).train.replace({"max_side": 8192})
    made = work / f"depth-{run.id}.part"
    for view in splat_depth_views(read_splats(run.splat_file), everything, settings):
        path = made / f"{view.name}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, view.depth)
    shutil.rmtree(part, ignore_errors=True)  # not there where no picture had distortion
    return made.rename(folder)


def shaded(depth: NDArray[np.floating], rays: NDArray[np.floating]) -> Image8:
    """Return a picture (H, W, 3) of a surface, lit from beside the camera; black where there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        points = rays * (np.where(depth > 0, depth, np.nan) / rays[..., 2])[..., None]
        normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        light = np.abs(normal @ (_SUN / np.linalg.norm(_SUN)))
    grey = np.nan_to_num(40 + 215 * light).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)


def coloured(values: NDArray[np.floating], low: float, high: float) -> Image8:
    """Return values as colours, dark where they are low; black where they are not finite."""
    from plotly.colors import sample_colorscale, unlabel_rgb

    scale = np.array([unlabel_rgb(c) for c in sample_colorscale("viridis", np.linspace(0, 1, 256).tolist())])
    place = np.clip(np.nan_to_num((values - low) / max(high - low, 1e-12)), 0, 1)
    return np.where(np.isfinite(values)[..., None], scale[(255 * place).astype(int)], 0).astype(np.uint8)


def sheet(scene: Scene, frame: Frame, runs: Mapping[str, RunFolder]) -> Image.Image:
    """Return photo, mesh, distance and (where the truth is known) its error for each method, a row each."""
    camera, pose = scene.camera_of(frame), frame.cam_from_world
    assert pose is not None
    column, line = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = camera.ray(np.stack([column.ravel(), line.ravel()], axis=1))[1].reshape(*column.shape, 3)
    sample = sample_folder(scene)
    truth = None if sample is None else MeshCaster(true_surface(sample)).depth(camera, pose)
    photo, rows = load_picture(scene.image_path(frame)), []
    low = high = 0.0
    for run in runs.values():
        depth = MeshCaster(read_mesh(run.artifacts / "mesh.ply")).depth(camera, pose)
        seen = np.where(depth > 0, depth, np.nan)
        if not high:
            low, high = np.nanpercentile(seen if truth is None else truth[truth > 0], [2, 98])
        row = [photo, shaded(depth, rays), coloured(seen, low, high)]
        if truth is not None:
            off = np.abs(np.where(truth > 0, seen - truth, np.nan))
            row.append(coloured(off, 0.0, _WORST * 0.5 * (low + high)))
        rows.append(row)
    if truth is not None:
        rows.append([photo, shaded(truth, rays), coloured(np.where(truth > 0, truth, np.nan), low, high)])
    return _laid_out(rows)


def _laid_out(rows: Sequence[Sequence[Image8]]) -> Image.Image:
    tall = round(_WIDE * rows[0][0].shape[0] / rows[0][0].shape[1])
    whole = Image.new("RGB", (_WIDE * max(map(len, rows)), tall * len(rows)))
    for i, row in enumerate(rows):
        for k, picture in enumerate(row):
            whole.paste(Image.fromarray(picture).resize((_WIDE, tall)), (k * _WIDE, i * tall))
    return whole


def measure(name: str, methods: Sequence[str], work: Path, steps: int) -> None:
    """Run the methods on a data set, print its table and write its pictures."""
    data, bar = DATA[name], TqdmProgress()
    folder = data.folder(work)
    common, runs = data.settings(folder), {}
    for method in methods:
        depth = splat_depth(runs["splat-mesh"], work) if method == "depth-fusion" else None
        try:
            runs[method] = recipe_run(
                method, folder, settings_of(method, common, steps, depth), work / "runs", progress=bar
            )
        except ToolkitError as error:
            print(f"{name}, {method}: {error}", flush=True)
    bar.close()
    print(f"\n{name}\n{measures_text({method: surface_measures(run) for method, run in runs.items()})}", flush=True)
    scene = open_capture(folder).reference
    meshes = {method: run for method, run in runs.items() if (run.artifacts / "mesh.ply").is_file()}
    if scene is not None and meshes:
        pictures = work / "pictures"
        pictures.mkdir(parents=True, exist_ok=True)
        middle = scene.registered[len(scene.registered) // 2]
        sheet(scene, middle, meshes).save(pictures / f"{name}.png")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--data", nargs="+", choices=DATA, default=list(DATA), help="which data sets [all]")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="[all]")
    parser.add_argument("--steps", type=int, default=1000, help="of every training [1000]")
    parser.add_argument(
        "--work", type=Path, default=Path("runs/bench-surfaces"), help="folder for runs and pictures"
    )
    options = parser.parse_args()
    if "depth-fusion" in options.methods and "splat-mesh" not in options.methods:
        parser.error("depth-fusion takes the depth of splat-mesh: name it, too")
    for name in options.data:
        measure(name, [method for method in METHODS if method in options.methods], options.work, options.steps)


if __name__ == "__main__":
    main()
