"""Settings of depth from single pictures and of the points made from it."""

from __future__ import annotations

from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings, Text


class FitSettings(Settings):
    """How the scale and shift of a prediction are found."""

    min_pairs = Integer(12, bounds=(3, 100000), doc="Fewest points that a fit may rest on.")
    tolerance = Number(
        20.0,
        bounds=(0.01, 90.0),
        unit="%",
        doc="Relative error, of depth or of disparity, up to which a point agrees with a fit.",
    )
    min_share = Number(
        30.0, bounds=(1.0, 100.0), unit="%", doc="Smallest share of the points that must agree with a fit."
    )
    trials = Integer(500, bounds=(10, 100000), doc="Number of random fits to two points that are compared.")
    fit_metric = Boolean(
        True, doc="Also scale metric depth to the points, where there are points; without a shift."
    )


class GroundSettings(Settings):
    """Where the ground is: a horizontal plane in a georeferenced scene (z up, metres)."""

    flight_height = Number(
        0.0,
        bounds=(0.0, 10000.0),
        unit="m",
        doc="Height of the flight (median of the training cameras) above the ground; "
        "0: not known, the ground is at ground_height.",
    )
    ground_height = Number(
        0.0,
        bounds=(-12000.0, 12000.0),
        unit="m",
        doc="World z of the ground, where flight_height is 0. Photos that tell their height above the "
        "take-off have z = 0 there.",
    )
    max_distance = Number(
        1000.0, bounds=(0.1, 100000.0), unit="m", doc="Ground farther than this from the camera has no depth."
    )


class DepthSettings(Settings):
    """Where depth comes from, how it is scaled and which points are made from it."""

    provider = Choice(
        "transformers",
        choices=("transformers", "moge", "video", "arrays", "ground"),
        doc="transformers: DPT or Depth Anything; moge: MoGe; video: Video Depth Anything, on the frames of a "
        "sequence together; arrays: depth maps from files; ground: a horizontal plane under the sensor poses.",
    )
    weights = Text(
        "",
        doc="Folder of the network, or its name on the Hugging Face hub. Empty: Intel/dpt-large (transformers), "
        "Ruicheng/moge-2-vitl or Ruicheng/moge-vitl (moge), depth-anything/Video-Depth-Anything-Small (video).",
    )
    download = Boolean(False, doc="Fetch missing weights from the hub.")
    device = Choice("cpu", choices=("cpu", "cuda"), doc="Where a network computes.")
    kind = Choice(
        "auto",
        choices=("auto", "metric", "affine-depth", "affine-disparity"),
        doc="What the values mean; auto: what is known of the network, metric for arrays.",
    )
    moge_version = Choice("v2", choices=("v2", "v1"), doc="Architecture of MoGe's weights.")
    arrays = Text("", doc="Folder of the depth maps: <picture>.npy or .npz, for the provider arrays.")
    ground = Group(GroundSettings(), doc="The ground plane.")
    fit = Group(FitSettings(), doc="Fit of scale and shift.")

    max_points = Integer(200000, bounds=(4, 50000000), doc="Most points, spread evenly over the pictures.")
    stride = Integer(2, bounds=(1, 64), unit="px", doc="Only every so manieth row and column is used.")
    edge = Number(
        10.0,
        bounds=(0.0, 1000.0),
        unit="%",
        doc="Pixels whose depth and a neighbour's differ by more than this are edges and left out; 0: none is.",
    )
    far = Number(
        5.0,
        bounds=(0.0, 1000.0),
        doc="Pixels deeper than this many times the picture's median depth are left out; 0: none is.",
    )
    min_confidence = Number(
        0.0, bounds=(0.0, 1.0), doc="Pixels with less confidence are left out, where the provider gives any."
    )
    thin = Boolean(True, doc="Keep one point, the one seen from nearest, in each cube of space.")
    voxel = Number(
        0.0,
        bounds=(0.0, 1000.0),
        unit="scene units",
        doc="Edge of the cubes; 0: half the distance that neighbouring samples have at the median depth.",
    )
