"""Which of a capture's photos make a map, and which are asked for in it."""

from __future__ import annotations

import dataclasses
from typing import Literal

from toolkit.recipes.base import RecipeInput
from toolkit.scene.split_file import SPLIT_FILE, with_split_file
from toolkit.workspace import fingerprint

SplitChoice = Literal["file", "capture"]


def with_map_split(data: RecipeInput, choice: SplitChoice) -> RecipeInput:
    """Return the data with the split of ``split.csv`` beside their ``images/``, where that is wanted and there.

    Raises
    ------
    DataError
        Where the file is damaged or does not name all pictures.
    """
    path = data.scene.image_dir.parent / SPLIT_FILE
    if choice == "capture" or not path.is_file():
        return data
    scene = with_split_file(data.scene, path)
    reference = data.reference if data.reference is None else with_split_file(data.reference, path)
    roles = [(frame.name, frame.split) for frame in scene.frames]
    return dataclasses.replace(
        data, scene=scene, reference=reference, fingerprint=fingerprint({"data": data.fingerprint, "split": roles})
    )
