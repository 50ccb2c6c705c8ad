"""Measures of a camera's way around an axis, in the form in which recipes report them."""

from __future__ import annotations

from typing import Any

from toolkit.errors import StageError
from toolkit.metrics.circle import circle_errors, fit_circle
from toolkit.recipes.measure import measure_poses
from toolkit.scene import Scene


def circle_metrics(scene: Scene, reference: Scene | None) -> tuple[dict[str, float | None], dict[str, Any]]:
    """Return ``circle.*``, the measures of a camera's way around an axis, and ``poses.*`` where truth is known.

    Parameters
    ----------
    scene:
        With the poses that were found.
    reference:
        With true poses, or None.
    """
    metrics, report = measure_poses(scene, reference)
    reports: dict[str, Any] = {"poses": report}
    try:
        fit = fit_circle(scene.centres())
    except StageError as error:
        return metrics, {**reports, "circle_fit": {"reason": str(error)}}
    metrics |= {
        "circle.arc_deg": fit.arc_degrees,
        "circle.radius_spread": fit.radius_spread,
        "circle.out_of_plane": fit.out_of_plane_rms,
    }
    reports["circle_fit"] = fit.to_dict()
    if reference is not None and reference.registered:
        errors = circle_errors(scene, reference)
        found = errors.to_dict()
        metrics |= {
            "circle.arc_error_deg": errors.arc_deg,
            "circle.position_error": found["position_rms"],
            "circle.rotation_error_deg": found["rotation_deg_rms"],
            "circle.angle_error_deg": found["angle_deg_rms"],
        }
        reports["circle_errors"] = found
    return metrics, reports
