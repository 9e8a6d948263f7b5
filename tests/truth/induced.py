"""A survey over rocks that are magnetised by the core field alone, at any date, exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pyproj
from known import Floats

from magtiles.catalog.kernels.dipole import dipole_field_geodetic, geodetic_to_ecef, ned_axes
from magtiles.pipeline.sample import DEMO
from magtiles.pipeline.synthetic import core_field


@dataclass(frozen=True)
class Induced:
    """Dipoles parallel to the IGRF where they are, and as strong as it, under a survey.

    Attributes
    ----------
    margin_m : how far sources reach beyond the border; negative for all well inside.
    cells : of the depth of the sources, shallowest and deepest.
    """

    crs: str
    latitude: float
    longitude: float
    spacing_m: float = 1000.0
    columns: int = 130
    rows: int = 90
    margin_m: float = -20e3
    cells: tuple[float, float] = (3.0, 5.0)
    sources: int = 80
    height_m: float = 1500.0

    @cached_property
    def axes(self) -> tuple[Floats, Floats]:
        """Coordinates y, x of the nodes, m."""
        x, y = self._to_wgs84.transform(self.longitude, self.latitude, direction="INVERSE")
        return tuple(  # type: ignore[return-value]
            middle + self.spacing_m * (np.arange(n) - (n - 1) / 2)
            for middle, n in ((y, self.rows), (x, self.columns))
        )

    @cached_property
    def nodes(self) -> tuple[Floats, Floats]:
        """Latitude and longitude (rows, columns), degrees."""
        y, x = self.axes
        lon, lat = self._to_wgs84.transform(*np.meshgrid(x, y))
        return np.asarray(lat), np.asarray(lon)

    def anomaly(self, date: str, nodes: tuple[Floats, Floats] | None = None) -> Floats:
        """|F + B| - |F| at a date, nT, at latitudes and longitudes; default at `nodes`."""
        nodes = self.nodes if nodes is None else nodes
        lat, lon, depth, size = self._rocks
        spec = replace(DEMO, epoch=date)
        inducing = core_field(spec, lat, lon, self.height_m - depth)
        moments = np.einsum("ki,kia->ka", size[:, None] * inducing, ned_axes(lat, lon))
        place = geodetic_to_ecef(lat, lon, self.height_m - depth)
        field, _ = dipole_field_geodetic(*nodes, self.height_m, place, moments)
        core = core_field(spec, *nodes, self.height_m)
        both, alone = np.linalg.norm(core + field, axis=-1), np.linalg.norm(core, axis=-1)
        return np.asarray(both - alone)

    @property
    def _to_wgs84(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)

    @cached_property
    def _rocks(self) -> tuple[Floats, ...]:
        """Latitude, longitude, depth, and moment (A m^2) per nT."""
        rng = np.random.default_rng(1)
        place = [
            rng.uniform(axis[0] - self.margin_m, axis[-1] + self.margin_m, self.sources)
            for axis in self.axes
        ]
        depth = self.spacing_m * rng.uniform(*self.cells, self.sources)
        lon, lat = self._to_wgs84.transform(*place[::-1])
        size = rng.uniform(0.3, 1.0, self.sources) * rng.choice([-1.0, 1.0], self.sources)
        return np.asarray(lat), np.asarray(lon), depth, 4e-5 * size * depth**3
