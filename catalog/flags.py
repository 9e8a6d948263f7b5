"""The bits of `quality_flag`, the same in every grid and tile."""

from __future__ import annotations

import enum
from typing import Any

import numpy as np


class QualityFlag(enum.IntFlag):
    """Why a value is missing, filled or doubtful."""

    VOID_FILLED = 1
    BEYOND_COVERAGE = 2
    DOWNWARD_CONTINUED = 4
    POORLY_LEVELLED = 8
    REDUCED_ACCURACY_DIRECTION = 16


def flag_attributes() -> dict[str, Any]:
    """CF attributes of a quality_flag variable."""
    return {
        "long_name": "why a value is filled or doubtful",
        "flag_masks": np.array([flag.value for flag in QualityFlag], dtype=np.uint8),
        "flag_meanings": " ".join(str(flag.name).lower() for flag in QualityFlag),
    }
