"""Settings of the depth loss. Importing this loads no numerical library."""

from __future__ import annotations

from toolkit.settings import Choice, Number, Settings


class DepthLossSettings(Settings):
    """How much drawn depth is held to depth that a monocular network predicts, whatever its scale and shift."""

    weight = Number(
        0.0,
        bounds=(0.0, 1e3),
        doc="Weight at the first step of the difference, in standard deviations of the prediction (after Kerbl et "
        "al. 2024); try 0.03; 0: none.",
    )
    final_weight = Number(
        0.01, bounds=(0.0, 1e3), doc="... at the last; exponential in between; 0: the same throughout."
    )
    kind = Choice(
        "scale-shift",
        choices=("scale-shift", "pearson", "absolute"),
        doc="scale-shift: mean difference after a least squares fit of scale and shift in each photo; pearson: one "
        "minus the correlation; absolute: mean difference as it is, for depth in the scene's own unit.",
    )
