"""The embedded sample: a synthetic survey in the real formats, with its exact truth beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import rasterio
import rasterio.io
import xarray as xr

from magtiles.catalog.kernels.dipole import TENSOR
from magtiles.pipeline.sample_aircraft import write_flight
from magtiles.pipeline.sample_observatories import (
    temporal_table,
    write_observatories,
    write_truth,
)
from magtiles.pipeline.synthetic import DEMO, ConstantField, Sample, SampleSpec, synthesize
from magtiles.pipeline.synthetic_observatories import TemporalSample
from magtiles.stages.release.atomic import atomic_path

__all__ = [
    "DEMO",
    "ConstantField",
    "Sample",
    "SampleSpec",
    "synthesize",
    "truth_dataset",
    "write_sample",
    "write_survey",
]

_NO_DATA = -999999.0


def write_sample(
    folder: Path,
    spec: SampleSpec = DEMO,
    temporal: TemporalSample | None = None,
    roads: Sequence[str] = (),
) -> list[Path]:
    """Write survey, source TOML, product TOML and truth of a spec; the same bytes every time.

    Returns the paths ``<name>-survey.tif``, ``<name>-survey.toml``, ``<name>.toml`` and
    ``<name>-truth.nc``, then those of `write_flight`; with a `temporal` sample those of
    `write_observatories` and ``<name>-temporal-truth.nc``. `roads` are lines of the product's
    [[roads]] tables. Existing files are replaced whole.
    """
    sample = synthesize(spec)
    paths = write_survey(folder, sample, temporal, roads)
    truth = folder / f"{spec.name}-truth.nc"
    dataset = truth_dataset(sample)
    packing = {"zlib": True, "complevel": 1, "shuffle": True}
    encoding: dict[Any, Any] = {
        name: packing if variable.ndim > 1 else {"_FillValue": None}
        for name, variable in dataset.variables.items()
    }
    with atomic_path(truth) as temporary:
        dataset.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)
    paths = [*paths[:3], truth, *write_flight(folder, sample), *paths[3:]]
    if temporal is not None:
        paths.append(folder / f"{spec.name}-temporal-truth.nc")
        write_truth(paths[-1], temporal)
    return paths


def write_survey(
    folder: Path,
    sample: Sample,
    temporal: TemporalSample | None = None,
    roads: Sequence[str] = (),
) -> list[Path]:
    """Write a sample without its truth: survey GeoTIFF, source TOML, product TOML.

    With a `temporal` sample also the files of `write_observatories`, which the product names;
    `roads` as of `write_sample`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    spec = sample.spec
    lines = [*roads] if temporal is None else [*temporal_table(spec.name, temporal), *roads]
    product = _product_toml(spec) + "".join(f"{line}\n" for line in lines)
    contents = {
        f"{spec.name}-survey.tif": _geotiff(sample),
        f"{spec.name}-survey.toml": _source_toml(spec).encode(),
        f"{spec.name}.toml": product.encode(),
    }
    for name, content in contents.items():
        with atomic_path(folder / name) as temporary:
            temporary.write_bytes(content)
    paths = [folder / name for name in contents]
    if temporal is not None:
        paths += write_observatories(folder, spec.name, temporal)
    return paths


def truth_dataset(sample: Sample) -> xr.Dataset:
    """Exact anomaly, vector and tensor on the survey's nodes at every level, (height, y, x).

    The first level is the survey surface: its `magnetic_anomaly` is the noise-free survey.
    """
    spec = sample.spec
    heights = np.array([spec.height_m, *spec.levels_m])
    levels = [sample.truth(sample.latitude, sample.longitude, h) for h in heights]
    dims = ("height", "y", "x")
    variables: dict[str, Any] = {
        "magnetic_anomaly": (dims, np.stack([t for t, _, _ in levels]), {"units": "nT"}),
    }
    for i, axis in enumerate(("north", "east", "down")):
        values = np.stack([v[..., i] for _, v, _ in levels])
        variables[f"anomaly_{axis}"] = (dims, values, {"units": "nT"})
    for i, pair in enumerate(TENSOR):
        values = np.stack([g[..., i] for _, _, g in levels])
        variables[f"gradient_{pair}"] = (dims, values, {"units": "nT km-1"})
    variables = {k: (d, v.astype(np.float32), a) for k, (d, v, a) in variables.items()}
    variables["latitude"] = (dims[1:], sample.latitude, {"units": "degrees_north"})
    variables["longitude"] = (dims[1:], sample.longitude, {"units": "degrees_east"})
    crs = pyproj.CRS.from_user_input(spec.crs).to_cf()
    variables["crs"] = ((), np.int32(0), crs)
    return xr.Dataset(
        variables,
        coords={
            "height": ("height", heights, {"units": "m", "positive": "up"}),
            "y": ("y", sample.y, {"units": "m"}),
            "x": ("x", sample.x, {"units": "m"}),
        },
        attrs={
            "Conventions": "CF-1.11",
            "title": f"exact field of the synthetic survey '{spec.name}', without noise",
            "height_reference": "ellipsoid",
            "reference_field": spec.reference_field,
            "reference_epoch": spec.epoch,
        },
    )


def _geotiff(sample: Sample) -> bytes:
    """The survey as a float32 GeoTIFF, northern row first."""
    spec, half = sample.spec, 0.5 * sample.spec.spacing_m
    west, north = sample.x[0] - half, sample.y[-1] + half
    values = np.where(np.isnan(sample.anomaly), _NO_DATA, sample.anomaly)[::-1]
    with rasterio.io.MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            width=sample.x.size,
            height=sample.y.size,
            count=1,
            dtype="float32",
            crs=spec.crs,
            transform=rasterio.Affine(spec.spacing_m, 0.0, west, 0.0, -spec.spacing_m, north),
            nodata=_NO_DATA,
            compress="deflate",
            predictor=3,
        ) as dataset:
            dataset.write(values.astype(np.float32), 1)
            dataset.units = ("nT",)
        return bytes(memory.read())


def _source_toml(spec: SampleSpec) -> str:
    lines = [
        f"# Synthetic survey '{spec.name}': {spec.dipoles} dipoles, noise {spec.noise_nt:g} nT.",
        "[source]",
        f'id = "{spec.name}-survey"',
        'kind = "anomaly-grid"',
        f'files = ["{spec.name}-survey.tif"]',
        'licence = "CC0-1.0"',
        'title = "Synthetic survey with exact truth beside it"',
        "",
        "[grid]",
        f"height_m = {spec.height_m}",
        'height_reference = "ellipsoid"',
        f'reference_field = "{spec.reference_field}"',
        f'reference_epoch = "{spec.epoch}"',
        f"uncertainty_nt = {spec.uncertainty_nt}",
    ]
    if spec.line_spacing_m is not None:
        lines += [
            f"line_spacing_m = {spec.line_spacing_m}",
            f"source_distance_m = {spec.depth_m[0]}",
        ]
    return "\n".join(lines) + "\n"


def _product_toml(spec: SampleSpec) -> str:
    lines = [
        "[product]",
        f'name = "{spec.name}"',
        'version = "1.0.0"',
        "",
        "[anomaly]",
        f'source = "{spec.name}-survey.toml"',
        f"heights_m = [{', '.join(str(h) for h in spec.levels_m)}]",
        'height_reference = "ellipsoid"',
    ]
    if spec.ambient is not None:
        lines += [
            f"inclination_deg = {spec.ambient.inclination}",
            f"declination_deg = {spec.ambient.declination}",
        ]
    return "\n".join(lines) + "\n"
