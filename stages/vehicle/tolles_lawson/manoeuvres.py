"""Calibration manoeuvres: rolls, pitches and yaws of a few seconds on a steady heading."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.ndimage
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtiles.stages.vehicle.tolles_lawson.filter import Filter
from magtiles.stages.vehicle.tolles_lawson.runs import Run
from magtiles.stages.vehicle.tolles_lawson.terms import direction_cosines

Floats = NDArray[np.float64]
Kind = Literal["roll", "pitch", "yaw", "unknown"]

_KINDS: tuple[Kind, ...] = ("roll", "pitch", "yaw")
_OSCILLATION_HZ = (0.1, 1.0)
_HEADING_HZ = 0.05
_TURNING_DEG_S = 1.0
_WINDOW_S = 5.0
_SHORTEST_S = 8.0
_CROSSINGS = 4  # of zero: two whole oscillations
_SAME_HEADING_DEG = 30.0


@dataclass(frozen=True)
class Manoeuvre:
    """One series of oscillations about one axis; rows `start` to `stop` of the track.

    `heading_deg` is true where the track has attitudes, else magnetic. `kind` is unknown without
    attitudes: the field alone does not tell a roll from a yaw on a northern heading.
    """

    kind: Kind
    start: int
    stop: int
    heading_deg: float
    amplitude_deg: float


def find_manoeuvres(track: xr.Dataset, runs: list[Run], least_deg: float) -> list[Manoeuvre]:
    """Series of oscillations of at least `least_deg` between 0.1 and 1 Hz on a steady heading.

    Angles are those of `attitude`, where a run has it throughout, or of the field's direction in
    the body. A series lasts at least 8 s and crosses its middle four times; what falls in a turn
    of more than 1 degree per second does not count.
    """
    return [one for run in runs for one in _in_run(track, run, least_deg)]


def heading_groups(manoeuvres: list[Manoeuvre]) -> list[int]:
    """For each manoeuvre the number of its heading; headings within 30 degrees are one."""
    firsts: list[float] = []
    groups = []
    for one in manoeuvres:
        apart = [abs((one.heading_deg - h + 180.0) % 360.0 - 180.0) for h in firsts]
        if not apart or min(apart) > _SAME_HEADING_DEG:
            firsts.append(one.heading_deg)
            apart.append(0.0)
        groups.append(int(np.argmin(apart)))
    return groups


def mark(manoeuvres: list[Manoeuvre], size: int) -> NDArray[np.bool_]:
    """Rows (size,) that belong to one of the manoeuvres."""
    inside = np.zeros(size, dtype=bool)
    for one in manoeuvres:
        inside[one.start : one.stop] = True
    return inside


def _in_run(track: xr.Dataset, run: Run, least_deg: float) -> list[Manoeuvre]:
    slowest, fastest = _OSCILLATION_HZ[0], min(_OSCILLATION_HZ[1], 0.45 / run.step_s)
    swing = Filter(slowest, fastest)
    steady = Filter(None, _HEADING_HZ)
    if fastest <= slowest or len(run) * run.step_s < 2.0 * _SHORTEST_S:
        return []
    angles, pointing, kinds = _angles(track, run)
    oscillation = swing.apply(angles, run.step_s)
    window = max(1, round(_WINDOW_S / run.step_s))
    power = scipy.ndimage.uniform_filter1d(oscillation**2, window, axis=0)
    amplitude = np.sqrt(2.0 * np.maximum(power, 0.0))
    if kinds == ("unknown",):  # three parts of one turning
        amplitude = np.linalg.norm(amplitude, axis=1, keepdims=True)
    north, east = steady.apply(pointing, run.step_s).T
    heading = np.degrees(np.unwrap(np.arctan2(east, north)))
    turning = np.abs(np.gradient(heading) / run.step_s) > _TURNING_DEG_S
    strongest = np.where(
        (amplitude.max(axis=1) >= least_deg) & ~turning, amplitude.argmax(axis=1), -1
    )
    found = []
    for first, last in _stretches(strongest, round(_SHORTEST_S / run.step_s)):
        rows, which = slice(first, last), int(strongest[first])
        along = _along(oscillation[rows], which, kinds)
        if np.count_nonzero(np.diff(np.signbit(along))) < _CROSSINGS:
            continue
        found.append(
            Manoeuvre(
                kinds[which],
                run.start + first,
                run.start + last,
                float(np.median(heading[rows]) % 360.0),
                float(np.median(amplitude[rows, which])),
            )
        )
    return found


def _angles(track: xr.Dataset, run: Run) -> tuple[Floats, Floats, tuple[Kind, ...]]:
    """Angles that may oscillate (n, 3), degrees, horizontal pointing (n, 2), and their kinds."""
    if "attitude" in track:
        quaternion = track["attitude"].values[run.rows].astype(np.float64)
        if np.isfinite(quaternion).all():
            turned = Rotation.from_quat(np.roll(quaternion, -1, axis=1))
            yaw, pitch, roll = np.unwrap(turned.as_euler("ZYX"), axis=0).T
            angles = np.degrees(np.stack([roll, pitch, yaw], axis=1))
            return angles, np.stack([np.cos(yaw), np.sin(yaw)], axis=1), _KINDS
    direction = direction_cosines(track["field_body"].values[run.rows].astype(np.float64))
    pointing = direction[:, :2] * np.array([1.0, -1.0])
    return np.degrees(direction), pointing, ("unknown",)


def _stretches(labels: NDArray[np.intp], shortest: int) -> list[tuple[int, int]]:
    """Where a label other than -1 stays the same for at least `shortest` samples."""
    cuts = np.flatnonzero(np.diff(labels)) + 1
    bounds = np.concatenate([[0], cuts, [labels.size]])
    pairs = zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)
    return [(a, b) for a, b in pairs if labels[a] >= 0 and b - a >= shortest]


def _along(oscillation: Floats, which: int, kinds: tuple[Kind, ...]) -> Floats:
    """The oscillation about its own axis (n,): the angle's, or the main one of a direction's."""
    if kinds != ("unknown",):
        return oscillation[:, which]
    principal = np.linalg.svd(oscillation, full_matrices=False)[2][0]
    return np.asarray(oscillation @ principal)
