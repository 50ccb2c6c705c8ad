"""What the engine is, how the borescope looks at it, and how it is filmed."""

from __future__ import annotations

from toolkit.settings import Boolean, Group, Integer, Number, Settings


class RotorSettings(Settings):
    """A ring of blades that are alike but for faint wear."""

    blades = Integer(90, bounds=(24, 400), unit="blades", doc="Blades on the ring.")
    radius = Number(
        0.225, bounds=(0.02, 5.0), unit="m", doc="Radius of the circle through the middle of the blades."
    )
    casting = Number(
        1.0,
        bounds=(0.0, 4.0),
        doc="Strength of the texture that all blades share, as they come from one mould: what makes one blade be "
        "taken for another.",
    )
    wear = Number(
        1.0,
        bounds=(0.0, 4.0),
        doc="Strength of the stains, pits and scratches that each blade has of its own: what tells blades apart.",
    )


class BorescopeSettings(Settings):
    """A fish-eye camera before the blades; its light travels with it."""

    image_width = Integer(480, bounds=(32, 4000), unit="px", doc="Width of the picture inside the border.")
    image_height = Integer(360, bounds=(24, 4000), unit="px", doc="Height of the picture inside the border.")
    focal = Number(
        0.64, bounds=(0.3, 3.0), doc="Focal length over the picture's width, before distortion (OPENCV_FISHEYE)."
    )
    distortion = Number(
        1.0, bounds=(0.0, 1.2), doc="Strength of the lens's four coefficients; 0: an equidistant fish-eye."
    )
    distance = Number(
        2.6,
        bounds=(0.5, 50.0),
        unit="pitches",
        doc="From the camera's circle to the plane of the leading edges, over the distance from blade to blade.",
    )
    outward = Number(
        1.6,
        bounds=(-50.0, 50.0),
        unit="pitches",
        doc="How much larger the camera's circle is than that through the middle of the blades.",
    )
    tilt = Number(
        15.0,
        bounds=(-60.0, 60.0),
        unit="degrees",
        doc="How far the optical axis leans from the rotor's axis in the direction of the camera's way.",
    )
    lean = Number(
        -34.0,
        bounds=(-60.0, 60.0),
        unit="degrees",
        doc="How far the optical axis leans from the rotor's axis outwards; negative: towards the hub.",
    )
    casing = Number(
        0.12,
        bounds=(0.0, 0.5),
        doc="Share of the picture's width that a casing edge covers, which does not turn; 0: none.",
    )
    icon = Boolean(True, doc="A small icon in the corner at the bottom left.")
    border = Integer(0, bounds=(0, 200), unit="px", doc="Black border around the picture, which grows by it.")


class FilmSettings(Settings):
    """Which part of the turn is filmed, and how well."""

    frames = Integer(400, bounds=(1, 20000), unit="frames", doc="Pictures that are written.")
    step = Number(0.1, bounds=(0.001, 10.0), unit="degrees", doc="Turn from one frame of the video to the next.")
    stride = Integer(1, bounds=(1, 1000), unit="frames", doc="Every how many frames of the video one is written.")
    start = Number(0.0, bounds=(-360.0, 360.0), unit="degrees", doc="Angle of the first frame: any segment.")
    rate = Number(30.0, bounds=(1.0, 240.0), unit="Hz", doc="Frames of the video a second.")
    pause_at = Integer(
        0, bounds=(0, 20000), unit="frames", doc="The picture, counted as written, at which the blades stop."
    )
    pause = Integer(0, bounds=(0, 20000), unit="frames", doc="How many pictures show the same view after that.")
    shake = Number(
        0.2,
        bounds=(0.0, 5.0),
        unit="% of the radius",
        doc="RMS of the camera's axial and of its radial slack, slow as that of a hand; as long as the blades "
        "stand still, so does the camera.",
    )
    angle_shake = Number(0.1, bounds=(0.0, 5.0), unit="degrees", doc="RMS of its turns about each of its axes.")
    noise = Number(1.0, bounds=(0.0, 50.0), unit="grey levels", doc="Standard deviation of the sensor's noise.")
    exposure = Number(
        0.5, bounds=(0.0, 1.0), doc="Share of the time between two frames in which light is collected: motion blur."
    )
    samples = Integer(2, bounds=(1, 16), doc="Rays a pixel.")


class EngineSettings(Settings):
    """A rotor seen by a borescope."""

    rotor = Group(RotorSettings())
    borescope = Group(BorescopeSettings())
    film = Group(FilmSettings())
    points = Integer(4000, bounds=(0, 1000000), doc="Number of surface points in the true scene, at most.")
    video = Boolean(False, doc="Also write the pictures as video.mp4.")
    depth = Boolean(False, doc="Also write the true depth maps.")
