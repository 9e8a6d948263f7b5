"""The bits of `quality_flag`: of grids and tiles, of observatory records, and of tracks."""

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


class RecordFlag(enum.IntFlag):
    """What is wrong, or said to be, with a sample of an observatory's record (uint8)."""

    MISSING_MARK = 1
    SPIKE = 2
    STEP = 4
    STUCK = 8
    TOTAL_MISMATCH = 16
    LEVEL_MISMATCH = 32
    INCOMPLETE_AVERAGE = 64
    OVERLAP_RESOLVED = 128


UNFIT_RECORD = RecordFlag.SPIKE | RecordFlag.STUCK | RecordFlag.TOTAL_MISMATCH
"""Samples that carry one of these are left out of baselines and statistics."""


class QuietDayChoice(enum.IntFlag):
    """How the quiet days of a month were chosen, and what they lack (uint8)."""

    LIST = 1
    KP = 2
    RECORD = 4
    STANDBY = 8
    FEWER_THAN_FIVE = 16
    TOO_FEW_DAYS = 32


class TrackFlag(enum.IntFlag):
    """What is doubtful of a sample of a track (uint16)."""

    NO_FIX = 1
    FIX_OUTLIER = 2
    POSITION_GAP = 4
    STATIONARY = 8
    FIELD_GAP = 16
    FIELD_SPIKE = 32
    MANOEUVRE = 64
    NO_DIURNAL = 128
    CLOCK_STEP = 256
    EXTRAPOLATED_CALIBRATION = 512


class RoadFlag(enum.IntFlag):
    """What is doubtful of a point of a road map (uint8)."""

    INTERPOLATED = 1
    UNDERSAMPLED = 2
    POSITION_DOUBTFUL = 4
    TRANSIENT_DROPPED = 8
    SINGLE_PASS = 16
    UNCALIBRATED = 32


def flag_attributes(
    flags: type[enum.IntFlag] = QualityFlag, dtype: type[np.unsignedinteger[Any]] = np.uint8
) -> dict[str, Any]:
    """CF attributes of a quality_flag variable."""
    return {
        "long_name": "why a value is filled or doubtful",
        "flag_masks": np.array([flag.value for flag in flags], dtype=dtype),
        "flag_meanings": " ".join(str(flag.name).lower() for flag in flags),
    }
