"""A map on which a drone's sensors get better and worse: sliders for their errors, the true flight beneath."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import plotly.graph_objects as go

from toolkit.errors import StageError
from toolkit.metrics.trajectory import TrajectoryErrors, trajectory_errors
from toolkit.optional import require
from toolkit.plots.scene_map import scene_map
from toolkit.samples.sensors import SensorSettings, prior_of, read_sensors
from toolkit.scene import Scene

_PLOTLY = "application/vnd.plotly.v1+json"
_INTERVAL = 0.5  # seconds between readings; no error depends on it
_MARGIN = 0.2  # of the flight's extent, around it on the map: the map stands still while sliders move


@dataclasses.dataclass(frozen=True, slots=True)
class SensorNoise:
    """How wrong the sensors of a drone are.

    Attributes
    ----------
    gps_sigma:
        Standard deviation of the position on each axis in metres.
    heading_bias:
        Constant turn of all readings about the vertical in degrees, as of a compass beside a motor.
    gimbal_sigma:
        Standard deviation of the attitude about each axis in degrees.
    """

    gps_sigma: float = 1.5
    heading_bias: float = 3.0
    gimbal_sigma: float = 1.0

    def settings(self) -> SensorSettings:
        """Return the same as settings of the simulated sensors."""
        sigma, angle = max(self.gps_sigma, 0.001), max(self.gimbal_sigma, 0.001)
        positions = {f"position_sigma_{axis}": sigma for axis in ("east", "north", "up")}
        angles = {f"{angle_of}_sigma": angle for angle_of in ("yaw", "pitch", "roll")}
        return SensorSettings().replace({**positions, **angles, "yaw_bias": self.heading_bias})


def sensed_scene(truth: Scene, noise: SensorNoise, *, seed: int = 0) -> Scene:
    """Return the scene with poses as sensors with these errors would tell them.

    The same seed draws the same numbers for any noise, so that errors grow and shrink with it.

    Raises
    ------
    StageError
        Where fewer than three frames have a pose, or the world has no vertical (no georeference).
    """
    if truth.georeference is None or len(truth.registered) < 3:
        raise StageError(
            "Sensors cannot be simulated on this flight",
            expected="at least 3 frames with poses in metres east, north and up",
            found=f"{len(truth.registered)} frames with poses, "
            + ("no georeference" if truth.georeference is None else "a georeference"),
            todo="Give the reference, or poses from sensors",
        )
    poses = [frame.cam_from_world for frame in truth.registered if frame.cam_from_world is not None]
    readings = read_sensors(poses, noise.settings(), np.random.default_rng(seed), interval=_INTERVAL)
    frames = []
    for frame, reading in zip(truth.registered, readings, strict=True):
        prior = prior_of(reading)
        assert prior.position is not None  # a reading has both
        assert prior.rotation is not None
        pose = type(poses[0])(prior.rotation, -prior.rotation @ prior.position)
        frames.append(dataclasses.replace(frame, cam_from_world=pose, prior=prior))
    return truth.replace(frames=tuple(frames), points=None)


def expected_errors(noise: SensorNoise, frames: int) -> tuple[float, float]:
    """Return POS in metres, after Sim(3) alignment, and ROT in degrees that are to be expected on average.

    The length of a vector of three independent normal errors of standard deviation s is ``2 sqrt(2 / pi) s`` on
    average (Maxwell's distribution). The alignment takes seven of the 3 n numbers. With a constant b on one axis
    the mean length is ``s (sqrt(2 / pi) exp(-a^2 / 2) + (a + 1 / a) erf(a / sqrt(2)))``, where ``a = b / s``.
    """
    maxwell = 2 * math.sqrt(2 / math.pi)
    left = max(0.0, 1 - 7 / (3 * frames))
    pos = maxwell * noise.gps_sigma * math.sqrt(left)
    bias, sigma = abs(noise.heading_bias), noise.gimbal_sigma
    if bias == 0 or sigma == 0:
        return pos, bias + maxwell * sigma
    a = bias / sigma
    first = math.sqrt(2 / math.pi) * math.exp(-a * a / 2)
    return pos, sigma * (first + (a + 1 / a) * math.erf(a / math.sqrt(2)))


def noise_map(truth: Scene, noise: SensorNoise, *, seed: int = 0) -> go.Figure:
    """Draw the true flight in grey and what sensors say of it, with the measured and the expected errors.

    Raises as :func:`sensed_scene`.
    """
    sensed = sensed_scene(truth, noise, seed=seed)
    errors = trajectory_errors(sensed, truth, "sim3")
    drawn = scene_map(sensed, reference=truth, points=False, top_view=True)
    centres = truth.centres()[:, :2]
    margin = _MARGIN * float(np.ptp(centres, axis=0).max())
    for axis, (low, high) in zip("xy", zip(centres.min(axis=0), centres.max(axis=0), strict=True), strict=True):
        drawn.update_layout({f"{axis}axis_range": [low - margin, high + margin]})
    return drawn.update_layout(title_text=_title(errors, expected_errors(noise, len(errors.names))), margin_t=64)


def _title(errors: TrajectoryErrors, expected: tuple[float, float]) -> str:
    pos, rot = expected
    return (
        f"POS {errors.pos:.2f} m · ROT {errors.rot:.2f}° · ATE {errors.ate:.2f} m, after Sim(3)"
        f"<br><sup>expected: POS {pos:.2f} m · ROT {rot:.2f}°</sup>"
    )


class SensorNoiseView:
    """Sliders above a map; where no kernel answers, the map as it was drawn last.

    Attributes
    ----------
    noise:
        What the sliders say.
    """

    def __init__(self, truth: Scene, noise: SensorNoise, *, seed: int = 0) -> None:
        widgets = require("ipywidgets")
        require("anywidget")  # Plotly's own message for it does not say how to get it
        self._truth, self._seed = truth, seed
        self._map = go.FigureWidget(noise_map(truth, noise, seed=seed))
        wide = {"style": {"description_width": "170px"}, "layout": {"width": "520px"}}
        slider = widgets.FloatSlider
        self._sliders = {
            "gps_sigma": slider(noise.gps_sigma, description="GPS sigma [m]", min=0, max=10, step=0.1, **wide),
            "heading_bias": slider(
                noise.heading_bias, description="heading bias [°]", min=-20, max=20, step=0.5, **wide
            ),
            "gimbal_sigma": slider(
                noise.gimbal_sigma, description="gimbal sigma [°]", min=0, max=10, step=0.1, **wide
            ),
        }
        for each in self._sliders.values():
            each.observe(self._moved, "value")
        self._box = widgets.VBox([*self._sliders.values(), self._map])

    @property
    def noise(self) -> SensorNoise:
        """What the sliders say."""
        return SensorNoise(**{name: float(slider.value) for name, slider in self._sliders.items()})

    @property
    def figure(self) -> go.Figure:
        """The map as it is now."""
        return go.Figure(self._map)

    def move(self, **values: float) -> None:
        """Move sliders, by the names of :class:`SensorNoise`'s attributes."""
        for name, value in values.items():
            self._sliders[name].value = value

    def _moved(self, change: Any) -> None:
        drawn = noise_map(self._truth, self.noise, seed=self._seed)
        with self._map.batch_update():
            for old, new in zip(self._map.data, drawn.data, strict=True):
                old.update(x=new.x, y=new.y, marker=new.marker)
            self._map.layout.title = drawn.layout.title

    def _repr_mimebundle_(self, **options: Any) -> dict[str, Any]:
        shown: dict[str, Any] = self._box._repr_mimebundle_(**options) or {}
        return {**shown, _PLOTLY: self.figure.to_plotly_json()}


def sensor_noise_view(truth: Scene, noise: SensorNoise | None = None, *, seed: int = 0) -> SensorNoiseView:
    """Return a map with sliders for GPS noise, heading bias and gimbal noise, to be shown in a notebook.

    Parameters
    ----------
    truth:
        Poses in metres east, north and up that sensors measure.
    noise:
        Where the sliders stand at first.
    seed:
        Of the errors.

    Raises
    ------
    StageError
        As :func:`sensed_scene`.
    MissingDependencyError
        Where ipywidgets or anywidget is not installed.
    """
    return SensorNoiseView(truth, noise or SensorNoise(), seed=seed)
