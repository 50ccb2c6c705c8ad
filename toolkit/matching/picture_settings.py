"""Settings of how two pictures are matched that are in no database: a photo and a render."""

from __future__ import annotations

from toolkit.matching.learned_settings import AlikedSettings
from toolkit.settings import Boolean, Choice, Integer, Number, Settings, Text

#: The methods by name, as runs and tables call them.
METHODS = ("sift", "aliked-lightglue", "disk-lightglue", "superpoint-lightglue")
#: SuperPoint and LightGlue in one model of the hub.
SUPERPOINT_WEIGHTS = "ETH-CVG/lightglue_superpoint"


class PictureMatchSettings(Settings):
    """Features of two pictures and their matches."""

    method = Choice(
        "sift",
        choices=METHODS,
        doc="SIFT with nearest neighbours; ALIKED or DISK with LightGlue (make features installs them); SuperPoint "
        "with LightGlue, whose weights must be given.",
    )
    max_features = Integer(4096, bounds=(16, 20000), unit="features", doc="Most keypoints kept per picture.")
    max_image_side = Integer(
        1024, bounds=(64, 8192), unit="px", doc="Larger pictures are shrunk to this longer side before."
    )
    peak_threshold = Number(
        0.003,
        bounds=(0.0, 0.1),
        doc="sift: least contrast of a feature, of a grey value range of 1; renders are softer than photos.",
    )
    upsample = Boolean(True, doc="sift: double pictures before: more and finer features for three times the time.")
    max_ratio = Number(
        0.95,
        bounds=(0.1, 1.0),
        doc="sift: a match must be nearer than the second best by this factor; a start pose that is nearly right "
        "leaves few wrong ones.",
    )
    aliked_model = Choice(
        AlikedSettings().model,
        choices=("aliked-n16", "aliked-n16rot", "aliked-n32", "aliked-t16"),
        doc="aliked-lightglue: which network.",
    )
    min_confidence = Number(
        0.1, bounds=(0.0, 1.0), doc="LightGlue: matches of which the network is less sure are left out."
    )
    weights = Text(
        SUPERPOINT_WEIGHTS,
        doc="superpoint-lightglue: folder of a model of transformers with both networks, or its name on the hub.",
    )
    download = Boolean(False, doc="superpoint-lightglue: fetch what is missing from the hub.")
