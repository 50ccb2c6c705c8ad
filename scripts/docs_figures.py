"""Draw the figures of the pages on concepts into docs/images/concepts: ``python scripts/docs_figures.py``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from docs_drawing import BLUE, GREEN, INK, ORANGE, SOFT, Drawing

from toolkit.geometry.alignment import align
from toolkit.geometry.cameras import ColmapCamera

FOLDER = Path(__file__).parents[1] / "docs" / "images" / "concepts"


def main(folder: Path = FOLDER) -> int:
    """Draw all figures into a folder."""
    for name, draw in FIGURES.items():
        draw().write(folder / f"{name}.svg")
    return 0


def flow() -> Drawing:
    """Draw what flows from pictures to a report."""
    made = Drawing(760, 130, "From a capture to a report")
    steps = (
        ("capture", "photos, video"),
        ("scene", "frames, cameras"),
        ("poses", "where they were"),
        ("map", "splat, surface"),
        ("use", "render, localise"),
        ("report", "measures, pages"),
    )
    for i, words in enumerate(steps):
        made.box((15 + 125 * i, 35), (105, 60), words, colour=GREEN if words[0] == "scene" else BLUE)
        if i:
            made.arrow((15 + 125 * i - 19, 65), (15 + 125 * i - 2, 65))
    return made


def capture() -> Drawing:
    """Draw what a method may see of a data folder, and what only its judge sees."""
    made = Drawing(760, 230, "A capture: a scene for the method and a reference for its judge")
    made.box((20, 75), (150, 80), ("data folder", "photos, scene.json,", "COLMAP model, RPCs"), colour=SOFT)
    made.box((260, 25), (190, 80), ("scene", "pictures, cameras, priors", "no poses, no points"))
    made.box((260, 130), (190, 80), ("reference", "the same frames", "with their true poses"), colour=ORANGE)
    made.box((540, 25), (200, 80), ("method", "finds poses, makes a map"))
    made.box((540, 130), (200, 80), ("measures", "found against true"), colour=ORANGE)
    made.arrow((170, 100), (258, 65))
    made.arrow((170, 130), (258, 170))
    made.arrow((450, 65), (538, 65))
    made.arrow((450, 170), (538, 170))
    made.arrow((640, 105), (640, 128))
    return made


def run() -> Drawing:
    """Draw a run: stages, where their outputs are kept, and the run's folder."""
    made = Drawing(760, 300, "A run of a recipe: its stages, the workspace, the run's folder")
    made.text((20, 30), "recipe colmap-3dgs, one run", anchor="start", bold=True)
    for i, name in enumerate(("features", "matches", "sfm", "undistort", "train", "measure")):
        made.box((20 + 122 * i, 45), (105, 45), (name,))
        if i:
            made.arrow((20 + 122 * i - 16, 67), (20 + 122 * i - 2, 67))
        kept = i < 4
        made.arrow((72 + 122 * i, 90), (72 + 122 * i, 158), colour=GREEN if kept else ORANGE)
    made.box((20, 160), (471, 120), colour=GREEN)
    made.text((255, 185), "workspace: kept between runs", bold=True)
    made.text((255, 210), "a folder for each (stage, inputs, settings, seed, code)", size=12)
    made.text((255, 232), "another run that asks for the same takes it;", size=12)
    made.text((255, 252), "a changed setting never meets a stale file", size=12)
    made.box((508, 160), (232, 120), colour=ORANGE)
    made.text((624, 185), "run folder", bold=True)
    for i, words in enumerate(("run.json, status.json", "metrics.csv, log.txt", "checkpoint/", "artifacts/")):
        made.text((624, 207 + 19 * i), words, size=12)
    return made


def cameras() -> Drawing:
    """Draw the same grid of directions as four camera models see it."""
    made = Drawing(760, 230, "One grid of directions, 15 degrees apart, seen by four camera models")
    size, focal = 160, 78.0
    middle = (size / 2, size / 2)
    models = {
        "PINHOLE": (focal, focal, *middle),
        "SIMPLE_RADIAL": (focal, *middle, -0.12),
        "OPENCV": (focal, focal, *middle, -0.16, 0.012, 0.01, -0.015),
        "OPENCV_FISHEYE": (focal, focal, *middle, -0.02, 0.0, 0.0, 0.0),
    }
    steps = np.radians(np.linspace(-45, 45, 61))
    for i, (name, params) in enumerate(models.items()):
        camera, left = ColmapCamera(name, size, size, params), 20 + 185 * i
        made.box((left, 20), (size, size), colour=SOFT)
        for angle in np.radians(np.arange(-45, 46, 15)):
            for across in (False, True):
                x, y = np.tan(np.full_like(steps, angle)), np.tan(steps)
                rays = np.stack([y, x, np.ones_like(x)] if across else [x, y, np.ones_like(x)], axis=1)
                pixels = camera.project(rays)
                inside = np.isfinite(pixels).all(axis=1) & ((pixels >= 0) & (pixels <= size)).all(axis=1)
                line = [(left + u, 20 + v) for u, v in pixels[inside]]
                if len(line) > 1:
                    made.line(line, colour=BLUE, width=1.2)
        made.text((left + size / 2, 207), name, size=13, bold=True)
    return made


def axes() -> Drawing:
    """Draw the axes of camera and world, and where a pixel's centre is."""
    made = Drawing(760, 250, "Axes of the camera and of the world, and the centre of a pixel")
    made.text((120, 30), "camera", bold=True)
    made.dot((90, 100))
    for end, words, at in (
        ((190, 100), "x right", (215, 104)),
        ((90, 200), "y down", (90, 222)),
        ((155, 60), "z forward", (170, 52)),
    ):
        made.arrow((90, 100), end, colour=BLUE, width=2)
        made.text(at, words, size=12)
    made.text((380, 30), "pixels", bold=True)
    for i in range(4):
        made.line([(310 + 45 * i, 60), (310 + 45 * i, 195)], colour=SOFT)
        made.line([(310, 60 + 45 * i), (445, 60 + 45 * i)], colour=SOFT)
    made.dot((310, 60), colour=INK)
    made.text((305, 50), "(0, 0)", size=12)
    made.dot((332.5, 82.5), colour=ORANGE)
    made.text((375, 240), "the first pixel's centre is (0.5, 0.5)", size=12, colour=ORANGE)
    made.text((620, 30), "world with a georeference", bold=True)
    made.dot((570, 170))
    for end, words, at in (
        ((670, 170), "x east", (690, 190)),
        ((635, 120), "y north", (668, 118)),
        ((570, 70), "z up", (570, 60)),
    ):
        made.arrow((570, 170), end, colour=GREEN, width=2)
        made.text(at, words, size=12)
    made.text((600, 225), "metres from a stored origin", size=12)
    return made


def splits() -> Drawing:
    """Draw which frames are test frames."""
    made = Drawing(760, 110, "Every eighth frame is a test frame")
    for i in range(24):
        test = i % 8 == 0
        made.box((20 + 30 * i, 30), (24, 32), colour=ORANGE if test else BLUE)
    made.text((20, 92), "test: gets a pose, is never trained on", size=13, colour=ORANGE, anchor="start")
    made.text((330, 92), "train", size=13, colour=BLUE, anchor="start")
    return made


def poses() -> Drawing:
    """Draw a found path beside the true one, before and after it is laid onto it."""
    made = Drawing(760, 250, "A found path before and after alignment with the true one")
    draw = np.random.default_rng(3)
    angle = np.linspace(0.4, 5.2, 22)
    true = np.stack([np.cos(angle), np.sin(angle), 0.2 * np.sin(2 * angle)], axis=1)
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    found = 0.55 * true @ turn.T + [0.35, -0.25, 0.1] + draw.normal(0, 0.04, true.shape)
    laid = align(found, true, with_scale=True).apply(found)
    for left, title, path in ((20, "as found: own scale and place", found), (400, "after Sim(3)", laid)):
        to = [(left + 170 + 85 * x, 125 - 85 * y) for x, y, _ in true]
        by = [(left + 170 + 85 * x, 125 - 85 * y) for x, y, _ in path]
        made.line(to, colour=SOFT, width=2)
        made.line(by, colour=BLUE, width=2)
        if path is laid:
            for a, b in zip(to, by, strict=True):
                made.line([a, b], colour=ORANGE, width=2)
        made.text((left + 170, 240), title, size=13)
    made.text((30, 24), "true", colour=SOFT, anchor="start", bold=True)
    made.text((80, 24), "found", colour=BLUE, anchor="start", bold=True)
    made.text((145, 24), "what POS and ATE count", colour=ORANGE, anchor="start", bold=True)
    return made


FIGURES = {
    "flow": flow,
    "capture": capture,
    "run": run,
    "cameras": cameras,
    "axes": axes,
    "splits": splits,
    "poses": poses,
}

if __name__ == "__main__":
    sys.exit(main())
