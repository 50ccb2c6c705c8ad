"""Photos of a flight with other tags than they came with."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from PIL import Image

from toolkit.scene.exif import PhotoTags, read_tags
from toolkit.scene.tag_writer import exif_block, xmp_packet


def retagged(flown: Path, folder: Path, changes: Mapping[str, Callable[[PhotoTags], PhotoTags]]) -> Path:
    """Copy the flight with other tags in the named pictures."""
    shutil.copytree(flown, folder)
    for name, change in changes.items():
        with Image.open(folder / name) as picture:
            tags, pixels = change(read_tags(picture)), picture.convert("RGB")
        exif, xmp = exif_block(tags, pixels.width, pixels.height), xmp_packet(tags)
        pixels.save(folder / name, quality=95, exif=exif, xmp=xmp)
    return folder
