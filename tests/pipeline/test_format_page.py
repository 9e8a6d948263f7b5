"""A second reader, written from docs/format.md alone, answers checks.json as the page says.

It shares nothing with the package: the standard library, NumPy, SciPy's splines and pyproj's
ellipsoid. What the page leaves out or gets wrong makes it disagree.
"""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pyproj
from scipy.interpolate import BSpline
from scipy.linalg import solve_banded

HALO = 12
TENSOR = ("nn", "ne", "nd", "ee", "ed")
MEMBERS = {
    "total": ["magnetic_anomaly"],
    "vector": ["anomaly_north", "anomaly_east", "anomaly_down"],
    "tensor": [f"gradient_{pair}" for pair in TENSOR],
}


def metres_per_degree(latitude: float, height: float) -> tuple[float, float]:
    """Degrees north and east in metres, by PROJ: a short step in ECEF."""
    to_ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    step = 1e-3
    longitudes, latitudes = [-step, step, 0.0, 0.0], [latitude, latitude]
    latitudes += [latitude - step, latitude + step]
    x, y, z = to_ecef.transform(longitudes, latitudes, [height] * 4)
    points = np.stack([x, y, z], axis=-1)
    east, north = (float(np.linalg.norm(points[i + 1] - points[i])) for i in (0, 2))
    return north / (2 * step), east / (2 * step)


def coefficients(values: np.ndarray) -> np.ndarray:
    """(c[i-1] + 4 c[i] + c[i+1]) / 6 = v[i] along both axes, c = v at the ends."""
    for axis in (0, 1):
        n = values.shape[axis]
        bands = np.zeros((3, n))
        bands[0, 2:], bands[1], bands[2, :-2] = 1 / 6, 4 / 6, 1 / 6
        bands[1, [0, -1]] = 1.0
        moved = np.moveaxis(values, axis, 0)
        solved = solve_banded((1, 1), bands, moved.reshape(n, -1)).reshape(moved.shape)
        values = np.moveaxis(solved, 0, axis)
    return values


_B = BSpline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
_DB = _B.derivative()


def spline(values: np.ndarray, y: float, x: float) -> np.ndarray:
    """Value and derivatives along y and x (cells) of splines (rows, columns, channels)."""
    c = coefficients(values)
    rows, columns = (np.arange(n) for n in c.shape[:2])

    def part(along_y: Any, along_x: Any) -> np.ndarray:
        weights = np.nan_to_num(along_y(y - rows)), np.nan_to_num(along_x(x - columns))
        return np.einsum("i,j,ijc->c", *weights, c)

    return np.stack([part(_B, _B), part(_DB, _B), part(_B, _DB)])


def seven_point(values: np.ndarray, axis: int) -> np.ndarray:
    """Derivative per node of the polynomial through seven nodes."""
    f = np.moveaxis(values, axis, 0)
    out = np.empty_like(f)
    for i in range(len(f)):
        first = min(max(i - 3, 0), len(f) - 7)
        nodes = np.arange(first, first + 7) - i
        powers = np.vander(nodes, increasing=True).T.astype(float)
        weights = np.linalg.solve(powers, np.eye(7)[1])
        out[i] = np.tensordot(weights, f[first : first + 7], 1)
    return np.moveaxis(out, 0, axis)


class Reader:
    """One release of ellipsoidal heights."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.manifest = json.loads((folder / "manifest.json").read_text("utf-8"))
        self.lattice = self.manifest["lattice"]
        self.levels = self.manifest["heights_m"]
        self.tile = cache(self._tile)
        self.planes = cache(self._planes)

    def canonical_digest(self) -> str:
        rest = {k: v for k, v in self.manifest.items() if k != "manifest_digest"}
        text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()

    def _tile(self, row: int, column: int) -> dict[str, np.ndarray]:
        (record,) = (
            f for f in self.manifest["files"] if (f.get("row"), f.get("column")) == (row, column)
        )
        data = (self.folder / record["path"]).read_bytes()
        assert (len(data), hashlib.sha256(data).hexdigest()) == (record["size"], record["sha256"])
        with netCDF4.Dataset(self.folder / record["path"]) as file:
            file.set_auto_maskandscale(False)
            arrays = {name: v[...] for name, v in file.variables.items()}
        digest = hashlib.sha256()
        for name in sorted(arrays):
            a = np.asarray(arrays[name])
            line = json.dumps([name, a.dtype.name, list(a.shape)], separators=(",", ":"))
            digest.update(line.encode() + b"\n")
            digest.update(a.astype(a.dtype.newbyteorder("<")).tobytes())
        assert digest.hexdigest() == record["array_digest"]
        return arrays

    def _planes(self, row: int, column: int, level: int, family: str) -> np.ndarray:
        """F, F', F'' at the nodes, (rows, columns, 3, components)."""
        tile, lattice = self.tile(row, column), self.lattice
        g = {p: tile[f"gradient_{p}"][level].astype(float) / 1000 for p in TENSOR}
        metres = [metres_per_degree(phi, self.levels[level]) for phi in tile["latitude"]]
        north, east = np.array(metres).T[:, :, None]

        def d_n(f: np.ndarray) -> np.ndarray:
            return seven_point(f, 0) / (north * lattice["latitude_spacing"])

        def d_e(f: np.ndarray) -> np.ndarray:
            return seven_point(f, 1) / (east * lattice["longitude_spacing"])

        trace = g["nn"] + g["ee"]
        a, b, c = d_n(trace), d_e(trace), d_n(g["nd"]) + d_e(g["ed"])
        if family == "tensor":
            first = [-d_n(g["nd"]), -d_n(g["ed"]), a, -d_e(g["ed"]), b]
            second = [-d_n(a), -d_n(b), -d_n(c), -d_e(b), -d_e(c)]
            first, second = ([1000 * f for f in fs] for fs in (first, second))
        else:
            first, second = [-g["nd"], -g["ed"], trace], [-a, -b, -c]
        if family == "total":
            f = [tile[f"ambient_{axis}"] for axis in ("north", "east", "down")]
            first, second = ([sum(map(np.multiply, f, fs))] for fs in (first, second))
        values = [tile[name][level] for name in MEMBERS[family]]
        return np.stack([np.stack(o, axis=-1) for o in (values, first, second)], axis=2)

    def answer(self, latitude: float, longitude: float, height: float, family: str) -> Any:
        """Value (components,) and gradient (components, 3) per km, or None without coverage."""
        lattice = self.lattice
        y = (latitude - lattice["south"]) / lattice["latitude_spacing"]
        x = (longitude - lattice["west"]) % 360.0 / lattice["longitude_spacing"]
        i, j = min(int(y), lattice["rows"] - 1), min(int(x), lattice["columns"] - 1)
        row, column = i // lattice["tile_rows"], j // lattice["tile_columns"]
        at = y - row * lattice["tile_rows"] + HALO, x - column * lattice["tile_columns"] + HALO
        k = int(np.searchsorted(self.levels, height, "right")) - 1
        between = height > self.levels[k]
        used = [k, k + 1] if between else [k]
        near = [np.unique([np.floor(v + 1e-9), np.ceil(v - 1e-9)]).astype(int) for v in at]
        flags = np.array([self.tile(row, column)["quality_flag"][m][np.ix_(*near)] for m in used])
        if (flags & 2).any():
            return None
        parts = []
        for level in used:
            planes = self.planes(row, column, level, family)
            flat = spline(planes.reshape(*planes.shape[:2], -1), *at)
            parts.append(flat.reshape(3, 3, -1))
        value, slope = self.hermite(parts, k, height)
        north, east = metres_per_degree(latitude, height)
        metres = north * lattice["latitude_spacing"], east * lattice["longitude_spacing"]
        gradient = [value[1] / metres[0], value[2] / metres[1], -slope]
        return value[0], 1000 * np.stack(gradient, axis=-1)

    def hermite(self, parts: list[np.ndarray], k: int, height: float) -> tuple[Any, Any]:
        """The quintic and its derivative with height; parts (3 splines, 3 orders, components)."""
        if len(parts) == 1:
            return parts[0][:, 0], parts[0][0, 1]
        gap = self.levels[k + 1] - self.levels[k]
        lower = [[1, 0, 0, -10, 15, -6], [0, 1, 0, -6, 8, -3], [0, 0, 0.5, -1.5, 1.5, -0.5]]
        upper = [[0, 0, 0, 10, -15, 6], [0, 0, 0, -4, 7, -3], [0, 0, 0, 0.5, -1, 0.5]]
        polynomials = [np.polynomial.Polynomial(b, (0, 1), (0, 1)) for b in [*lower, *upper]]
        t = (height - self.levels[k]) / gap
        scale = np.array([1.0, gap, gap**2] * 2)
        terms = np.concatenate(parts, axis=1)
        value = np.einsum("o,soc->sc", scale * [p(t) for p in polynomials], terms)
        slope = np.einsum("o,oc->c", scale * [p.deriv()(t) for p in polynomials], terms[0])
        return value, slope / gap


def test_the_page_is_enough_to_write_a_reader(exact_release: Path) -> None:
    """Greatest miss over 135 answers: 4.8e-10, the ten digits that checks.json holds."""
    reader = Reader(exact_release)
    assert reader.canonical_digest() == reader.manifest["manifest_digest"]
    checks = json.loads((exact_release / "checks.json").read_text("utf-8"))
    expected, positions = checks["expected"], checks["positions"]
    answered, worst = 0, 0.0
    places = zip(positions["latitude"], positions["longitude"], positions["height"], strict=True)
    for n, place in enumerate(places):
        for family in MEMBERS:
            found = reader.answer(*place, family)
            wanted = np.array(expected[family][n], dtype=float)
            if found is None:
                assert np.isnan(wanted).all()
                continue
            answered += 1
            pairs = [(found[0], wanted)]
            if family != "tensor":
                pairs.append((found[1], np.array(expected[f"{family}_gradient"][n], dtype=float)))
            for mine, theirs in pairs:
                miss = np.abs(mine.reshape(theirs.shape) - theirs)
                worst = max(worst, float((miss / np.maximum(1.0, np.abs(theirs))).max()))
    assert answered > 50
    assert worst < 1e-9 < checks["tolerance"]
