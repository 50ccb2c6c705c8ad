"""Settings of learned features and of the network that matches them."""

from __future__ import annotations

from typing import ClassVar

from toolkit.matching.features import camera_model_choice
from toolkit.matching.match import VerificationSettings
from toolkit.settings import Choice, Integer, Number, Settings


class LearnedFeatureSettings(Settings):
    """What the settings of all learned features have; take those of one kind, below."""

    #: Which network, as LightGlue's weights are named.
    kind: ClassVar[str] = ""

    max_features = Integer(
        2048,
        bounds=(16, 20000),
        unit="features",
        doc="Most keypoints kept per picture, those with the highest scores outside of masks.",
    )
    max_image_side = Integer(
        1024, bounds=(64, 8192), unit="px", doc="Larger pictures are shrunk to this longer side before."
    )
    camera_model = camera_model_choice()


class DiskSettings(LearnedFeatureSettings):
    """DISK features (Tyszkiewicz et al. 2020), which the blade paper uses."""

    kind: ClassVar[str] = "disk"

    detection_threshold = Number(
        0.0,
        bounds=(0.0, 1000.0),
        doc="Least score of a keypoint; it has no upper end, good corners have 50 and more.",
    )


class AlikedSettings(LearnedFeatureSettings):
    """ALIKED features (Zhao et al. 2023), which are found faster than DISK's and between pixels."""

    kind: ClassVar[str] = "aliked"

    model = Choice(
        "aliked-n16",
        choices=("aliked-n16", "aliked-n16rot", "aliked-n32", "aliked-t16"),
        doc="Which network: n16rot was trained with turned pictures, n32 has larger descriptors' support, t16 is "
        "small. LightGlue was trained on n16.",
    )
    detection_threshold = Number(
        0.01, bounds=(0.0, 1.0), doc="Least score of a keypoint, from 0 to 1; 0.01 finds as many as are asked for."
    )


class LightGlueSettings(VerificationSettings):
    """Matching by LightGlue (Lindenberger et al. 2023) and geometric verification."""

    min_confidence = Number(0.1, bounds=(0.0, 1.0), doc="Matches of which the network is less sure are left out.")
    depth_confidence = Number(
        0.95,
        bounds=(0.0, 1.0),
        doc="The network stops at the layer where it is this sure of its matches; 0: after the last layer.",
    )
    width_confidence = Number(
        0.99,
        bounds=(0.0, 1.0),
        doc="Keypoints that it is this sure have no partner are left out of later layers; 0: none.",
    )
