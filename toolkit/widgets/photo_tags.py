"""What one photo's tags say, as a table."""

from __future__ import annotations

from datetime import UTC, datetime

from toolkit.runs.markup import Html, table
from toolkit.scene import Frame
from toolkit.scene.survey import PhotoFacts

_TURNED = {1: "upright", 2: "mirrored", 3: "turned by 180°", 6: "to be turned clockwise", 8: "to be turned back"}


def tags_table(fact: PhotoFacts, frame: Frame) -> Html:
    """Return what is known of a photo, line by line; what is not known has no line."""
    tags = fact.tags
    rows = [("Size", f"{fact.width} × {fact.height} px"), ("Split", frame.split)]
    if tags.camera:
        rows.append(("Camera", tags.camera))
    focal = [f"{fact.focal_mm:.4g} mm"] if fact.focal_mm is not None else []
    focal += [f"{tags.focal:.0f} px"] if tags.focal is not None else []
    if focal:
        rows.append(("Focal length", ", ".join(focal)))
    if tags.time is not None:
        rows.append(("Taken", f"{datetime.fromtimestamp(tags.time, UTC):%Y-%m-%d %H:%M:%S}"))
    if frame.time is not None:
        rows.append(("Since the start", f"{frame.time:.2f} s"))
    if tags.position is not None:
        latitude, longitude, altitude = tags.position
        rows.append(("GPS", f"{latitude:.7f}°, {longitude:.7f}°, {altitude:.2f} m"))
    if tags.position_sigma is not None:
        east, north, up = tags.position_sigma
        rows.append(("Accuracy", f"{east:.2f} m east, {north:.2f} m north, {up:.2f} m in height"))
    if tags.relative_altitude is not None:
        rows.append(("Above take-off", f"{tags.relative_altitude:.1f} m"))
    for title, attitude in (("Gimbal", tags.gimbal), ("Drone", tags.flight)):
        if attitude is not None:
            text = f"yaw {attitude.yaw:.1f}°, pitch {attitude.pitch:.1f}°, roll {attitude.roll:.1f}°"
            rows.append((title, text))
    if tags.orientation is not None:
        rows.append(("Orientation", _TURNED.get(tags.orientation, f"tag {tags.orientation}")))
    rows += [("Doubt", doubt) for doubt in tags.doubts]
    return table([], rows, class_="text")
