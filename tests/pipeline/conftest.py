"""A small release whose every number is exact: dipoles under a lattice of 2 x 2 tiles."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pyproj
import pytest
from numpy.typing import NDArray

from magtiles.catalog import open_release
from magtiles.catalog.flags import QualityFlag, flag_attributes
from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.kernels.dipole import dipole_field_geodetic, geodetic_to_ecef
from magtiles.catalog.releases.digest import array_digest, canonical_json, manifest_digest, sha256
from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.tile_table import TILE_VARIABLES, UNITS
from magtiles.stages.release.checks import CHECKS_NAME, make_checks

LATTICE = Lattice(
    south=44.4,
    west=-104.5,
    latitude_spacing=0.005,
    longitude_spacing=0.007,
    rows=36,
    columns=28,
    tile_rows=20,
    tile_columns=16,
)
HEIGHTS = (500.0, 1500.0)
AMBIENT = np.array([0.33, 0.09, 0.94]) / np.linalg.norm([0.33, 0.09, 0.94])
IDENTITY = {
    "reference_field": "IGRF-13",
    "reference_epoch": "2015-07-01",
    "anomaly_definition": "total field minus reference field",
    "datum": "WGS84",
    "units": UNITS,
}

Arrays = dict[str, NDArray[Any]]


def exact_fields(
    latitude: NDArray[np.float64], longitude: NDArray[np.float64], height: float
) -> Arrays:
    """Vector, tensor and f . vector of 30 dipoles 2-6 km deep, as float32."""
    rng = np.random.default_rng(20150701)
    places = rng.uniform([44.3, -104.6, -6000.0], [44.7, -104.2, -2000.0], (30, 3))
    moments = rng.normal(0.0, 3e10, (30, 3))
    vector, tensor = dipole_field_geodetic(
        latitude[:, None], longitude[None, :], height, geodetic_to_ecef(*places.T), moments
    )
    fields = {f"anomaly_{a}": vector[..., i] for i, a in enumerate(("north", "east", "down"))}
    for i, pair in enumerate(("nn", "ne", "nd", "ee", "ed")):
        fields[f"gradient_{pair}"] = tensor[..., i]
    fields["magnetic_anomaly"] = vector @ AMBIENT
    return {name: values.astype(np.float32) for name, values in fields.items()}


def level_arrays(
    latitude: NDArray[np.float64], longitude: NDArray[np.float64], height: float
) -> Arrays:
    """What a tile holds at one level; the outermost eastern half cell is beyond coverage."""
    fields = exact_fields(latitude, longitude, height)
    shape = (latitude.size, longitude.size)
    for name, value in (("magnetic_anomaly", 2.0), ("vector", 3.0), ("tensor", 1.5)):
        fields[f"{name}_uncertainty"] = np.full(shape, value, np.float32)
    flags = np.zeros(shape, np.uint8)
    flags[:, longitude > LATTICE.east - 1e-6] |= np.uint8(QualityFlag.BEYOND_COVERAGE)
    flags[(latitude > 44.5)[:, None] & (longitude < -104.48)] |= np.uint8(QualityFlag.VOID_FILLED)
    fields["quality_flag"] = flags
    return fields


def tile_arrays(row: int, column: int) -> Arrays:
    """All arrays of one tile, halo included."""
    latitude, longitude = LATTICE.tile_axes(row, column)
    levels = [level_arrays(latitude, longitude, h) for h in HEIGHTS]
    arrays = {name: np.stack([level[name] for level in levels]) for name in levels[0]}
    for i, axis in enumerate(("north", "east", "down")):
        arrays[f"ambient_{axis}"] = np.full((latitude.size, longitude.size), AMBIENT[i], np.float32)
    arrays |= {"latitude": latitude, "longitude": longitude, "height": np.array(HEIGHTS)}
    return arrays | {"crs": np.array(0, np.int32)}


def write_tile(path: Path, row: int, column: int, arrays: Arrays, height_reference: str) -> None:
    core = LATTICE.core(row, column)
    attributes = {
        **{k: v for k, v in IDENTITY.items() if isinstance(v, str) and k != "datum"},
        "Conventions": "CF-1.11",
        "contract": "anomaly-tile/1.0.0",
        "height_reference": height_reference,
        "source": "exact dipoles",
        "ambient_inclination_deg": 70.0,
        "ambient_declination_deg": 15.0,
        "tile_row": np.int64(row),
        "tile_column": np.int64(column),
        "halo_cells": np.int64(HALO),
        "core_rows": np.int64(core[0]),
        "core_columns": np.int64(core[1]),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with netCDF4.Dataset(path, "w", format="NETCDF4") as file:
        file.setncatts(attributes)
        for name in ("height", "latitude", "longitude"):
            file.createDimension(name, arrays[name].size)
        for name in sorted(arrays):
            rule = TILE_VARIABLES[name]
            packed = {"zlib": True, "fletcher32": True} if rule.dims else {}
            variable = file.createVariable(
                name, arrays[name].dtype, rule.dims, fill_value=False, **packed
            )
            variable[...] = arrays[name]
            if rule.units is not None:
                variable.units = rule.units
        file["crs"].setncatts({"crs_wkt": pyproj.CRS(4979).to_wkt()})
        file["quality_flag"].setncatts(flag_attributes())


def tile_record(folder: Path, row: int, column: int, arrays: Arrays) -> dict[str, Any]:
    path = f"tiles/{row}-{column}.nc"
    data = (folder / path).read_bytes()
    core = (slice(None), slice(HALO, -HALO), slice(HALO, -HALO))
    stats = {}
    for name, values in arrays.items():
        if values.ndim == 3 and values.dtype == np.float32:
            v = values[core].astype(np.float64).reshape(len(HEIGHTS), -1)
            stats[name] = {
                "minimum": v.min(1).tolist(),
                "maximum": v.max(1).tolist(),
                "mean": v.mean(1).tolist(),
                "rms": np.sqrt((v**2).mean(1)).tolist(),
            }
    flags = arrays["quality_flag"][core]
    return {
        "path": path,
        "size": len(data),
        "sha256": sha256(data),
        "role": "tile",
        "contract": "anomaly-tile/1.0.0",
        "array_digest": array_digest(arrays),
        "row": row,
        "column": column,
        "bounds": {k: list(v) for k, v in LATTICE.bounds(row, column).items()},
        "statistics": stats,
        "flag_fractions": {
            str(f.name).lower(): float(np.mean((flags & f) != 0)) for f in QualityFlag
        },
    }


def write_manifest(folder: Path, files: list[dict[str, Any]], height_reference: str) -> None:
    document: dict[str, Any] = {
        "contract": "release-manifest/1.0.0",
        "product": "exact",
        "version": "1.2.3",
        "magtiles": "0.1.0",
        "identity": IDENTITY,
        "lattice": LATTICE.__dict__,
        "heights_m": list(HEIGHTS),
        "height_reference": height_reference,
        "files": files,
        "inputs": [{"id": "dipoles", "sha256": "0" * 64, "licence": "CC0-1.0", "role": "anomaly"}],
    }
    document["manifest_digest"] = manifest_digest(document)
    (folder / "manifest.json").write_bytes(canonical_json(document))


Change = Callable[[int, int, Arrays], None]


def build_release(
    folder: Path,
    change: Change = lambda row, column, arrays: None,
    height_reference: str = "ellipsoid",
) -> Path:
    """Write the release; `change` may alter a tile's arrays first, digests follow."""
    files = []
    for row in range(LATTICE.shape[0]):
        for column in range(LATTICE.shape[1]):
            arrays = tile_arrays(row, column)
            change(row, column, arrays)
            write_tile(folder / f"tiles/{row}-{column}.nc", row, column, arrays, height_reference)
            files.append(tile_record(folder, row, column, arrays))
    write_manifest(folder, files, height_reference)
    checks = canonical_json(make_checks(open_release(folder)))
    (folder / CHECKS_NAME).write_bytes(checks)
    record = {"path": CHECKS_NAME, "size": len(checks), "sha256": sha256(checks)}
    write_manifest(
        folder, [*files, record | {"role": "checks", "contract": None}], height_reference
    )
    return folder


@pytest.fixture(scope="session")
def exact_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The release, to be read only."""
    return build_release(tmp_path_factory.mktemp("exact") / "1.2.3")


@pytest.fixture
def spoilt_release(tmp_path: Path) -> Callable[[Change], Path]:
    """Builds the release with altered arrays, digests and all."""
    return lambda change: build_release(tmp_path / "spoilt", change)


@pytest.fixture
def finer_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same field on a lattice of four fifths of the spacing."""
    finer = dataclasses.replace(
        LATTICE,
        latitude_spacing=0.8 * LATTICE.latitude_spacing,
        longitude_spacing=0.8 * LATTICE.longitude_spacing,
        rows=LATTICE.rows * 5 // 4,
        columns=LATTICE.columns * 5 // 4,
    )
    monkeypatch.setitem(globals(), "LATTICE", finer)
    return build_release(tmp_path / "finer")


@pytest.fixture
def wider_release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same field on the same lattice with two columns of cells more in the east."""
    wider = dataclasses.replace(LATTICE, columns=LATTICE.columns + 2)
    monkeypatch.setitem(globals(), "LATTICE", wider)
    return build_release(tmp_path / "wider")


@pytest.fixture(scope="session")
def terrain_release(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The release as if its heights counted from a terrain of unknown height."""
    return build_release(tmp_path_factory.mktemp("terrain") / "1.2.3", height_reference="terrain")


@pytest.fixture
def release_copy(exact_release: Path, tmp_path: Path) -> Path:
    """The release, to be damaged."""
    return Path(shutil.copytree(exact_release, tmp_path / "copy"))
