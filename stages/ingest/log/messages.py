"""Decoded columns of messages as the streams of a raw log: field, fixes, attitude, speed."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.stages.ingest.log.bindings import Binding, Role
from magtiles.stages.ingest.log.raw import FieldSamples, Speeds, rising
from magtiles.stages.ingest.log.source import IngestLogParams, rotation
from magtiles.stages.vehicle.positions import Attitudes, Fixes, Real

_LOG = logging.getLogger(__name__)

Columns = dict[str, NDArray[Any]]

NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
"""ROS turns from forward, left, up to east, north, up (REP 103)."""

_LEAST_NORM = 0.5  # of a quaternion: some drivers write zeros where they have none


def _reduce_field(columns: Mapping[str, NDArray[Any]]) -> Columns:
    if "total" in columns:
        return {"values": columns["total"].astype(np.float64)}
    values = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64, copy=False)
    reduced: Columns = {"values": values}
    if "covariance" in columns:
        variance = columns["covariance"][:, [0, 4, 8]]
        known = (variance > 0).all(axis=1)  # zero is said to mean unknown
        reduced["variance"] = (
            variance[known].mean(axis=0, keepdims=True)
            if known.any()
            else (np.full((1, 3), np.nan))
        )
    return reduced


def _reduce_fix(columns: Mapping[str, NDArray[Any]]) -> Columns:
    covariance, kind = columns.get("covariance"), columns.get("covariance_type")
    reduced = {n: v for n, v in columns.items() if n not in ("covariance", "covariance_type")}
    size = columns["latitude"].size
    horizontal = vertical = np.full(size, np.nan)
    if covariance is not None and kind is not None and covariance.shape == (size, 9):
        variance = covariance.astype(np.float64)
        horizontal, vertical = (
            np.sqrt(np.where((kind > 0) & (v > 0), v, np.nan))
            for v in (np.maximum(variance[:, 0], variance[:, 4]), variance[:, 8])
        )
    return {**reduced, "horizontal_sigma": horizontal, "vertical_sigma": vertical}


def _reduce_attitude(columns: Mapping[str, NDArray[Any]]) -> Columns:
    """Quaternions w, x, y, z and rates as given, NaN where the message measures none (-1)."""
    quaternion = np.stack([columns[f"q{axis}"] for axis in "wxyz"], axis=1)
    rate = np.stack([columns[f"rate_{axis}"] for axis in "xyz"], axis=1)
    norm = np.linalg.norm(quaternion, axis=1)
    known = np.isfinite(norm) & (norm > _LEAST_NORM) & (columns["covariance"][:, 0] != -1)
    quaternion[~known] = np.nan
    rate[columns["rate_covariance"][:, 0] == -1] = np.nan
    return {"quaternion": quaternion, "rate": rate}


def _reduce_speed(columns: Mapping[str, NDArray[Any]]) -> Columns:
    return {"speed": np.hypot(columns["x"], columns["y"])}


REDUCE: Mapping[Role, Callable[[Mapping[str, NDArray[Any]]], Columns]] = {
    "magnetometer": _reduce_field,
    "fix": _reduce_fix,
    "attitude": _reduce_attitude,
    "speed": _reduce_speed,
}
"""What is kept of each chunk's columns, so that a long log stays small in memory."""


def _field(columns: Columns, binding: Binding, params: IngestLogParams, topic: str) -> FieldSamples:
    sigma = None
    if "variance" in columns and np.isfinite(columns["variance"]).any():
        sigma = np.sqrt(np.nanmean(columns["variance"], axis=0))
    return FieldSamples(
        columns["time"],
        columns["values"],
        binding.unit,
        topic,
        columns["restamped"] if columns["restamped"].any() else None,
        sigma,
    )


def _fixes(columns: Columns, binding: Binding, params: IngestLogParams, topic: str) -> Fixes:
    order = in_order(columns, topic)
    blank = np.full(order.size, np.nan)
    status = columns["status"][order] if "status" in columns else np.zeros(order.size)
    return Fixes(
        columns["time"][order],
        columns["latitude"][order].astype(np.float64),
        columns["longitude"][order].astype(np.float64),
        columns["height"][order].astype(np.float64) if "height" in columns else blank,
        np.clip(status, -1, 2).astype(np.int8),
        columns["horizontal_sigma"][order],
        columns["vertical_sigma"][order],
    )


def _attitudes(
    columns: Columns, binding: Binding, params: IngestLogParams, topic: str
) -> Attitudes:
    """From an IMU's axes to east, north, up (REP 103) as body to north, east, down."""
    order = in_order(columns, topic)
    quaternion = columns["quaternion"][order]
    stated = rotation(params.imu_to_body)
    to_body = FRD_FROM_FLU if stated is None else stated
    known = np.isfinite(quaternion).all(axis=1)
    if known.any():
        quaternion[known] = turned(quaternion[known], NED_FROM_ENU, to_body)
    return Attitudes(columns["time"][order], quaternion, columns["rate"][order] @ to_body.T)


def turned(quaternion: Real, world: Real, to_body: Real) -> Real:
    """Quaternions sensor to world (n, 4) as body to `world` times that world."""
    turn = Rotation.from_quat(quaternion, scalar_first=True)
    whole = Rotation.from_matrix(world) * turn * Rotation.from_matrix(to_body).inv()
    return np.asarray(whole.as_quat(scalar_first=True), dtype=np.float64)


def _speeds(columns: Columns, binding: Binding, params: IngestLogParams, topic: str) -> Speeds:
    order = in_order(columns, topic)
    return Speeds(columns["time"][order], columns["speed"][order])


BUILD: Mapping[Role, Callable[[Columns, Binding, IngestLogParams, str], Any]] = {
    "magnetometer": _field,
    "fix": _fixes,
    "attitude": _attitudes,
    "speed": _speeds,
}
"""What makes a role's stream of all its columns."""


def in_order(columns: Columns, topic: str) -> NDArray[np.intp]:
    """Indices that put messages in order of time, each time once; a warning says what it left."""
    order = rising(columns["time"])
    back = int((np.diff(columns["time"]) < np.timedelta64(0)).sum())
    if back:
        _LOG.warning("topic %s: time goes back %d times; put in order", topic, back)
    return order
