"""What notebooks need around the toolkit's calls, so that a cell holds one call and one picture."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.files import disk_errors
from toolkit.progress import Progress, ProgressEvent, TqdmProgress, silent

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from toolkit.poses.camera_comparison import ModelComparison
    from toolkit.poses.feedforward.simulated import SimulatedNoiseSettings
    from toolkit.runs.folder import RunFolder
    from toolkit.samples.city import CitySample, CitySettings
    from toolkit.samples.engine import EngineSettings
    from toolkit.samples.make import SampleSettings
    from toolkit.samples.nadir_flight import NadirFlightSettings
    from toolkit.samples.nadir_queries import NadirQuerySampleSettings
    from toolkit.scene import Scene


def work_folder(name: str) -> Path:
    """Return ``runs/<name>``, made where it is missing.

    It lies in the working directory, or beside it where that is the folder ``notebooks``: JupyterLab starts a
    notebook in its own folder, ``make`` and the command line start one above.

    Raises
    ------
    RunError
        Where it may not be written.
    """
    here = Path.cwd()
    folder = (here.parent if here.name == "notebooks" else here) / "runs" / name
    with disk_errors(folder, "making"):
        folder.mkdir(parents=True, exist_ok=True)
    return folder


class CellProgress:
    """Shows each stage as one bar in the cell's output; a bar ends when its stage does."""

    def __init__(self) -> None:
        self._bar = TqdmProgress(sys.stdout)
        self._ended = ""

    def __call__(self, event: ProgressEvent) -> None:
        whole = event.total is not None and event.done >= event.total
        # Stages may tell their end more than once.
        if whole and event.stage == self._ended:
            return
        self._bar(event)
        self._ended = event.stage if whole else ""
        if whole:
            self._bar.close()


def sample_folder(
    work: Path,
    settings: SampleSettings | EngineSettings | CitySettings | NadirFlightSettings | NadirQuerySampleSettings,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> Path:
    """Return the folder of a sample flight, engine or city below ``work``, making it where it is not there.

    Its name tells the settings apart, so that a changed setting never meets an older sample. Raises as
    :func:`toolkit.samples.make.make_sample`, :func:`toolkit.samples.engine.make_engine`,
    :func:`toolkit.samples.city.make_city`, :func:`toolkit.samples.nadir_flight.make_nadir_flight` and
    :func:`toolkit.samples.nadir_queries.make_nadir_queries`.
    """
    # Open3D, which casts the rays, else writes about a viewer of its own into the cell.
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "True")
    from toolkit.samples.city import CitySettings, make_city
    from toolkit.samples.engine import EngineSettings, make_engine
    from toolkit.samples.make import make_sample
    from toolkit.samples.nadir_flight import NadirFlightSettings, make_nadir_flight
    from toolkit.samples.nadir_queries import NadirQuerySampleSettings, make_nadir_queries
    from toolkit.workspace import fingerprint

    made_with = {"seed": seed, "settings": settings.to_dict()}
    mark = fingerprint(made_with)[:8]
    if isinstance(settings, EngineSettings):
        return make_engine(work / f"engine-{mark}", settings, seed=seed, progress=progress).folder
    if isinstance(settings, CitySettings):
        return make_city(work / f"city-{mark}", settings, seed=seed, progress=progress).folder
    if isinstance(settings, NadirFlightSettings):
        make_nadir_flight(work / f"nadir-{mark}", settings, seed=seed, progress=progress)
        return work / f"nadir-{mark}"
    if isinstance(settings, NadirQuerySampleSettings):
        folder = work / f"queries-{mark}"
        make_nadir_queries(folder, settings.flight, settings.queries, seed=seed, progress=progress)
        return folder
    folder = work / f"town-{mark}"
    if not folder.is_dir():
        make_sample(folder, settings, seed=seed, progress=progress)
    return folder


def poses_figure(found: Mapping[str, Scene], reference: Scene | None) -> go.Figure:
    """Draw the camera paths of several scenes in one frame, laid onto the reference or else onto the first.

    The title tells what was aligned how, and what could not be.
    """
    from toolkit.plots.style import shown
    from toolkit.plots.trajectories import trajectory_figure
    from toolkit.runs.trajectories import Trajectories, Trajectory, align_trajectories

    def path(scene: Scene) -> Trajectory:
        return Trajectory(scene.poses)

    truth = None if reference is None else path(reference)
    aligned = align_trajectories({label: Trajectories(path(scene), truth) for label, scene in found.items()})
    paths = {label: aligned.paths[label].poses if label in aligned.paths else {} for label in found}
    drawn = trajectory_figure(paths, None if aligned.reference is None else aligned.reference.poses)
    drawn.update_layout(title_text="<br>".join(shown(remark) for remark in aligned.remarks), title_font_size=12)
    return drawn.update_layout(margin_t=30 + 16 * len(aligned.remarks))


def camera_models_figure(compared: ModelComparison) -> go.Figure:
    """Draw held-out error and BIC of each camera model that was fitted, and which one was chosen."""
    from toolkit.plots.camera_models import ModelScore, model_scores_figure

    scores = []
    for fit in compared.fits:
        if fit.score is not None:
            margin = compared.choice.margins[fit.model]
            error = fit.score.held_out_rms
            parameters = fit.score.free_parameters
            scores.append(
                ModelScore(fit.model, error, margin.held_out_error, margin.bic, margin.bic_error, parameters)
            )
    return model_scores_figure(scores, compared.choice.chosen)


@dataclass(frozen=True, slots=True)
class _Stage:
    """A stage that was run in a cell."""

    name: str
    seconds: float
    reused: bool = False


def seconds_figure(ways: Mapping[str, Mapping[str, float]]) -> go.Figure:
    """Draw one bar for each way to a result, built of the seconds that its steps took."""
    from toolkit.plots.times import time_figure

    return time_figure({label: [_Stage(*step) for step in steps.items()] for label, steps in ways.items()})


def measures_text(columns: Mapping[str, Mapping[str, float | None]]) -> str:
    """Return measures as a table, one column for each entry, one row for each measure that any has."""
    from toolkit.runs.measures import format_number
    from toolkit.runs.text import table

    names = list(dict.fromkeys(name for column in columns.values() for name in column))
    if not names:
        return "Nothing was measured: the data have no reference."
    rows = [[name, *(format_number(column.get(name)) for column in columns.values())] for name in names]
    return table([["", *columns], *rows], right=True)


#: Name in a table, metric, factor.
_SURFACE = (
    ("PSNR [dB]", "test.psnr", 1.0),
    ("SSIM", "test.ssim", 1.0),
    ("depth error, median [mm]", "depth.median", 1e3),
    ("depth error, mean [mm]", "depth.mean", 1e3),
    ("accuracy [mm]", "mesh.accuracy", 1e3),
    ("completeness [mm]", "mesh.completeness", 1e3),
    ("F-score [%]", "mesh.f_score", 100.0),
    ("threshold of it [mm]", "mesh.threshold", 1e3),
    ("normals [°]", "mesh.normal_angle_deg", 1.0),
    ("faces", "mesh.faces", 1.0),
)


def surface_measures(run: RunFolder) -> dict[str, float | None]:
    """Return what a run with a surface measured, lengths in millimetres, and its time without measuring."""
    result = run.result()
    known = ((title, result.metrics.get(name), factor) for title, name, factor in _SURFACE)
    measures = {title: None if value is None else factor * value for title, value, factor in known}
    spent = sum(time.seconds for time in result.times if not time.name.startswith("measure"))
    return {**measures, "time [s]": round(spent)}


def nearby_frames(scene: Scene, name: str, reach: int = 3) -> Scene:
    """Return a scene with only the frames at most ``reach`` places from one, and its points without their tracks.

    Raises
    ------
    DataError
        For a frame that the scene has not.
    """
    at = scene.frames.index(scene.frame(name))
    points = None if scene.points is None else replace(scene.points, tracks=None)
    return scene.replace(frames=scene.frames[max(0, at - reach) : at + reach + 1], points=points)


#: Of satellites: name in a table, metric, factor.
_SATELLITE = (
    ("views", "sfm.images", 1.0),
    ("views with a camera", "sfm.registered", 1.0),
    ("residual as delivered [px]", "rpc.rms_before_px", 1.0),
    ("residual [px]", "rpc.rms_px", 1.0),
    ("training views: L1", "training.l1", 1.0),
    ("training views: PSNR [dB]", "training.psnr", 1.0),
    ("held-out views: PSNR [dB]", "test.psnr", 1.0),
    ("tie points off before [px]", "adjust.error_before_px", 1.0),
    ("tie points off [px]", "adjust.error_px", 1.0),
    ("height error before, mean [m]", "dsm_before.mae", 1.0),
    ("height error, mean [m]", "dsm.mae", 1.0),
    ("height error, median [m]", "dsm.median_absolute", 1.0),
    ("within 1 m [%]", "dsm.within_1m", 100.0),
)


def satellite_measures(run: RunFolder) -> dict[str, float | None]:
    """Return what a run on satellite pictures measured, only what it has, and its time without measuring."""
    result = run.result()
    known = {title: (result.metrics.get(name), factor) for title, name, factor in _SATELLITE}
    measures = {title: factor * value for title, (value, factor) in known.items() if value is not None}
    spent = sum(time.seconds for time in result.times if not time.name.startswith("measure"))
    return {**measures, "time [s]": round(spent)}


def simulated_predictions(
    work: Path, city: CitySample, names: Sequence[str], settings: SimulatedNoiseSettings, *, seed: int = 0
) -> Path:
    """Return a file, below ``work``, of what a network might say of a city's pictures: the truth with errors.

    Its name tells pictures and settings apart. Raises as
    :func:`toolkit.poses.feedforward.simulated_satellite.simulate_satellite_prediction`.
    """
    from toolkit.poses.feedforward.predictions_file import write_predictions
    from toolkit.poses.feedforward.simulated_satellite import simulate_satellite_prediction
    from toolkit.poses.satellite import ground_box
    from toolkit.samples.city.seen import seen_points
    from toolkit.workspace import fingerprint

    made_with = {"city": city.folder.name, "names": sorted(names), "settings": settings.to_dict(), "seed": seed}
    path = work / f"simulated-{fingerprint(made_with)[:8]}.npz"
    if not path.is_file():
        whole = city.true_scene
        scene = whole.replace(frames=tuple(frame for frame in whole.frames if frame.name in names))
        numbers = {view.name: i for i, view in enumerate(city.views)}
        box = ground_box(scene, heights=city.city.heights)
        said = simulate_satellite_prediction(
            scene, lambda frame: seen_points(city, numbers[frame.name]), box, settings, seed=seed
        )
        write_predictions(path, said)
    return path


def best_text(columns: Mapping[str, Mapping[str, float | None]], better: Mapping[str, str]) -> str:
    """Return for each measure which column is best, and which comes next: a line each.

    Parameters
    ----------
    columns:
        As :func:`measures_text` takes them.
    better:
        ``"lower"`` or ``"higher"`` by the name of the measure.
    """
    from toolkit.runs.measures import format_number

    lines = []
    for name, way in better.items():
        known = {label: value for label, column in columns.items() if (value := column.get(name)) is not None}
        ranked = sorted(known, key=lambda label: known[label], reverse=way == "higher")
        told = [f"{label} ({format_number(known[label])})" for label in ranked]
        lines.append(f"{name}: " + (", then ".join(told[:2]) if told else "not measured"))
    return "\n".join(lines)
