"""Where recipes leave surfaces, for whoever reads runs without loading the stages."""

from __future__ import annotations

#: Below the artifacts folder.
MESH_FILE = "mesh.ply"
#: What a browser turns smoothly.
MOST_FACES = 200_000
