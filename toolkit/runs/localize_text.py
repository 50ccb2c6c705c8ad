"""Localised photos as text for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from toolkit.runs.localize_photo import LocalizedPhoto
from toolkit.runs.text import printable, table


def localized_text(done: Sequence[LocalizedPhoto], *, metric: bool) -> str:
    """Return a table of what was found, a line a photo, the reasons why not below it.

    Parameters
    ----------
    metric:
        Whether positions are metres; else they are in scene units.
    """
    unit = "m" if metric else "units"
    head = ["photo", f"position [{unit}]", f"sigma [{unit}]", "sigma [deg]", "inliers", "rounds", "seconds"]
    with_error = any(one.errors is not None for one in done)
    rows = [[*head, f"off [{unit}]", "off [deg]"] if with_error else head]
    for one in done:
        found, pose = one.found, one.found.cam_from_world
        row = [
            found.name,
            "not found" if pose is None else ", ".join(f"{value:.2f}" for value in pose.centre),
            "–" if found.position_sigma is None else f"{found.position_sigma.max():.2g}",
            "–" if found.rotation_sigma_deg is None else f"{found.rotation_sigma_deg.max():.2g}",
            f"{found.inliers}/{found.matches}",
            str(found.rounds),
            f"{one.seconds:.1f}",
        ]
        off = one.errors
        rows.append(
            [*row, *(["–", "–"] if off is None else [f"{value:.3g}" for value in off])] if with_error else row
        )
    reasons = [printable(f"{one.found.name}: {one.found.reason}") for one in done if not one.found]
    count = sum(map(bool, (one.found for one in done)))
    return "\n".join([table(rows, right=True), *reasons, f"{count} of {len(done)} found, by {done[0].method}"])
