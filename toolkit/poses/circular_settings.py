"""What may be chosen in the adjustment of cameras on one circle."""

from __future__ import annotations

from toolkit.settings import Boolean, Choice, Integer, Number, Settings


class CircularSettings(Settings):
    """Bundle adjustment of cameras that circle one axis."""

    mode = Choice(
        "soft",
        choices=("soft", "hard"),
        doc="Soft: cameras may leave the circle by the slacks below, as a shaking borescope does; hard: one angle "
        "a frame and nothing else.",
    )
    weight = Number(
        1.0, bounds=(1e-4, 1e4), doc="Soft: by how much the circle weighs more than the slacks alone would say."
    )
    axial_slack = Number(
        0.2, bounds=(1e-4, 20.0), unit="% of radius", doc="Soft: standard deviation of a camera along the axis."
    )
    radial_slack = Number(
        0.2, bounds=(1e-4, 20.0), unit="% of radius", doc="Soft: standard deviation of a camera's radius."
    )
    orientation_slack = Number(
        0.2,
        bounds=(1e-4, 20.0),
        unit="degrees",
        doc="Soft: standard deviation of a camera's orientation about each of its axes.",
    )
    smoothness = Number(
        0.0,
        bounds=(0.0, 90.0),
        unit="degrees",
        doc="Standard deviation of the change of the step from one frame to the next; 0: steps are free.",
    )
    full_turn = Boolean(False, doc="The footage is known to go around once, from turn_first to turn_last.")
    turn_first = Integer(0, bounds=(0, None), unit="frame", doc="Where the known turn begins.")
    turn_last = Integer(
        -1,
        bounds=(-1, None),
        unit="frame",
        doc="Where the known turn ends; -1: one step after the last frame, for which a mean of the first and the "
        "last step stands.",
    )
    turn_angle = Number(
        360.0, bounds=(1.0, 36000.0), unit="degrees", doc="Angle of the known turn; others than 360 for known arcs."
    )
    turn_sigma = Number(
        0.05, bounds=(1e-4, 30.0), unit="degrees", doc="Standard deviation of the known turn's angle."
    )
    refine_focal = Boolean(True, doc="Find focal lengths; no: keep those of the scene's cameras.")
    refine_distortion = Boolean(True, doc="Find the distortion; no: keep that of the scene's cameras.")
    refine_principal_point = Boolean(True, doc="Find principal points; no: keep those of the scene's cameras.")
    principal_point_sigma = Number(
        2.0,
        bounds=(0.01, 100.0),
        unit="% of longer side",
        doc="Standard deviation of the scene's principal points: through a long lens one that is off is hardly "
        "told from a camera that is turned.",
    )
    max_scale = Number(
        1.5,
        bounds=(0.0, 1000.0),
        unit="px",
        doc="Features of a larger scale are left out, where the recipe knows scales: what is large follows the "
        "light that travels with the camera, and turns the camera on its mount by degrees; 0: all.",
    )
    min_track = Integer(
        8,
        bounds=(2, None),
        unit="frames",
        doc="Points that fewer frames see are left out, as long as enough are left for each frame: what slides "
        "along the surface has short tracks, and turns the camera on its mount; 2: all.",
    )
    max_error = Number(
        4.0, bounds=(0.1, 100.0), unit="px", doc="Observations with a larger error at the end are removed."
    )
    min_angle = Number(
        1.0, bounds=(0.0, 45.0), unit="degrees", doc="Points whose rays meet under a smaller angle are left out."
    )
    max_points = Integer(
        0,
        bounds=(0, None),
        unit="points",
        doc="Most points that take part, those with the longest tracks evenly over the frames; 0: all.",
    )
    max_steps = Integer(
        80,
        bounds=(1, 1000),
        unit="steps",
        doc="Most steps of the solver in its last round; others have 12 at most.",
    )
    tolerance = Number(
        1e-6, bounds=(0.0, 0.01), doc="A round ends when a step lowers the cost by less than this part of it."
    )
