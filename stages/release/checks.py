"""checks.json: positions with expected answers, so that any reader can test itself."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.releases.fields import Fields, parse_json
from magtiles.catalog.releases.manifest import Manifest
from magtiles.catalog.releases.reader import Release, open_release
from magtiles.schemas.errors import IntegrityError
from magtiles.stages.release import checks_roads, checks_temporal

Arrays = dict[str, NDArray[Any]]
Question = tuple[Path, Arrays]
Spread = Callable[[Callable[[Question], Arrays], Sequence[Question]], Iterable[Arrays]]
"""As `map`: applies a function of a module, in other processes for example."""

CHECKS_NAME = "checks.json"
FORMAT = "release-checks/1.0.0"
TOLERANCE = 1e-6
"""Relative to 1 nT, 1 nT/km or the answer, whichever is larger."""

_POINTS_PER_TILE = 24
_TILES = 4
_UNITS = {
    "total": "nT",
    "total_gradient": "nT km-1",
    "vector": "nT",
    "vector_gradient": "nT km-1",
    "tensor": "nT km-1",
    "uncertainty_total": "nT",
    "uncertainty_vector": "nT",
    "uncertainty_tensor": "nT km-1",
}


def make_checks(release: Release, spread: Spread | None = None) -> dict[str, Any]:
    """Positions in and around several tiles, and what the reader answers there.

    Positions spread over each tile's core (on and between levels) and lie on seams to
    both sides. An expected null is NaN: no coverage. Others may answer, through `spread`.
    """
    latitude, longitude, height = _positions(release.manifest)
    height_name = "height"
    if not release.manifest.takes_ellipsoidal_height:
        height_name = "height_above_reference"
    elif release.manifest.has_reference_surface:
        height = height + release.anomaly.reference_surface(latitude, longitude)
    positions = {"latitude": latitude, "longitude": longitude, height_name: height}
    document: dict[str, Any] = {
        "format": FORMAT,
        "tolerance": TOLERANCE,
        "units": _UNITS,
        "positions": {name: values.tolist() for name, values in positions.items()},
        "expected": {name: _plain(v) for name, v in _answers(release, positions, spread).items()},
    }
    if release.manifest.temporal is not None:
        at = checks_temporal.temporal_positions(release)
        answers = checks_temporal.temporal_answers(release, at)
        document["temporal"] = _section(checks_temporal.UNITS, at, answers)
    if release.manifest.roads:
        document["roads"] = {}
    for name in sorted(release.manifest.roads):
        at = checks_roads.road_positions(release, name)
        answers = checks_roads.road_answers(release, name, at)
        document["roads"][name] = _section(checks_roads.UNITS, at, answers)
    return document


def _section(units: Mapping[str, str], at: Arrays, answers: Arrays) -> dict[str, Any]:
    return {
        "units": dict(units),
        "positions": {name: _plain(values) for name, values in at.items()},
        "expected": {name: _plain(values) for name, values in answers.items()},
    }


def replay_checks(release: Release, spread: Spread | None = None) -> float:
    """Ask the release its own checks; the largest error relative to the tolerance.

    Others may answer, through `spread`, as in `make_checks`. Raises IntegrityError naming the
    first answer that is off.
    """
    where = release.path / CHECKS_NAME
    document = parse_json(release.file(CHECKS_NAME), where)
    worst = _replay(document, lambda at: _answers(release, at, spread), where)
    if release.manifest.temporal is not None:
        temporal = document.inner("temporal")
        ask = partial(checks_temporal.temporal_answers, release)
        worst = max(worst, _replay(temporal, ask, where))
    for name in sorted(release.manifest.roads):
        road = document.inner("roads").inner(name)
        ask = partial(checks_roads.road_answers, release, name)
        worst = max(worst, _replay(road, ask, where))
    return worst


def _replay(
    section: Fields, ask: Callable[[Mapping[str, NDArray[Any]]], Arrays], where: object
) -> float:
    """The largest error of the answers to one section of checks."""
    answers = ask(_arrays(section.inner("positions").plain(), where))
    expected = _arrays(section.inner("expected").plain(), where)
    worst = 0.0
    for name, wanted in expected.items():
        if name not in answers or answers[name].shape != wanted.shape:
            raise IntegrityError(f"has no answers of the shape of {name}", where=where)
        error = np.abs(answers[name] - wanted) / np.maximum(1.0, np.abs(wanted)) / TOLERANCE
        error = np.where(np.isnan(answers[name]) & np.isnan(wanted), 0.0, error)
        if not np.all(error <= 1.0):
            first = int(np.argmax(~(error <= 1.0).reshape(len(wanted), -1).all(axis=1)))
            raise IntegrityError(
                f"{name}[{first}] is {answers[name][first]}",
                where=where,
                expected=f"{wanted[first]}",
                remedy="the reader and the release disagree: rebuild with this version",
            )
        worst = max(worst, float(error.max(initial=0.0)))
    return worst


def _answers(release: Release, at: Mapping[str, NDArray[Any]], spread: Spread | None) -> Arrays:
    """What the anomaly is at positions, which are in order of tiles: a part asks few of them."""
    if spread is None:
        return _anomaly_answers(release, at)
    folder = release.path.absolute()  # who answers may be elsewhere
    parts = np.array_split(np.arange(len(at["latitude"])), _TILES)
    asked = [(folder, {name: np.asarray(v)[part] for name, v in at.items()}) for part in parts]
    found = list(spread(_answer, asked))
    return {name: np.concatenate([part[name] for part in found]) for name in found[0]}


def _answer(question: Question) -> Arrays:
    return _anomaly_answers(open_release(question[0]), question[1])


def _anomaly_answers(release: Release, at: Mapping[str, NDArray[Any]]) -> Arrays:
    an = release.anomaly
    total, total_gradient = an.total_with_gradient(**at)
    vector, vector_gradient = an.vector_with_gradient(**at)
    answers: Arrays = {
        "total": total,
        "total_gradient": total_gradient,
        "vector": vector,
        "vector_gradient": vector_gradient,
        "tensor": an.tensor(**at),
        "flags": an.flags(**at),
    }
    for quantity in ("total", "vector", "tensor"):
        answers[f"uncertainty_{quantity}"] = an.uncertainty(**at, quantity=quantity)
    return answers


def _positions(manifest: Manifest) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Points of a low-discrepancy sequence in a few tiles, every fourth on a seam."""
    lattice, levels = manifest.lattice, np.array(manifest.heights_m)
    places = sorted(manifest.tiles)
    chosen = [places[i] for i in np.unique(np.linspace(0, len(places) - 1, _TILES).astype(int))]
    # Roberts' additive sequence in three dimensions: the plastic number's sister, 1.2207...
    steps = np.arange(1, _POINTS_PER_TILE * len(chosen) + 1)
    u, v, w = ((0.5 + steps * 1.2207440846057596**-k) % 1.0 for k in (1, 2, 3))
    row, column = np.repeat(np.array(chosen), _POINTS_PER_TILE, axis=0).T
    core = np.array([lattice.core(*place) for place in chosen]).repeat(_POINTS_PER_TILE, axis=0)
    u[::4] = np.where(steps[::4] % 8 == 1, 0.0, 1e-9)
    y = np.minimum(row * lattice.tile_rows + u * core[:, 0], lattice.rows)
    x = np.minimum(column * lattice.tile_columns + v * core[:, 1], lattice.columns)
    height = np.interp(w * (len(levels) - 1), np.arange(len(levels)), levels)
    height[::3] = levels[steps[::3] % len(levels)]
    longitude = (lattice.west + x * lattice.longitude_spacing + 180.0) % 360.0 - 180.0
    return lattice.south + y * lattice.latitude_spacing, longitude, height


def _plain(values: NDArray[Any]) -> list[Any]:
    """Nested lists with ten significant digits, and None for NaN."""
    flat = [
        None if value != value else float(f"{value:.10g}") if values.dtype.kind == "f" else value
        for value in values.ravel().tolist()
    ]
    nested = np.array(flat, dtype=object).reshape(values.shape)
    plain: list[Any] = nested.tolist()
    return plain


def _arrays(lists: Mapping[str, Any], where: object) -> dict[str, NDArray[Any]]:
    try:
        return {name: np.array(values, dtype=np.float64) for name, values in lists.items()}
    except (TypeError, ValueError) as caught:
        raise IntegrityError(f"holds no arrays: {caught}", where=where) from None
