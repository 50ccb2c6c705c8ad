"""What a drone writes about itself into a photo's XMP packet: gimbal, flight attitude, heights, RTK accuracy.

The names are those of DJI's namespace ``drone-dji``, which several other makers use too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from toolkit.geometry.attitude import Attitude

NAMESPACE = "http://www.dji.com/drone-dji/1.0/"
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_LARGEST = 1 << 20
_HIGHEST = 50_000.0
# Least accurate standard deviation that is believed, in metres.
_WORST = 1000.0


@dataclass(frozen=True, slots=True)
class DroneTags:
    """What the packet says; None where it says nothing.

    Attributes
    ----------
    gimbal, flight:
        Attitude of the camera and of the drone.
    relative_altitude:
        Metres above the place of take-off.
    above_ellipsoid:
        Whether the photo's altitude is one above the ellipsoid (RTK), or above the sea.
    position_sigma:
        Standard deviation east, north and up in metres.
    doubts:
        Why values that are there were not used.
    """

    gimbal: Attitude | None = None
    flight: Attitude | None = None
    relative_altitude: float | None = None
    above_ellipsoid: bool | None = None
    position_sigma: tuple[float, float, float] | None = None
    doubts: tuple[str, ...] = ()


def read_drone_tags(packet: bytes | str | None) -> DroneTags:
    """Read an XMP packet. Damaged or impossible values are left out and named in ``doubts``; nothing is raised."""
    if not packet:
        return DroneTags()
    data = packet.encode("utf-8", "replace") if isinstance(packet, str) else packet
    if len(data) > _LARGEST:
        return DroneTags(doubts=("its XMP packet is longer than a mebibyte and was left out",))
    try:
        values = _values(fromstring(data.strip(b"\0 \r\n\t"), forbid_dtd=True))
    except (ParseError, DefusedXmlException, ValueError, LookupError):
        return DroneTags(doubts=("its XMP packet is damaged",))
    return _tags(values)


def _values(root: Element) -> dict[str, str]:
    """Return text by name of everything in the namespace, whether written as attributes or as elements."""
    found: dict[str, str] = {}
    for description in root.iter(f"{{{_RDF}}}Description"):
        texts = [*description.attrib.items(), *((child.tag, child.text or "") for child in description)]
        found |= {name.removeprefix(f"{{{NAMESPACE}}}"): text for name, text in texts if NAMESPACE in str(name)}
    return found


def _tags(values: Mapping[str, str]) -> DroneTags:
    doubts: list[str] = []

    def number(name: str, largest: float) -> float | None:
        text = values.get(name, "").strip()
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            doubts.append(f"{name} is no number")
            return None
        if not math.isfinite(value) or abs(value) > largest:
            doubts.append(f"{name} is {value:g}, which cannot be")
            return None
        return value

    def attitude(kind: str) -> Attitude | None:
        angles = [number(f"{kind}{axis}Degree", 360.0) for axis in ("Yaw", "Pitch", "Roll")]
        if angles[0] is None or angles[1] is None:
            return None
        return Attitude(angles[0], angles[1], angles[2] or 0.0)

    tags = DroneTags(attitude("Gimbal"), attitude("Flight"), number("RelativeAltitude", _HIGHEST))
    kind = values.get("AltitudeType", "").strip().lower()
    if kind:
        tags = replace(tags, above_ellipsoid=kind == "rtkalt")
    sigma = [number(f"RtkStd{axis}", _WORST) for axis in ("Lon", "Lat", "Hgt")]
    east, north, up = sigma
    if east is not None and north is not None and up is not None:
        if min(east, north, up) > 0:
            tags = replace(tags, position_sigma=(east, north, up))
        elif max(east, north, up) > 0 or min(east, north, up) < 0:  # all zero: written without RTK
            doubts.append("an RTK accuracy is not above 0")
    return replace(tags, doubts=tuple(doubts))
