"""Film the rotor and write what the borescope saw, with the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from toolkit.errors import DataError, StageError, ToolkitError
from toolkit.files import atomic_folder, read_json, write_json
from toolkit.optional import require
from toolkit.progress import Progress, silent, track
from toolkit.samples.engine.motion import Motion, borescope_camera
from toolkit.samples.engine.overlay import Overlay, draw_overlay
from toolkit.samples.engine.render import NO_BLADE, Caster, Renderer, Surface
from toolkit.samples.engine.sample import MESH, RECORD, STATIC, TRUTH, VIDEO, EngineSample, read_truth
from toolkit.samples.engine.settings import EngineSettings
from toolkit.samples.engine.shape import build_rotor
from toolkit.samples.engine.wear import Sheets
from toolkit.scene import Frame, Points, Scene
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.video import encode_video

_JPEG_QUALITY = 95
_LEAST_SEEN = 0.001  # share of the picture that makes a blade a seen one
_DARKEST = 45  # grey levels: what is darker shows no blade, as those far along the ring
_OVERLAY, _NOISE, _POINTS = range(3, 6)  # streams of random numbers
_GAIN, _GAMMA = 2.4, 2.2
# Grey metal, brownish where it is dark.
_BRIGHT, _DARK = np.array([1.0, 0.985, 0.955], np.float32), np.array([1.0, 0.955, 0.89], np.float32)


def make_engine(
    folder: Path, settings: EngineSettings, *, seed: int = 0, progress: Progress = silent
) -> EngineSample:
    """Film a rotor, unless the folder holds this very film already.

    The folder holds the scene (pictures in ``images/``; true poses, camera, times, surface points), ``truth/`` with
    angles and visible blades (``frames.json``), the surface (``mesh.ply``) and what does not turn (``static.png``,
    white), ``sample.json``, and where asked for ``video.mp4`` and depth maps of the rotor (``depth/<frame
    name>.npz``, to be read as those of a town). It appears whole or not at all. Poses are those of the middle of
    the exposure. A picture of 480 x 360 pixels takes about 0.15 s of one core.

    Raises
    ------
    StageError
        When the folder holds something else, or a picture would show no blade.
    SettingsError
        When the lens has no ray for some pixels.
    RunError
        When the disk is full or may not be written.
    MissingDependencyError
        When a video is wanted and PyAV is missing.
    """
    record = {"kind": "engine", "seed": seed, "settings": settings.to_dict()}
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        if not (folder / RECORD).is_file() or read_json(folder / RECORD) != record:
            raise StageError(
                f"{folder} is in the way",
                expected="a new or an empty folder, or the engine with these settings and this seed",
                todo="Choose another or move it away",
            )
        return open_engine(folder)
    if settings.video:
        require("av")  # before the work of rendering
    film = _Film.of(settings, seed)
    if folder.exists():
        folder.rmdir()
    with atomic_folder(folder) as temporary:
        for name in ("images", "truth", *(["depth"] if settings.depth else [])):
            (temporary / name).mkdir(parents=True)
        pictures = film.shoot(temporary, progress)
        if settings.video:
            encode_video(pictures, temporary / VIDEO, settings.film.rate / settings.film.stride)
        else:
            for _ in pictures:
                pass
        film.renderer.rotor.write_ply(temporary / MESH)
        Image.fromarray(film.overlay.static).convert("L").save(temporary / STATIC)
        blades = [sorted(seen) for seen in film.seen]
        write_json(temporary / TRUTH, {"angles": film.motion.angles.tolist(), "blades": blades})
        write_scene(film.scene(temporary / "images"), temporary)
        write_json(temporary / RECORD, record)
    return open_engine(folder)


def open_engine(folder: Path) -> EngineSample:
    """Return the engine in a folder that :func:`make_engine` wrote.

    Raises
    ------
    DataError
        Where it is none, or damaged.
    """
    missing = [name for name in (RECORD, TRUTH, MESH, STATIC) if not (folder / name).is_file()]
    record = None if missing else read_json(folder / RECORD)
    if not isinstance(record, dict) or record.get("kind") != "engine":
        raise DataError(
            f"{folder} is no filmed engine",
            expected=f"{RECORD} of an engine, {TRUTH}, {MESH} and {STATIC}",
            found=f"no {' and no '.join(missing)}" if missing else f"{RECORD} of something else",
            todo="Make it again in a new folder",
        )
    try:
        settings, seed = EngineSettings.from_dict(record["settings"]), int(record["seed"])
    except (KeyError, TypeError, ValueError, ToolkitError) as error:
        raise DataError(f"{folder / RECORD} is damaged", found=str(error)) from error
    scene = read_scene(folder)
    angles, seen = read_truth(folder, len(scene.frames))
    return EngineSample(folder, settings, seed, scene, angles, seen)


@dataclass(eq=False)
class _Film:
    """A film before and while it is shot."""

    settings: EngineSettings
    seed: int
    motion: Motion
    renderer: Renderer
    overlay: Overlay
    seen: list[frozenset[int]] = field(default_factory=list)
    clouds: list[tuple[NDArray[np.float64], NDArray[np.uint8]]] = field(default_factory=list)

    @classmethod
    def of(cls, settings: EngineSettings, seed: int) -> _Film:
        """Return a film of which nothing is shot."""
        rotor = build_rotor(settings.rotor.blades, settings.rotor.radius)
        inside = borescope_camera(settings.borescope.replace({"border": 0}))
        renderer = Renderer(rotor, Sheets(settings.rotor, seed), Caster(rotor), inside, settings)
        overlay = draw_overlay(settings.borescope, np.random.default_rng([seed, _OVERLAY]))
        return cls(settings, seed, Motion(settings, seed), renderer, overlay)

    def shoot(self, folder: Path, progress: Progress) -> Iterator[NDArray[np.uint8]]:
        """Yield the pictures (H, W, 3), and write them and their depth maps below ``folder``."""
        chooser = np.random.default_rng([self.seed, _POINTS])
        moved, resting = self.motion.moved, self.motion.resting
        for number in track(range(self.settings.film.frames), "sample.engine", progress):
            picture = self.picture(number, float(moved[number]), blurred=not resting[number])
            Image.fromarray(picture).save(folder / "images" / _name(number), quality=_JPEG_QUALITY, subsampling=0)
            self._note(float(moved[number]), picture, chooser)
            if self.settings.depth:
                np.savez_compressed(
                    folder / "depth" / f"{_name(number)}.npz", depth=self._depth(float(moved[number]))
                )
            yield picture

    def picture(self, number: int, moved: float, *, blurred: bool) -> NDArray[np.uint8]:
        """Return one picture (H, W, 3) with its border."""
        film, border = self.settings.film, self.overlay.border
        share = (np.arange(film.samples) + 0.5) / film.samples - 0.5
        poses = [self.motion.pose(moved + at) for at in share * (film.exposure if blurred else 0.0)]
        grey = 255 * (1 - np.exp(-_GAIN * self.renderer.light(poses))) ** (1 / _GAMMA)
        tint = _DARK + (grey / 255)[..., None] * (_BRIGHT - _DARK)
        cover = self.overlay.casing_share[..., None]
        colour = (1 - cover) * grey[..., None] * tint + cover * self.overlay.casing
        noise = np.random.default_rng([self.seed, _NOISE, number])
        colour = colour + np.float32(film.noise) * noise.standard_normal(colour.shape, np.float32)
        over = self.overlay.icon_share[..., None]
        colour = (1 - over) * colour + over * self.overlay.icon
        inside = np.clip(np.rint(colour), 0, 255).astype(np.uint8)
        return np.pad(inside, ((border, border), (border, border), (0, 0)))

    def scene(self, pictures: Path) -> Scene:
        """Return the truth of the pictures that were shot."""
        times, moved = self.motion.times, self.motion.moved
        frames = tuple(
            Frame(_name(number), 1, self.motion.pose(float(moved[number])), time=float(times[number]))
            for number in range(len(moved))
        )
        points = None
        if self.settings.points:
            xyz, rgb = (np.concatenate(part)[: self.settings.points] for part in zip(*self.clouds, strict=True))
            points = Points(xyz, rgb)
        camera = borescope_camera(self.settings.borescope)
        return Scene(image_dir=pictures, cameras={1: camera}, frames=frames, points=points)

    def _at_centres(self, moved: float, rays: NDArray[np.float64]) -> Surface:
        """Return what rays (N, 3) through pixels' centres meet."""
        pose = self.motion.pose(moved)
        return self.renderer.caster.surface(pose.centre, rays @ pose.rotation)

    def _note(self, moved: float, picture: NDArray[np.uint8], chooser: np.random.Generator) -> None:
        """Keep which blades are seen, and some points of the surface. Every second row and column is looked at."""
        hidden = (self._inside(self.overlay.static) | (self._inside(picture.max(axis=2)) < _DARKEST))[::2, ::2]
        rays = self.renderer.centre_rays[::2, ::2][~hidden]
        surface = self._at_centres(moved, rays)
        met = surface.blades != NO_BLADE
        blades, pixels = np.unique(surface.blades[met], return_counts=True)
        if not met.any():
            raise StageError(
                f"Picture {len(self.seen)} of the engine shows no blade",
                expected="lit blades beside casing and icon",
                todo="Bring the borescope nearer, turn it towards the blades or make the casing smaller",
            )
        self.seen.append(frozenset(blades[pixels >= _LEAST_SEEN * hidden.size].tolist()))
        share = -(-self.settings.points // self.settings.film.frames)
        usable = np.flatnonzero(met)
        chosen = chooser.choice(usable, min(share, len(usable)), replace=False)
        colours = self._inside(picture)[::2, ::2][~hidden]
        self.clouds.append((surface.points[chosen], colours[chosen]))

    def _inside(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return an image without its border."""
        border, (height, width) = self.overlay.border, image.shape[:2]
        return image[border : height - border, border : width - border]

    def _depth(self, moved: float) -> NDArray[np.float32]:
        """Return the depth (H, W) in metres with the border, 0 where nothing was met."""
        rays = self.renderer.centre_rays
        points = self._at_centres(moved, rays.reshape(-1, 3)).points
        depth = self.motion.pose(moved).apply(points)[:, 2].reshape(rays.shape[:2])
        return np.pad(np.nan_to_num(depth, nan=0.0), self.overlay.border).astype(np.float32)


def _name(number: int) -> str:
    return f"frame_{number:05d}.jpg"
