"""Checking a published release from outside: every promise of its manifest and its physics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog import Release, open_release
from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.digest import array_digest
from magtiles.catalog.releases.folder import check_folder, read_bytes, read_verified
from magtiles.catalog.releases.manifest import (
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    SIGNATURE_NAME,
    UNLISTED,
    Manifest,
    TileRecord,
    read_manifest,
)
from magtiles.catalog.releases.signature import PublicKey, check_signature, read_public_key
from magtiles.catalog.releases.store import read_tile
from magtiles.catalog.releases.tile import TileData
from magtiles.catalog.releases.tile_table import LEVELS, UNITS
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.overlaps import Overlaps
from magtiles.pipeline.physics import GradientSums, add_gradients, projection_excess
from magtiles.pipeline.road_checks import check_roads
from magtiles.pipeline.temporal_checks import Finding, check_temporal
from magtiles.schemas import contracts
from magtiles.schemas.errors import MagtilesError
from magtiles.stages.ingest.hdf5_checks import check_hdf5
from magtiles.stages.release.checks import CHECKS_NAME, TOLERANCE, replay_checks
from magtiles.stages.release.records import IDENTITY_ATTRIBUTES, MeasuredTile, measure_tile

GRADIENT_TOLERANCE = 0.01
"""Of the rms gradient, beyond what the difference scheme itself loses."""
PROJECTION_TOLERANCE_NT = 0.01

_KNOWN_FLAGS = int(sum(QualityFlag))
_UNCERTAINTIES = ("magnetic_anomaly_uncertainty", "vector_uncertainty", "tensor_uncertainty")


@dataclass(frozen=True)
class Check:
    """One named check; `measured` is compared with `bound`, None where nothing was measured."""

    name: str
    passed: bool
    measured: float | None
    bound: float | None
    unit: str
    where: str


def validate_release(
    folder: Path, *, public_key: Path | None = None, require_signature: bool = False
) -> list[Check]:
    """Run every check on a release; what cannot be read makes checks fail, not stop.

    With a public key its signature is checked, which may be missing unless it is required.

    Returns
    -------
    list of Check
        In a fixed order; contracts and integrity first, then coverage, then physics.
    """
    try:
        manifest = read_manifest(folder)
    except MagtilesError as problem:
        return [Check("manifest", False, None, None, "", str(problem))]
    checks = [_attempt("manifest", lambda: _check_manifest(manifest))]
    if public_key is not None:
        key = read_public_key(public_key)
        checks.append(
            _attempt("signature", lambda: _check_signature(folder, key, require_signature))
        )
    checks.append(_attempt("files", lambda: _check_files(folder, manifest)))
    checks.append(_check_digests(folder, manifest))
    checks.append(_check_contained(folder, manifest))
    if not checks[-1].passed:  # such a file can crash its reader
        return checks
    checks.append(_check_units(manifest))
    checks += _check_tiles(folder, manifest)
    if manifest.temporal is not None:
        checks += _findings(folder, "temporal contract", check_temporal)
    if manifest.roads:
        checks += _findings(folder, "road contracts", check_roads)
    checks.append(_check_answers(folder))
    return checks


def _attempt(name: str, check: Callable[[], str]) -> Check:
    try:
        return Check(name, True, None, None, "", check())
    except MagtilesError as problem:
        return Check(name, False, None, None, "", str(problem))


def _check_manifest(manifest: Manifest) -> str:
    contracts.check_document(dict(manifest.document), "release-manifest/1", where=MANIFEST_NAME)
    return f"keeps {contracts.resolve('release-manifest/1')}"


def _check_signature(folder: Path, key: PublicKey, required: bool) -> str:
    data = read_bytes(folder / MANIFEST_NAME, limit=MAX_MANIFEST_BYTES)
    found = check_signature(data, folder / SIGNATURE_NAME, key, required=required)
    if found is None:
        return "there is none"
    return f"by key {key.name}: {' '.join(found.trusted_comment.split())}"


def _check_files(folder: Path, manifest: Manifest) -> str:
    sizes = {file.path: file.size for file in manifest.files}
    check_folder(folder, sizes, UNLISTED)
    return f"{len(sizes)} files, none missing, none foreign"


def _check_digests(folder: Path, manifest: Manifest) -> Check:
    problems = []
    for file in manifest.files:
        try:
            read_verified(folder / file.path, size=file.size, digest=file.sha256)
        except MagtilesError as problem:
            problems.append(str(problem))
    return _counted("digests", problems, "files", f"{len(manifest.files)} files")


def _check_contained(folder: Path, manifest: Manifest) -> Check:
    problems = []
    paths = [folder / file.path for file in manifest.files if file.path.endswith(".nc")]
    for path in paths:
        try:
            check_hdf5(path, kind="netCDF-4")
        except MagtilesError as problem:
            problems.append(str(problem))
    return _counted("self-contained", problems, "files", f"{len(paths)} netCDF files")


def _check_units(manifest: Manifest) -> Check:
    stated = dict(manifest.identity["units"])
    wrong = [
        f"{name} in {stated.get(name)!r}; expected {UNITS.get(name)!r}"
        for name in sorted(stated.keys() | UNITS.keys())
        if stated.get(name) != UNITS.get(name)
    ]
    return _counted("units", wrong, "variables", f"{len(stated)} variables")


def _check_answers(folder: Path) -> Check:
    try:
        worst = replay_checks(open_release(folder))
    except MagtilesError as problem:
        return Check(CHECKS_NAME, False, None, 1.0, "of tolerance", str(problem))
    where = f"largest error of the reader's answers, relative to {TOLERANCE:g}"
    return Check(CHECKS_NAME, worst <= 1.0, worst, 1.0, "of tolerance", where)


def _findings(
    folder: Path, name: str, check: Callable[[Release], Iterator[Finding]]
) -> list[Check]:
    """Findings as checks; `name` fails when the part cannot be read at all."""
    try:
        return [Check(**vars(finding)) for finding in check(open_release(folder))]
    except MagtilesError as problem:
        return [Check(name, False, None, None, "", str(problem))]


def _counted(name: str, problems: list[str], unit: str, fine: str) -> Check:
    return _count(name, len(problems), unit, problems[0] if problems else fine)


def _check_tiles(folder: Path, manifest: Manifest) -> list[Check]:
    findings = _Findings(folder, manifest)
    for place in sorted(manifest.tiles):
        findings.add(manifest.tiles[place])
    return list(findings.checks())


class _Findings:
    """What the tiles show, one after the other, so that few are in memory at a time."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self._folder = folder
        self._manifest = manifest
        levels = manifest.heights_m
        self._contracts: list[str] = []
        self._arrays: list[str] = []
        self._described: list[str] = []
        self._owners: list[tuple[range, range]] = []
        self._overlaps = Overlaps()
        self._least_sigma = np.inf
        self._unknown_flags = 0
        self._gradients = [GradientSums() for _ in levels]
        self._excess: list[list[float]] = [[] for _ in levels]

    def add(self, record: TileRecord) -> None:
        try:
            tile = read_tile(self._folder, record, self._manifest)
        except MagtilesError as problem:
            self._contracts.append(str(problem))
            return
        try:
            with open_artifact(self._folder / record.path) as dataset:
                contracts.check(dataset, "anomaly-tile/1", where=record.path)
                measured = measure_tile(self._folder / record.path, dataset)
                self._described += list(_misdescribed(record, measured, self._manifest))
        except MagtilesError as problem:
            self._contracts.append(str(problem))
        found = array_digest(tile.variables)
        if found != record.array_digest:
            self._arrays.append(f"{record.path}: arrays have digest {found}")
        self._owners.append(self._owned(tile))
        self._overlaps.add(record.row, record.column, tile.variables)
        self._add_values(tile)
        for level in range(len(self._manifest.heights_m)):
            self._add_physics(tile, level)

    def _owned(self, tile: TileData) -> tuple[range, range]:
        """Rows and columns of lattice cells between the tile's outermost core nodes."""
        lattice = self._manifest.lattice
        ranges = []
        for name, origin, spacing in (
            ("latitude", lattice.south, lattice.latitude_spacing),
            ("longitude", lattice.west, lattice.longitude_spacing),
        ):
            nodes = tile.variables[name][[HALO, -HALO - 1]]
            first, last = np.rint((nodes - origin) / spacing).astype(int)
            ranges.append(range(first, last))
        return ranges[0], ranges[1]

    def _add_values(self, tile: TileData) -> None:
        least = min(float(tile.variables[name].min()) for name in _UNCERTAINTIES)
        self._least_sigma = min(self._least_sigma, least)
        flags = tile.variables["quality_flag"]
        self._unknown_flags += int(np.count_nonzero(flags & ~np.uint8(_KNOWN_FLAGS)))

    def _add_physics(self, tile: TileData, level: int) -> None:
        arrays = tile.variables
        at_level = {
            name: values[level] for name, values in arrays.items() if values.ndim == len(LEVELS)
        }
        height = self._manifest.heights_m[level]
        if "reference_surface_height" in arrays:
            height += float(arrays["reference_surface_height"].mean())
        add_gradients(
            self._gradients[level],
            at_level,
            arrays["latitude"],
            arrays["longitude"],
            height,
            HALO,
        )
        rise_km = (self._manifest.heights_m[level] - self._manifest.heights_m[0]) / 1000.0
        excess = projection_excess(at_level, arrays, HALO, rise_km)
        if excess.size:
            self._excess[level].append(float(excess.max()))

    def checks(self) -> Iterator[Check]:
        tiles = f"{len(self._manifest.tiles)} tiles"
        yield _counted("tile contracts", self._contracts, "tiles", tiles)
        yield _counted("array digests", self._arrays, "tiles", tiles)
        yield _counted("descriptions", self._described, "entries", f"of {tiles}, as measured anew")
        yield self._coverage()
        overlaps = self._overlaps
        compared = f"{overlaps.compared} values compared to the bit"
        yield _count("overlaps", overlaps.different, "values", overlaps.where or compared)
        yield Check(
            "uncertainty",
            0.0 < self._least_sigma < np.inf,
            self._least_sigma,
            0.0,
            "nT or nT/km",
            "least of total, vector and tensor; must be above",
        )
        known = " ".join(str(flag.name).lower() for flag in QualityFlag)
        yield _count("flags", self._unknown_flags, "nodes", f"with bits other than {known}")
        for height, sums in zip(self._manifest.heights_m, self._gradients, strict=True):
            yield _gradient_check(height, sums)
        for height, excess in zip(self._manifest.heights_m, self._excess, strict=True):
            yield _projection_check(height, excess)

    def _coverage(self) -> Check:
        lattice = self._manifest.lattice
        wrong = uncovered_cells(self._owners, lattice.rows, lattice.columns)
        where = f"not owned by exactly one tile, of {lattice.rows} x {lattice.columns}"
        return _count("coverage", wrong, "cells", where)


def _misdescribed(record: TileRecord, measured: MeasuredTile, manifest: Manifest) -> Iterator[str]:
    """What the manifest says of a tile, or of all tiles, and this one does not."""
    for name in IDENTITY_ATTRIBUTES:
        found = measured.attributes.get(name)
        if found != manifest.identity[name]:
            yield f"{record.path}: {name} is {found!r}; expected {manifest.identity[name]!r}"
    numbers: list[tuple[str, Any, Any]] = [
        (name, share, measured.entry["flag_fractions"].get(name, np.nan))
        for name, share in record.flag_fractions.items()
    ]
    for name, stated in record.statistics.items():
        found = measured.entry["statistics"].get(name, {})
        numbers += [(f"{k} of {name}", v, found.get(k, np.nan)) for k, v in stated.items()]
    for name, told, found in numbers:
        # Stated to six digits.
        if np.shape(told) != np.shape(found) or not np.allclose(found, told, 1e-5, 1e-9):
            yield f"{record.path}: {name} is {found}; expected {told}"


def uncovered_cells(owners: list[tuple[range, range]], rows: int, columns: int) -> int:
    """Cells of a lattice that none or several of the owners hold, or that lie outside it."""
    # Cells between two neighbouring edges share their owners, so counting those is enough.
    row_edges = np.unique([0, rows, *(e for r, _ in owners for e in (r.start, r.stop))])
    column_edges = np.unique([0, columns, *(e for _, c in owners for e in (c.start, c.stop))])
    count = np.zeros((row_edges.size - 1, column_edges.size - 1), dtype=np.int64)
    for r, c in owners:
        i = np.searchsorted(row_edges, (r.start, r.stop))
        j = np.searchsorted(column_edges, (c.start, c.stop))
        count[i[0] : i[1], j[0] : j[1]] += 1
    inside = np.outer(
        (row_edges[:-1] >= 0) & (row_edges[1:] <= rows),
        (column_edges[:-1] >= 0) & (column_edges[1:] <= columns),
    )
    cells: NDArray[Any] = np.outer(np.diff(row_edges), np.diff(column_edges))
    return int(cells[count != inside].sum())


def _count(name: str, found: int, unit: str, where: str) -> Check:
    return Check(name, found == 0, float(found), 0.0, unit, where)


def _gradient_check(height: float, sums: GradientSums) -> Check:
    name = f"gradients at {height:g} m"
    if sums.nodes == 0:
        return Check(name, True, None, None, "", "every node is beyond coverage")
    worst, residual, truncation = sums.worst()
    bound = GRADIENT_TOLERANCE + truncation
    where = f"{worst}, rms over {sums.nodes} nodes against differences of the vector"
    return Check(name, residual <= bound, residual, bound, "of rms", where)


def _projection_check(height: float, excess: list[float]) -> Check:
    name = f"f . vector at {height:g} m"
    if not excess:
        return Check(name, True, None, None, "", "no node is free of flags")
    worst = max(0.0, *excess)
    return Check(
        name,
        worst <= PROJECTION_TOLERANCE_NT,
        worst,
        PROJECTION_TOLERANCE_NT,
        "nT",
        "largest miss of the total beyond |across|^2 / 2F and the turn of f, nodes without flags",
    )
