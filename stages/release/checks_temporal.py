"""The part of checks.json that asks a release's temporal model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.reader import Release

UNITS = {
    "baseline": "nT",
    "baseline_standard_error": "nT",
    "sigma": "nT",
    "tau": "s",
}

_OBSERVATORIES = 6
_HOURS = 7.3
"""Between one query and the next: all hours of the day come up."""
_KP = (np.nan, 1.0, 4.333)


def temporal_positions(release: Release) -> dict[str, NDArray[np.float64]]:
    """Places between the map and the first observatories, times in the months, Kp or none.

    `time` is in seconds since 1970, UTC.
    """
    model, lattice = release.temporal, release.manifest.lattice
    middle = (lattice.south + lattice.north) / 2, (lattice.west + lattice.east) / 2
    places = [middle]
    for station in model.observatories[:_OBSERVATORIES]:
        here = station.latitude, station.longitude
        between = 0.6 * here[0] + 0.4 * middle[0], 0.6 * here[1] + 0.4 * middle[1]
        places += [here, between]
    latitude, longitude = np.round(np.repeat(places, len(_KP), axis=0).T, 4)
    seconds = model.variables.get("segment_start", model.variables.get("month"))
    assert seconds is not None  # a temporal model has curves or segments
    time = float(seconds[0]) + 3600.0 * _HOURS * np.arange(latitude.size)
    kp = np.tile(_KP, len(places))
    return {
        "latitude": latitude,
        "longitude": (longitude + 180.0) % 360.0 - 180.0,
        "time": time,
        "kp": kp,
    }


def temporal_answers(
    release: Release, at: Mapping[str, NDArray[Any]]
) -> dict[str, NDArray[np.float64]]:
    """What the reader says there, (n, 4) each; what is not finite is NaN."""
    model = release.temporal
    place = at["latitude"], at["longitude"], at["time"].astype("datetime64[s]")
    answers: dict[str, NDArray[np.float64]] = {}
    if model.months.size:
        baseline = model.baseline(*place)
        answers["baseline"] = baseline.values
        answers["baseline_standard_error"] = baseline.standard_error
    if model.classes:
        fogm = model.fogm(*place, kp=at["kp"])
        answers |= {"sigma": fogm.sigma, "tau": fogm.tau}
    return {name: np.where(np.isfinite(v), v, np.nan) for name, v in answers.items()}
