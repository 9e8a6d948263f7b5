"""Surveys of exactly known fields, taken through the whole chain to the reader.

Run as a script, it measures the tables of docs/accuracy.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from honesty import PLACES, Counts, count, fractions, places, pooled
from known import Field, Floats, relative, relative_rms
from planar import grid_convergence, planar_fft

from magtiles.catalog import open_release
from magtiles.catalog.kernels.dipole import geodetic_to_ecef
from magtiles.pipeline.build import build_product
from magtiles.pipeline.sample import DEMO, ConstantField, SampleSpec, synthesize, write_survey

Positions = tuple[Floats, Floats]

QUIET = replace(
    DEMO, depth_m=(2500.0, 12000.0), noise_nt=0.0, line_spacing_m=None, void=False, coast=False
)
"""No noise and no gaps; every source 2.5 km or deeper under a grid of 1 km."""

LEVELS = (1000.0, 5000.0)
LIMITS = {1000.0: {"total": 0.003, "vector": 0.10, "tensor": 0.03},
          5000.0: {"total": 0.03, "vector": 0.25, "tensor": 0.08}}  # fmt: skip
"""Of the relative rms error, by gain in metres."""
YARDSTICK = 1.25
"""How many times the error of a plain planar FFT."""

BETWEEN = {1500.0: (1000.0, 2000.0), 3000.0: (2000.0, 4000.0)}
"""Gains between levels a factor of two apart, and the levels around."""

INSIDE_M = 20e3


def quiet(name: str, crs: str, latitude: float, longitude: float, **changes: Any) -> SampleSpec:
    """A noise-free survey somewhere."""
    levels = tuple(QUIET.height_m + gain for gain in LEVELS)
    place = {"crs": crs, "latitude": latitude, "longitude": longitude}
    return replace(QUIET, name=name, levels_m=levels, **place, **changes)


CASES = (
    quiet("declination-17", "EPSG:32610", 46.0, -121.5),
    quiet("inclination-60-up", "EPSG:32723", -24.0, -44.0,
          ambient=ConstantField(48000.0, -60.0, -21.0)),
    quiet("inclination-76", "EPSG:32614", 50.0, -100.0),
    quiet("southern", "EPSG:32755", -34.0, 148.0),
    quiet("two-zones-away", "EPSG:32610", 46.0, -111.0),
)  # fmt: skip


class Built:
    """A survey, the release made from it, and random nodes of it well inside the border.

    Attributes
    ----------
    sample : the survey with its truth.
    anomaly : the reader's.
    node : rows and columns of survey nodes more than `INSIDE_M` inside.
    """

    def __init__(self, spec: SampleSpec, folder: Path, nodes: int = 2000) -> None:
        self.sample = synthesize(spec)
        product = write_survey(folder / "in", self.sample)[-1]
        result = build_product(product, store=folder / "store", work=folder / "work")
        self.path = result.path
        self.anomaly = open_release(result.path).anomaly
        margin = int(np.ceil(INSIDE_M / spec.spacing_m)) + 1
        rng = np.random.default_rng(1)
        self.node = tuple(rng.integers(margin, n - margin, nodes) for n in self.sample.exact.shape)

    @property
    def at_nodes(self) -> Positions:
        """Latitude and longitude, degrees, of `node`."""
        return self.sample.latitude[self.node], self.sample.longitude[self.node]

    @property
    def off_nodes(self) -> Positions:
        """The same, each moved by up to a cell."""
        move = np.random.default_rng(2).uniform(-1.0, 1.0, (2, self.node[0].size))
        cells = self.sample.exact.shape
        latitude, longitude = self.at_nodes
        return (
            latitude + move[0] * np.ptp(self.sample.latitude) / cells[0],
            longitude + move[1] * np.ptp(self.sample.longitude) / cells[1],
        )

    def place(self, gain: float, positions: Positions) -> tuple[Floats, Floats, float]:
        return (*positions, self.sample.spec.height_m + gain)

    def truth(self, gain: float, positions: Positions) -> Field:
        return Field(*self.sample.truth(*self.place(gain, positions)))

    def answer(self, gain: float, positions: Positions) -> Field:
        place = self.place(gain, positions)
        ask = self.anomaly
        return Field(ask.total(*place), ask.vector(*place), ask.tensor(*place))

    def errors(self, gain: float, positions: Positions) -> dict[str, Floats]:
        """Relative rms error of every component."""
        return relative_rms(self.answer(gain, positions), self.truth(gain, positions))

    def planar_errors(self, gain: float) -> dict[str, Floats]:
        """The yardstick's, at the nodes: ambient direction the map's mean."""
        sample, spec = self.sample, self.sample.spec
        ambient = sample.ambient(sample.latitude, sample.longitude, spec.height_m)
        north, east, down = ambient.mean(axis=(0, 1))
        found = planar_fft(
            sample.exact,
            spec.spacing_m,
            gain,
            inclination=float(np.degrees(np.arctan2(down, np.hypot(north, east)))),
            declination=float(np.degrees(np.arctan2(east, north))),
            convergence=grid_convergence(spec.crs, sample.x, sample.y),
        )
        at_nodes = Field(*(values[self.node] for values in found))
        return relative_rms(at_nodes, self.truth(gain, self.at_nodes))

    def gradient_errors(self, gain: float) -> dict[str, Floats]:
        """Relative rms error of gradients north, east, down: of the total, and of the vector."""
        positions = self.off_nodes
        place = self.place(gain, positions)
        _, of_total = self.anomaly.total_with_gradient(*place)
        _, of_vector = self.anomaly.vector_with_gradient(*place)
        tensor = full_tensor(self.truth(gain, positions).tensor)
        return {
            "total": relative(of_total, self.true_total_gradient(gain, positions)),
            "vector": relative(of_vector.reshape(-1, 9), tensor.reshape(-1, 9)),
        }

    def true_total_gradient(self, gain: float, positions: Positions) -> Floats:
        """Of the exact |F + B| - |F|, by differences over 40 m, nT/km."""
        latitude, longitude, height = self.place(gain, positions)
        metre = 1.0 / 111_000.0
        columns = []
        for move in ((metre, 0.0, 0.0), (0.0, metre, 0.0), (0.0, 0.0, -1.0)):
            ends = [
                (latitude + s * move[0], longitude + s * move[1], height + s * move[2])
                for s in (-20.0, 20.0)
            ]
            low, high = (self.sample.truth(*end)[0] for end in ends)
            metres = np.linalg.norm(
                geodetic_to_ecef(*ends[1]) - geodetic_to_ecef(*ends[0]), axis=-1
            )
            columns.append(1e3 * (high - low) / metres)
        return np.stack(columns, axis=-1)

    def coverage(self, gains: Iterable[float]) -> Counts:
        """Errors inside the stated sigma, as the reader answers, at every survey node."""
        counts: Counts = {}
        for gain in gains:
            positions = self.sample.latitude, self.sample.longitude
            place = self.place(gain, positions)
            where = places(self.sample, self.anomaly.flags(*place))
            answer, truth = self.answer(gain, positions), self.truth(gain, positions)
            pairs = zip(answer, truth, strict=True)
            error = Field(*(f - t for (_, f), (_, t) in pairs))
            names = ("total", "vector", "tensor")
            sigma = Field(*(self.anomaly.uncertainty(*place, quantity=n) for n in names))
            count(counts, gain, where, error, sigma)
        return counts


def full_tensor(five: Floats) -> Floats:
    """(..., 3, 3) of (..., 5): nn, ne, nd, ee, ed."""
    nn, ne, nd, ee, ed = np.moveaxis(five, -1, 0)
    rows = [[nn, ne, nd], [ne, ee, ed], [nd, ed, -(nn + ee)]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def print_accuracy() -> None:
    """Worst component of each quantity, per cent: ours, the yardstick's, greatest ratio."""
    print("| case | km up | quantity | this | planar FFT | worst ratio | limit |")
    print("|---|---|---|---|---|---|---|")
    for spec in CASES:
        with tempfile.TemporaryDirectory() as folder:
            built = Built(spec, Path(folder))
            for gain in LEVELS:
                ours, plain = built.errors(gain, built.at_nodes), built.planar_errors(gain)
                for quantity, limit in LIMITS[gain].items():
                    o, p = 100 * ours[quantity], 100 * plain[quantity]
                    print(
                        f"| {spec.name} | {gain / 1e3:g} | {quantity} | {o.max():.2f} % | "
                        f"{p.max():.2f} % | {(o / p).max():.2f} | {100 * limit:g} % |"
                    )


def print_coverage(counts: Counts) -> None:
    """Per cent of errors inside one sigma."""
    found = fractions(counts)
    gains = sorted({gain for gain, _, _ in found})
    print("\n| quantity | place |", " | ".join(f"{g / 1e3:g} km" for g in gains), "|")
    print("|---|---|" + "---|" * len(gains))
    for quantity in LIMITS[1000.0]:
        for place in PLACES:
            row = [f"{100 * found[g, quantity, place]:.0f} %" for g in gains]
            print(f"| {quantity} | {place} |", " | ".join(row), "|")


def main() -> None:
    print_accuracy()
    gains = (0.0, 1000.0, 2000.0, 4000.0, 8000.0)
    with tempfile.TemporaryDirectory() as folder:
        print_coverage(Built(DEMO, Path(folder)).coverage(gains))
    print_coverage(pooled(range(1, 25), gains))


if __name__ == "__main__":
    main()
