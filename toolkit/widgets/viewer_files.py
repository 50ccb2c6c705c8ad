"""The viewers' JavaScript: our own modules, and the WebGL bundle where it was built."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

FOLDER = Path(__file__).parent / "viewer"
#: What scripts/build_viewer.sh makes, relative to this file's folder.
BUNDLE = "viewer/dist/viewer.js"
NOT_BUILT = (
    "The WebGL viewer is not built. Pictures come from the CPU rasterizer instead, which is slower. "
    "To build it (needs npm): make viewer, or sh scripts/build_viewer.sh."
)
# In the order in which they use each other.
_MODULES = ("vectors.js", "navigation.js", "overlay.js", "stage.js")
_IMPORT = re.compile(r"^import [^;]*;\n", re.MULTILINE)


def is_built() -> bool:
    """Return whether the WebGL viewer can be shown."""
    return (Path(__file__).parent / BUNDLE).is_file()


def bundle_version() -> str:
    """Return a text that changes with the bundle, for browsers to keep it no longer than that."""
    return hashlib.sha256((Path(__file__).parent / BUNDLE).read_bytes()).hexdigest()[:16]


def plain_module(name: str) -> str:
    """Return ``src/<name>`` and what it uses as one module, for the viewer that has to do without a bundler.

    The modules' names do not meet each other: put one after the other, without their imports, they are one module.
    """
    texts = [(FOLDER / "src" / file).read_text(encoding="utf-8") for file in (*_MODULES, name)]
    return "\n".join(_IMPORT.sub("", text) for text in texts)
