"""Small releases of exact dipole fields, made without the stages: the truth for the reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.catalog.kernels.dipole import dipole_field_geodetic, geodetic_to_ecef
from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.tile_table import TILE_VARIABLES
from magtiles.stages.release.provenance import resource, slsa_predicate
from magtiles.stages.release.publish import PublishResult, publish_release
from magtiles.stages.release.tile_file import write_tile

Floats = NDArray[np.float64]

VECTOR = ("anomaly_north", "anomaly_east", "anomaly_down")
TENSOR = ("gradient_nn", "gradient_ne", "gradient_nd", "gradient_ee", "gradient_ed")
WGS84_WKT = 'GEOGCRS["WGS 84",ENSEMBLE["World Geodetic System 1984 ensemble"]]'


def small_lattice(south: float = 44.0, west: float = 10.0) -> Lattice:
    """Three by three tiles, the last row and column clipped; about 1 km cells."""
    return Lattice(south, west, 0.009, 0.0125, rows=46, columns=53, tile_rows=18, tile_columns=20)


@dataclass(frozen=True)
class World:
    """Dipoles under a lattice, and a release's levels above it."""

    lattice: Lattice = field(default_factory=small_lattice)
    heights: tuple[float, ...] = (0.0, 1000.0, 2000.0, 4000.0, 8000.0)
    height_reference: str = "ellipsoid"
    surface: Callable[[Floats, Floats], Floats] | None = None
    shallowest: float = 2500.0
    beyond: tuple[slice, slice] | None = None
    """Nodes, counted from the first with its halo, that are beyond coverage on every level."""
    seed: int = 0

    @property
    def dipoles(self) -> tuple[Floats, Floats]:
        """ECEF positions, m, and moments, A m2; some 100 nT in rms at the surface."""
        rng = np.random.default_rng(self.seed)
        area = self.lattice
        n = max(40, area.rows * area.columns // 40)
        lat = rng.uniform(area.south - 0.15, area.north + 0.15, n)
        lon = rng.uniform(area.west - 0.2, area.east + 0.2, n)
        depth = rng.uniform(self.shallowest, 12_000.0, n)
        axis = rng.normal(size=(n, 3))
        strength = 1e10 * (depth / 2500.0) ** 2.5 * rng.uniform(0.3, 1.0, n)
        axis *= (strength / np.linalg.norm(axis, axis=1))[:, None]
        return geodetic_to_ecef(lat, lon, -depth), axis

    def surface_height(self, lat: Floats, lon: Floats) -> Floats:
        """Ellipsoidal height of what levels count from."""
        return (
            np.zeros(np.broadcast(lat, lon).shape)
            if self.surface is None
            else self.surface(lat, lon)
        )

    def truth(self, lat: Floats, lon: Floats, height: Floats) -> tuple[Floats, Floats, Floats]:
        """Total (...,), vector (..., 3) nT and tensor (..., 5) nT/km at ellipsoidal heights."""
        vector, tensor = dipole_field_geodetic(lat, lon, height, *self.dipoles)
        return np.sum(vector * ambient(lat, lon), axis=-1), vector, tensor

    def tile(self, row: int, column: int, level_wide: dict[str, NDArray[Any]]) -> xr.Dataset:
        """One tile, cut from level-wide arrays."""
        lattice = self.lattice
        rows, columns = lattice.core(row, column)
        lat, lon = lattice.tile_axes(row, column)
        i, j = row * lattice.tile_rows, column * lattice.tile_columns
        cut = np.s_[..., i : i + len(lat), j : j + len(lon)]
        variables: dict[str, Any] = {
            name: (TILE_VARIABLES[name].dims, values[cut], attributes(name))
            for name, values in level_wide.items()
        }
        for name, values in (("height", self.heights), ("latitude", lat), ("longitude", lon)):
            variables[name] = (name, np.asarray(values, np.float64), attributes(name))
        variables["crs"] = ((), np.int32(0), {"crs_wkt": WGS84_WKT})
        return xr.Dataset(variables, attrs=self.attributes(row, column, rows, columns))

    def attributes(self, row: int, column: int, rows: int, columns: int) -> dict[str, Any]:
        """Global attributes of a tile."""
        return {
            "Conventions": "CF-1.11", "contract": "anomaly-tile/1.0.0", "source": "dipoles",
            "reference_field": "none", "reference_epoch": "2020-01-01",
            "anomaly_definition": "projection on the ambient direction",
            "height_reference": self.height_reference, "halo_cells": 12,
            "ambient_inclination_deg": 60.0, "ambient_declination_deg": 17.0,
            "tile_row": row, "tile_column": column, "core_rows": rows, "core_columns": columns,
        }  # fmt: skip

    def level_wide(self) -> dict[str, NDArray[Any]]:
        """Every variable over the whole lattice and its halo."""
        lat = self.lattice.latitudes(np.arange(-12, self.lattice.rows + 13))[:, None]
        lon = self.lattice.longitudes(np.arange(-12, self.lattice.columns + 13))[None, :]
        surface = self.surface_height(lat, lon)
        levels = [self.truth(lat, lon, surface + h) for h in self.heights]
        total, vector, tensor = (np.stack([level[k] for level in levels]) for k in range(3))
        fields: dict[str, Any] = {"magnetic_anomaly": total}
        fields |= {name: vector[..., k] for k, name in enumerate(VECTOR)}
        fields |= {name: tensor[..., k] for k, name in enumerate(TENSOR)}
        sigma = 1.0 + 0.5 * np.sin(40.0 * lat) * np.cos(30.0 * lon) + np.zeros_like(total)
        fields |= {
            "magnetic_anomaly_uncertainty": sigma,
            "vector_uncertainty": 2.0 * sigma,
            "tensor_uncertainty": 0.5 * sigma,
        }
        direction = ambient(lat, lon) + np.zeros((*total.shape[1:], 3))
        fields |= {
            f"ambient_{a}": direction[..., k] for k, a in enumerate(("north", "east", "down"))
        }
        if self.surface is not None:
            fields["reference_surface_height"] = surface
        flags = np.zeros(total.shape, np.uint8)
        if self.beyond is not None:
            flags[:, *self.beyond] = 2
        return {k: np.asarray(v, np.float32) for k, v in fields.items()} | {"quality_flag": flags}

    def write_tiles(self, folder: Path) -> list[Path]:
        """Tile files in `folder`."""
        folder.mkdir(parents=True, exist_ok=True)
        wide, paths = self.level_wide(), []
        for row in range(self.lattice.shape[0]):
            for column in range(self.lattice.shape[1]):
                paths.append(folder / f"{row}-{column}.nc")
                write_tile(self.tile(row, column, wide), paths[-1])
        return paths

    def publish(self, store: Path, version: str = "1.0.0", **changes: Any) -> PublishResult:
        """A release in ``store/demo/<version>``."""
        arguments: dict[str, Any] = {
            "product": "demo", "version": version, "identity": {},
            "inputs": [{"id": "dipoles", "sha256": "0" * 64, "licence": "CC0", "role": "grid"}],
            "provenance": made_in_a_test(), "extra_files": {},
        }  # fmt: skip
        arguments |= changes
        if "tiles" not in arguments:
            arguments["tiles"] = self.write_tiles(store / "work")
        return publish_release(store, **arguments)


def made_in_a_test(**internal: Any) -> dict[str, Any]:
    """A provenance that claims as little as it may."""
    return slsa_predicate(
        parameters={"product": resource("test.toml", None), "sources": [resource("dipoles", None)]},
        internal=internal,
        inputs=[{"id": "dipoles", "sha256": "0" * 64, "licence": "CC0", "role": "grid"}],
        packages={},
        byproducts=[],
    )


def attributes(name: str) -> dict[str, Any]:
    """Attributes that the contract asks of a variable."""
    if name == "quality_flag":
        return {"flag_masks": np.array([1, 2, 4, 8, 16], np.uint8), "flag_meanings": "a b c d e"}
    units = TILE_VARIABLES[name].units
    return {} if units is None else {"units": units}


def ambient(lat: Floats, lon: Floats) -> Floats:
    """Unit vector of a field whose inclination and declination vary over the map."""
    inclination = np.radians(60.0 + 0.8 * (np.asarray(lat) - 44.0))
    declination = np.radians(17.0 + 0.5 * np.sin(np.radians(lon)))
    inclination, declination = np.broadcast_arrays(inclination, declination)
    return np.stack(
        [
            np.cos(inclination) * np.cos(declination),
            np.cos(inclination) * np.sin(declination),
            np.sin(inclination),
        ],
        axis=-1,
    )
