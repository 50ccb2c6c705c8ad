"""What satellites saw and from where: pictures, directions on the sky, footprints, corrections of RPCs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import ArrayLike, NDArray

from toolkit.errors import DataError
from toolkit.geometry.rpc_angles import viewing_ray
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.plots.pictures import eight_bit, picture_trace
from toolkit.plots.style import GRID, NEUTRAL, colour, figure, shown
from toolkit.scene import Scene
from toolkit.scene.footprints import footprint

Array = NDArray[np.float64]

_WIDTH = 950
_SYMBOLS = ("circle", "diamond", "x", "square", "star")


def picture_row_figure(pictures: Mapping[str, NDArray[np.generic]], *, title: str = "") -> go.Figure:
    """Draw pictures (H, W, 3) side by side, each in its own size: floats of 0 to 1 or uint8.

    Raises
    ------
    DataError
        Without pictures, and for what is no picture.
    """
    if not pictures:
        raise DataError("No pictures to draw", expected="some", found="none")
    seen = {label: eight_bit(picture) for label, picture in pictures.items()}
    sizes = [picture.shape[:2] for picture in seen.values()]
    tall = max(_WIDTH / len(seen) * height / width for height, width in sizes)
    lines = max(label.count("<br>") for label in seen) + 1
    above = 12 + 18 * lines + (32 if title else 0)
    drawn = figure(title, round(min(tall, 640) + above + 12), margin={"l": 8, "r": 8, "t": above, "b": 8})
    titles = ["<br>".join(shown(line) for line in label.split("<br>")) for label in seen]
    drawn.set_subplots(1, len(seen), subplot_titles=titles, horizontal_spacing=0.012)
    drawn.update_annotations(font_size=13)
    for column, picture in enumerate(seen.values(), start=1):
        height, width = picture.shape[:2]
        drawn.add_trace(picture_trace(picture), row=1, col=column)
        drawn.update_xaxes(range=[0, width], constrain="domain", visible=False, row=1, col=column)
        drawn.update_yaxes(
            range=[height, 0],
            constrain="domain",
            constraintoward="top",
            scaleanchor=f"x{column}" if column > 1 else "x",
            visible=False,
            row=1,
            col=column,
        )
    return drawn


def sky_figure(
    directions: Mapping[str, ArrayLike],
    names: Sequence[str] = (),
    *,
    joined: bool = False,
    reach: float = 0.0,
    title: str = "",
) -> go.Figure:
    """Draw directions on the sky as seen from the ground: north up, east right, the zenith in the middle.

    Parameters
    ----------
    directions:
        By label, (n, 3) unit vectors east, north and up, away from the ground.
    names:
        Of the n directions, shown under the pointer.
    joined:
        Whether lines join the directions of one name under all labels, which then are equally many.
    reach:
        Zenith angle in degrees of the rim; 0: as far as the directions go.

    Raises
    ------
    DataError
        Without directions, for other shapes, and for different numbers where they are to be joined.
    """
    found = {label: np.asarray(values, dtype=np.float64) for label, values in directions.items()}
    counts = [len(values) for values in found.values()]
    wrong = not counts or any(values.ndim != 2 or values.shape[1:] != (3,) for values in found.values())
    if wrong or (joined and len(set(counts)) > 1):
        raise DataError(
            "Directions cannot be drawn on the sky",
            expected="(n, 3) for each label, as many each where they are joined",
            found=str([values.shape for values in found.values()]),
        )
    angles = {label: _angles(values) for label, values in found.items()}
    farthest = max(float(zenith.max(initial=0.0)) for zenith, _ in angles.values())
    rim = reach or max(10.0, 10.0 * np.ceil(farthest / 10.0))
    circles = np.arange(_step(rim), rim + 1e-9, _step(rim)).tolist()
    drawn = figure(title, 460, showlegend=True, margin={"l": 40, "r": 40, "t": 60 if title else 30, "b": 40})
    if joined:
        zeniths, azimuths = (np.stack([pair[part] for pair in angles.values()]) for part in (0, 1))
        gap = np.full((1, counts[0]), np.nan)
        drawn.add_scatterpolar(
            r=np.concatenate([zeniths, gap]).T.ravel(),
            theta=np.concatenate([azimuths, gap]).T.ravel(),
            mode="lines",
            line={"color": NEUTRAL, "width": 1},
            hoverinfo="skip",
            showlegend=False,
        )
    for position, (label, (zenith, azimuth)) in enumerate(angles.items()):
        drawn.add_scatterpolar(
            r=zenith,
            theta=azimuth,
            name=shown(label),
            mode="markers",
            marker={"color": colour(position), "size": 9, "symbol": _SYMBOLS[position % len(_SYMBOLS)]},
            text=[shown(name) for name in names] if len(names) == len(zenith) else [""] * len(zenith),
            hovertemplate="%{text}<br>%{r:.1f}° from the zenith, azimuth %{theta:.1f}°<extra></extra>",
        )
    drawn.update_layout(
        legend={"orientation": "v", "x": 1.0, "xanchor": "left", "y": 1.0},
        polar={
            "bgcolor": "rgba(0,0,0,0)",
            "angularaxis": {
                "direction": "clockwise",
                "rotation": 90,
                "tickvals": [0, 45, 90, 135, 180, 225, 270, 315],
                "ticktext": ["N", "NE", "E", "SE", "S", "SW", "W", "NW"],
                "gridcolor": GRID,
                "linecolor": GRID,
            },
            "radialaxis": {
                "range": [0, rim],
                "tickvals": circles,
                "ticktext": [f"{angle:g}°" for angle in circles],
                "angle": 67.5,
                "tickangle": 67.5,
                "tickfont": {"size": 11, "color": NEUTRAL},
                "gridcolor": GRID,
                "showline": False,
                "ticks": "",
                "layer": "below traces",
            },
        },
    )
    return drawn


def footprints_figure(footprints: Mapping[str, Mapping[str, ArrayLike]], *, title: str = "") -> go.Figure:
    """Draw the outlines of pictures on the ground, seen from above in equal scale.

    Parameters
    ----------
    footprints:
        By label (one colour each, for example a height), by picture, corners (n, 2 or 3) in metres east and north.

    Raises
    ------
    DataError
        Without footprints.
    """
    if not any(footprints.values()):
        raise DataError("No footprints to draw", expected="some", found=f"{len(footprints)} empty lists")
    drawn = figure(title, 520, showlegend=True, xaxis_title="east in m", yaxis_title="north in m")
    for position, (label, outlines) in enumerate(footprints.items()):
        for number, (name, corners) in enumerate(outlines.items()):
            ring = np.asarray(corners, dtype=np.float64)[:, :2]
            ring = np.concatenate([ring, ring[:1]])
            drawn.add_scatter(
                x=ring[:, 0],
                y=ring[:, 1],
                name=shown(label),
                legendgroup=label,
                showlegend=number == 0,
                mode="lines",
                line={"color": colour(position), "width": 1.2},
                text=[shown(name)] * len(ring),
                hovertemplate="%{text}<extra></extra>",
            )
    drawn.update_layout(legend={"orientation": "v", "x": 1.02, "xanchor": "left", "y": 1.0})
    drawn.update_yaxes(scaleanchor="x", constrain="domain")
    drawn.update_xaxes(constrain="domain")
    return drawn


def corrections_figure(
    found: ArrayLike, true: ArrayLike, names: Sequence[str] = (), *, title: str = ""
) -> go.Figure:
    """Draw the shift of each picture in pixels as it was found and as it is, joined by lines, in equal scale.

    Parameters
    ----------
    found, true:
        (n, 2) right and down.
    names:
        Of the n pictures, shown under the pointer.

    Raises
    ------
    DataError
        For arrays of other or different shapes.
    """
    here, there = np.asarray(found, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if here.shape != there.shape or here.ndim != 2 or here.shape[1] != 2 or not len(here):
        raise DataError(
            "Corrections cannot be compared", expected="(n, 2) twice", found=f"{here.shape} and {there.shape}"
        )
    drawn = figure(title, 460, showlegend=True, xaxis_title="right in px", yaxis_title="down in px")
    lines = np.stack([here, there, np.full_like(here, np.nan)], axis=1).reshape(-1, 2)
    drawn.add_scatter(
        x=lines[:, 0],
        y=lines[:, 1],
        mode="lines",
        line={"color": NEUTRAL, "width": 1},
        hoverinfo="skip",
        showlegend=False,
    )
    looks = {
        "true": (there, {"color": colour(0), "size": 14, "symbol": "circle-open", "line": {"width": 2}}),
        "found": (here, {"color": colour(1), "size": 7}),
    }
    for label, (places, marker) in looks.items():
        drawn.add_scatter(
            x=places[:, 0],
            y=places[:, 1],
            name=label,
            mode="markers",
            marker=marker,
            text=[shown(name) for name in names] if len(names) == len(places) else [""] * len(places),
            hovertemplate="%{text} %{x:.2f}, %{y:.2f} px<extra></extra>",
        )
    # Down is down, as in the pictures.
    drawn.update_yaxes(autorange="reversed", scaleanchor="x", constrain="domain")
    drawn.update_xaxes(constrain="domain")
    return drawn


def _step(rim: float) -> float:
    return 10.0 if rim <= 40 else 20.0 if rim <= 60 else 30.0


def _angles(directions: Array) -> tuple[Array, Array]:
    """Return zenith angles (n,) and azimuths (n,), clockwise from north, in degrees."""
    east, north, up = directions.T
    return np.degrees(np.arctan2(np.hypot(east, north), up)), np.degrees(np.arctan2(east, north)) % 360


def satellite_maps(scene: Scene) -> tuple[go.Figure, go.Figure] | None:
    """Return where satellites stood in the sky, and the outlines of their pictures on the ground.

    None for a scene in which not every frame has an RPC camera.
    """
    views = {
        frame.name: camera for frame in scene.frames if isinstance(camera := scene.camera_of(frame), RpcCamera)
    }
    if not views or len(views) < len(scene):
        return None
    towards = np.array([viewing_ray(camera.rpc).direction for camera in views.values()])
    sky = sky_figure({"satellites": towards}, list(views), title="Directions to the satellites")
    altitude = next(iter(views.values())).origin[2]
    outlines = {name: footprint(camera, altitude) for name, camera in views.items()}
    label = f"{altitude:.0f} m above the ellipsoid"
    return sky, footprints_figure({label: outlines}, title="Outlines on the ground, by the RPCs as delivered")
