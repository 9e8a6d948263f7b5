"""Surveys of the whole globe whose crust is known, and how far off a level of them is.

As a program it measures the map of LCS-1, and that of EMAG2, against LCS-1 (docs/globe.md).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, evaluate_grid, load_igrf, read_model
from magtiles.stages.crs import WGS84
from magtiles.stages.field.harmonic_nodes import TENSOR_PARTS, static_model
from magtiles.stages.field.sphere import SphereComponentsParams, derive_globe_components
from magtiles.stages.ingest.grid import ingest_grid
from magtiles.stages.ingest.source import IngestGridParams

Real = NDArray[np.float64]

EPOCH, HEIGHT_M = "2000-01-01", 4000.0
LOW_SINE = np.sin(np.radians(20.0))


def random_crust(
    degree: int, *, seed: int, power: float = 20.0, slope: float = -0.01
) -> FieldModel:
    """A crust from degree 16 up whose power (nT^2 a degree, at 6371.2 km) falls exponentially."""
    n = np.arange(1, degree + 1)
    likely = np.where(n < 16, 0.0, power * np.exp(slope * n))
    each = np.sqrt(likely / ((n + 1) * (2 * n + 1)))
    gauss = np.random.default_rng(seed).standard_normal(degree * (degree + 2))
    return static_model("random", gauss * np.repeat(each, 2 * n + 1))


def directions(latitude: Real, longitude: Real, height_m: float) -> Real:
    """Unit vectors (m, n, 3) of the core field in true north, east, down."""
    core = evaluate_grid(load_igrf(13), latitude, longitude, [height_m], EPOCH)[0]
    return np.asarray(core / np.linalg.norm(core, axis=-1, keepdims=True))


def world(crust: FieldModel, step: float, sigma: float, *, seed: int = 5) -> xr.Dataset:
    """A survey of a crust 4 km above the ellipsoid, nodes `step` degrees apart, with noise."""
    latitude = np.arange(-90.0 + step / 2, 90.0, step)
    longitude = np.arange(-180.0, 180.0 - step / 2, step)
    field = evaluate_grid(crust, latitude, longitude, [HEIGHT_M], 0.0)[0]
    values = np.sum(field * directions(latitude, longitude, HEIGHT_M), axis=-1)
    noise = sigma * np.random.default_rng(seed).standard_normal(values.shape)
    return as_grid(latitude, longitude, values + noise, sigma)


def as_grid(latitude: Real, longitude: Real, values: Real, sigma: float) -> xr.Dataset:
    """An anomaly-grid/1 around the globe."""
    return xr.Dataset(
        {
            "magnetic_anomaly": (("latitude", "longitude"), values, {"units": "nT"}),
            "magnetic_anomaly_uncertainty": ((), sigma, {"units": "nT"}),
            "height": ((), HEIGHT_M, {"units": "m", "positive": "up"}),
            "crs": ((), np.int32(0), WGS84.to_cf()),
        },
        coords={
            "latitude": ("latitude", latitude, {"units": "degrees_north"}),
            "longitude": ("longitude", longitude, {"units": "degrees_east"}),
        },
        attrs={
            "Conventions": "CF-1.11",
            "reference_field": "IGRF-13",
            "reference_epoch": EPOCH,
            "anomaly_definition": "f . B",
            "height_reference": "ellipsoid",
            "source": "synthetic",
        },
    )


def level(globe: xr.Dataset, height_m: float, step: float) -> xr.Dataset:
    """A level on nodes off the survey's, 82 degrees south to 82 north."""
    return derive_globe_components(
        globe,
        params=SphereComponentsParams(
            height_m=height_m - HEIGHT_M,
            latitude=(-82.0 + step / 3, step, int(163 / step)),
            longitude=(-180.0 + step / 3, step, round(360 / step)),
        ),
    )


@dataclass(frozen=True)
class Score:
    """Root mean squares over an area, and the shares of errors within one and two sigma."""

    error: float
    field: float
    sigma: float
    within: tuple[float, float]

    def __str__(self) -> str:
        return (
            f"{self.error:.3g} | {self.field:.3g} | {self.sigma:.3g} | "
            f"{self.within[0]:.0%} | {self.within[1]:.0%}"
        )


def scores(made: xr.Dataset, crust: FieldModel) -> Iterator[tuple[str, str, Score]]:
    """Quantity, place ("near" the dip equator, "far") and score of a level against its crust."""
    place = made.latitude.values, made.longitude.values, float(made.height)
    field, tensor = evaluate_grid(crust, *place[:2], [place[2]], 0.0, gradient=True)
    along = directions(*place)
    five = np.stack([tensor[0][..., i, j] for i, j in TENSOR_PARTS.values()], axis=-1)
    found = {
        "total": made.magnetic_anomaly.values[..., None],
        "vector": np.stack([made[f"anomaly_{a}"] for a in ("north", "east", "down")], axis=-1),
        "tensor": np.stack([made[f"gradient_{name}"] for name in TENSOR_PARTS], axis=-1),
    }
    truth = {
        "total": np.sum(field[0] * along, axis=-1, keepdims=True),
        "vector": field[0],
        "tensor": five,
    }
    area = np.cos(np.radians(place[0]))[:, None, None]
    near = np.abs(along[..., 2]) < LOW_SINE
    for name, true in truth.items():
        key = "magnetic_anomaly" if name == "total" else name
        sigma = made[f"{key}_uncertainty"].values[..., None]
        for where, used in (("near", near), ("far", ~near)):
            yield name, where, _score(found[name] - true, true, sigma, area, used)


def _score(error: Real, true: Real, sigma: Real, area: Real, used: NDArray[np.bool_]) -> Score:
    weight = np.broadcast_to(area, error.shape)[used]

    def rms(values: Real) -> float:
        squares = np.broadcast_to(values, error.shape)[used] ** 2
        return float(np.sqrt(np.average(squares, weights=weight)))

    shares = [np.average((np.abs(error) < k * sigma)[used], weights=weight) for k in (1, 2)]
    return Score(rms(error), rms(true), rms(sigma), (float(shares[0]), float(shares[1])))


def emag2(data: Path) -> xr.Dataset:
    """The world's grid of one degree, 4 km above the sea."""
    params = IngestGridParams(
        crs="EPSG:4326", no_data=-99999.0, height_m=HEIGHT_M, height_reference="mean_sea_level",
        undulation_m=0.0, reference_field="IGRF-13", reference_epoch=EPOCH, uncertainty_nt=10.0,
    )  # fmt: skip
    return ingest_grid([data / "grids" / "EMAG2_V2_1x1.grd"], params=params)


def main() -> None:
    """Print how a map of LCS-1, and one of EMAG2, compare with LCS-1."""
    data = Path(os.environ.get("MAGTILES_TEST_DATA", sys.argv[1] if len(sys.argv) > 1 else "data"))
    crust = read_model(data / "harmonics" / "LCS-1.shc").degrees(1, 185)
    for name, globe in (("LCS-1", world(crust, 1.0, 3.0)), ("EMAG2", emag2(data))):
        for height in (4000.0, 20_000.0, 100_000.0):
            for quantity, where, score in scores(level(globe, height, 1.0), crust):
                print(f"| {name} | {height / 1000:g} | {quantity}, {where} | {score} |", flush=True)


if __name__ == "__main__":
    main()
