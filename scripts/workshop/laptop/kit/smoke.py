"""Does the toolkit work on this laptop? A tiny splat is trained on a tiny sample, and versions are printed.

It is run by the Python of the virtual environment and may use what is installed there.
"""

from __future__ import annotations

import sys
import tempfile
import time
from importlib import import_module, metadata
from pathlib import Path

#: What the notebooks and the dashboard import, by module, with the name of its package.
MODULES = {
    "torch": "torch",
    "torchvision": "torchvision",
    "numba": "numba",
    "pycolmap": "pycolmap",
    "open3d": "",
    "rasterio": "rasterio",
    "pyproj": "pyproj",
    "av": "av",
    "panel": "panel",
    "jupyterlab": "jupyterlab",
    "ipywidgets": "ipywidgets",
}
TOWN = {
    "town.trees": 20,
    "flight.frames": 10,
    "flight.arc": 120.0,
    "flight.image_width": 200,
    "flight.image_height": 150,
}
CHANGES = {"train.steps": 60, "train.max_side": 160, "sift.max_features": 1024}
#: Of a flat grey picture of the town; less means that nothing was learnt.
LEAST_PSNR = 10.0


def main() -> int:
    """Check and return the exit code: 0 where all is well."""
    began = time.perf_counter()
    print(f"Python {sys.version.split()[0]} at {sys.executable}")
    broken = show_versions()
    if broken:
        print("These cannot be loaded; start install.py --again, or ask for help:\n" + "\n".join(broken))
        return 1
    print("Training a tiny splat on a tiny flight; the first time kernels are compiled, which takes a minute ...")
    psnr = train()
    well = psnr > LEAST_PSNR
    print(f"Its test photo is matched to {psnr:.1f} dB.")
    print(
        f"{'All is well' if well else 'It has learnt nothing: ask for help'}: {time.perf_counter() - began:.0f} s."
    )
    return 0 if well else 1


def show_versions() -> list[str]:
    """Print what is loaded in which version; return what cannot be loaded, a line each."""
    broken = []
    for module, package in MODULES.items():
        try:
            import_module(module)
            version = metadata.version(package) if package else ""
        except (ImportError, OSError) as error:  # OSError: a library that it links against
            broken.append(f"  {module}: {error}")
            continue
        print(f"  {module} {version}".rstrip())
    return broken


def train() -> float:
    """Return the PSNR in dB on the test photos of a splat that was trained for a moment."""
    from toolkit.runs.recipe_run import recipe_run
    from toolkit.samples.make import SampleSettings, make_sample

    # On Windows a library may still hold a file open when the folder goes.
    with tempfile.TemporaryDirectory(prefix="workshop-", ignore_cleanup_errors=True) as place:
        folder = Path(place)
        make_sample(folder / "town", SampleSettings().replace(TOWN))
        run = recipe_run("sensor-3dgs", folder / "town", CHANGES, folder / "runs")
        return run.result().metrics["test.psnr"] or 0.0


if __name__ == "__main__":
    sys.exit(main())
