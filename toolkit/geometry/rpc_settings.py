"""Settings of the refinement of RPCs."""

from __future__ import annotations

from toolkit.settings import Choice, Integer, Number, Settings


class RpcRefinementSettings(Settings):
    """How corrections in the image are estimated from tie points."""

    model = Choice(
        "bias", choices=("bias", "affine"), doc="Correct each picture by a shift, or by a shift and a linear map."
    )
    sigma_px = Number(
        0.5, bounds=(0.01, 20.0), unit="px", doc="Standard deviation of a tie point's image coordinates."
    )
    bias_sigma_px = Number(
        10.0,
        bounds=(0.01, 1000.0),
        unit="px",
        doc="Standard deviation of the pictures' shifts about zero: fixes what tie points leave open.",
    )
    affine_sigma_px = Number(
        1.0,
        bounds=(0.001, 1000.0),
        unit="px",
        doc="Standard deviation of the linear corrections about zero, at the end of the picture's longer side.",
    )
    inlier_px = Number(
        2.0, bounds=(0.1, 100.0), unit="px", doc="Observations with larger residuals do not count as inliers."
    )
    min_inliers = Integer(
        8, bounds=(2, 100000), unit="observations", doc="Fewest inliers in each picture for it to count as refined."
    )
    max_point_sigma = Number(
        100.0,
        bounds=(0.01, 1e6),
        unit="m",
        doc="Tie points whose rays determine their place worse than this take no part.",
    )
    max_iterations = Integer(100, bounds=(1, 10000), doc="Most steps of the robust least squares.")
