"""How many errors of noisy surveys lie inside one stated sigma, apart for three kinds of place."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from known import Field
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.pipeline.sample import DEMO, Sample, synthesize, write_survey
from magtiles.stages.field.components import DeriveComponentsParams, derive_components
from magtiles.stages.field.level import PRODUCTS, SIGMAS
from magtiles.stages.field.voids import FillVoidsParams, fill_voids
from magtiles.stages.ingest.grid import STAGE as INGEST

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Counts = dict[tuple[float, str, str], list[int]]

PLACES = ("interior", "border", "void")
BORDER_M = 20e3

WORLD = replace(
    DEMO, name="world", width_m=160e3, length_m=120e3, dipoles=373, levels_m=(2500.0,), void=False
)
"""The demo's kind of survey, smaller, so that many can be drawn."""
VOIDS = tuple((across, up) for across in (0.40, 0.58, 0.76) for up in (0.35, 0.65))


def draw(seed: int) -> Sample:
    """A survey with a coast and six voids, of the demo's size each."""
    sample = synthesize(replace(WORLD, seed=seed))
    anomaly = sample.anomaly.copy()
    for across, up in VOIDS:
        east = (sample.x - sample.x[0] - across * np.ptp(sample.x)) / 6000.0
        north = (sample.y - sample.y[0] - up * np.ptp(sample.y)) / 4000.0
        anomaly[east**2 + north[:, None] ** 2 < 1.0] = np.nan
    return replace(sample, anomaly=anomaly)


def places(sample: Sample, flags: NDArray[np.uint8]) -> dict[str, Mask]:
    """Where a map's nodes lie: unflagged inside, unflagged within 20 km of the border, voids."""
    labels, _ = ndimage.label(np.pad(np.isnan(sample.anomaly), 1, constant_values=True))
    outside = labels == labels[0, 0]
    inward = sample.spec.spacing_m * ndimage.distance_transform_edt(~outside)[1:-1, 1:-1]
    return {
        "interior": (inward > BORDER_M) & (flags == 0),
        "border": (inward <= BORDER_M) & (flags == 0),
        "void": (flags & 3) == 1,
    }


def count(counts: Counts, gain: float, where: dict[str, Mask], error: Field, sigma: Field) -> None:
    """Add to `counts` how many errors of each kind there are, and how many lie inside sigma."""
    for (quantity, e), (_, s) in zip(error, sigma, strict=True):
        for place, mask in where.items():
            inside = np.abs(e[mask]) < s[mask]
            tally = counts.setdefault((gain, quantity, place), [0, 0])
            tally[0] += int(inside.sum())
            tally[1] += inside.size


def fractions(counts: Counts) -> dict[tuple[float, str, str], float]:
    return {key: inside / every for key, (inside, every) in counts.items()}


def pooled(seeds: Iterable[int], gains: Iterable[float]) -> Counts:
    """Counts over many surveys, through the stages from survey file to component grid."""
    counts: Counts = {}
    for seed in seeds:
        sample = draw(seed)
        with tempfile.TemporaryDirectory() as folder:
            data, source, _ = write_survey(Path(folder), sample)
            grid = INGEST.run(files=[source, data], params=INGEST.params())
        filled = fill_voids(grid, params=FillVoidsParams())
        for gain in gains:
            found = derive_components(filled, params=DeriveComponentsParams(height_m=gain))
            where = places(sample, found["quality_flag"].values)
            place = sample.latitude, sample.longitude, WORLD.height_m + gain
            truth = Field(*sample.truth(*place))
            total, *rest = (found[name].values.astype(float) for name in PRODUCTS)
            vector, tensor = np.stack(rest[:3], axis=-1), np.stack(rest[3:], axis=-1)
            error = Field(total - truth.total, vector - truth.vector, tensor - truth.tensor)
            count(counts, gain, where, error, Field(*(found[name].values for name in SIGMAS)))
    return counts
