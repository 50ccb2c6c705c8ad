"""Incremental structure from motion: poses, points and calibration from matched pictures (COLMAP's mapper)."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from toolkit.errors import StageError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.matching.colmap_job import run_colmap
from toolkit.matching.database import copy_database
from toolkit.matching.features import FEW_FEATURES, FeatureReport, SiftSettings, extract_sift
from toolkit.matching.match import MatchReport, MatchSettings, match_pairs
from toolkit.matching.pairs import PairSettings, choose_pairs
from toolkit.poses.adjust import adjust
from toolkit.poses.sfm_failure import why_no_model
from toolkit.progress import Progress, ProgressEvent, silent
from toolkit.scene import Scene, scene_from_pycolmap
from toolkit.settings import Boolean, Choice, Group, Integer, Number, Settings
