"""The manifest of a release (release-manifest/1), parsed into frozen dataclasses.

A manifest comes from outside: every field is checked for type and range before use, paths
can only name files inside the release, and sizes are capped.
"""

from __future__ import annotations

import itertools
import posixpath
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.digest import manifest_digest
from magtiles.catalog.releases.fields import REMEDY, Fields, parse_json
from magtiles.catalog.releases.folder import read_bytes
from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.road_table import PATH as ROAD_PATH
from magtiles.catalog.releases.temporal_table import PATH as TEMPORAL_PATH
from magtiles.catalog.releases.tile_table import TILE_VARIABLES
from magtiles.schemas.errors import IntegrityError

CONTRACT = "release-manifest/1.0.0"
MANIFEST_NAME = "manifest.json"
SIGNATURE_NAME = "manifest.json.minisig"
UNLISTED = frozenset({MANIFEST_NAME, SIGNATURE_NAME})
"""Files of a release that its manifest does not list; the signature may be missing."""
ROLES = ("tile", "temporal", "road", "checks", "provenance", "preview", "core_field")
HEIGHT_REFERENCES = ("ellipsoid", "mean_sea_level", "terrain")

MAX_MANIFEST_BYTES = 256 << 20
MAX_FILE_BYTES = 4 << 30
MAX_LEVELS = 64
MAX_TILE_NODES = 1 << 24
"""Nodes of one level of one tile."""

NAME = r"[a-z0-9][a-z0-9._-]{0,63}"
VERSION = r"(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})"
_SHA256 = r"[0-9a-f]{64}"
_SEGMENT = r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}"
_PATH = rf"{_SEGMENT}(/{_SEGMENT}){{0,3}}"
_STATISTICS = ("minimum", "maximum", "mean", "rms")


@dataclass(frozen=True)
class FileRecord:
    """One file of a release: path relative to its folder, size in bytes, sha256, contract."""

    path: str
    size: int
    sha256: str
    role: str
    contract: str | None


@dataclass(frozen=True)
class TileRecord(FileRecord):
    """A tile: its place, the digest of its arrays, and what it holds.

    Attributes
    ----------
    row, column : place, counted from the south-west.
    bounds : south and north, west and east of the core.
    statistics : variable to minimum, maximum, mean and rms over the core, one each per level.
    flag_fractions : meaning of a flag to the share of core nodes, all levels, that carry it.
    """

    array_digest: str
    row: int
    column: int
    bounds: Mapping[str, tuple[float, float]]
    statistics: Mapping[str, Mapping[str, tuple[float, ...]]]
    flag_fractions: Mapping[str, float]


@dataclass(frozen=True)
class TemporalRecord(FileRecord):
    """The temporal model, and the digest of its arrays."""

    array_digest: str


@dataclass(frozen=True)
class RoadRecord(FileRecord):
    """A road map: the digest of its arrays, where it lies, its length and spacing in metres."""

    array_digest: str
    bounds: Mapping[str, tuple[float, float]]
    length_m: float
    spacing_m: float

    @property
    def name(self) -> str:
        """What the reader knows it by: the name of its file."""
        return posixpath.basename(self.path).removesuffix(".nc")


@dataclass(frozen=True)
class InputRecord:
    """A source the release was made from."""

    id: str
    sha256: str
    licence: str
    role: str


@dataclass(frozen=True)
class Manifest:
    """What a release says of itself; `document` is the JSON it was read from."""

    product: str
    version: str
    magtiles: str
    created: str | None
    identity: Mapping[str, Any]
    lattice: Lattice
    heights_m: tuple[float, ...]
    height_reference: str
    files: tuple[FileRecord, ...]
    inputs: tuple[InputRecord, ...]
    manifest_digest: str
    document: Mapping[str, Any]

    @cached_property
    def tiles(self) -> Mapping[tuple[int, int], TileRecord]:
        """Tiles by row and column."""
        return {(f.row, f.column): f for f in self.files if isinstance(f, TileRecord)}

    @cached_property
    def temporal(self) -> TemporalRecord | None:
        """The temporal model's record; None where the release has none."""
        return next((f for f in self.files if isinstance(f, TemporalRecord)), None)

    @cached_property
    def roads(self) -> Mapping[str, RoadRecord]:
        """Road maps by name."""
        return {f.name: f for f in self.files if isinstance(f, RoadRecord)}

    @cached_property
    def has_reference_surface(self) -> bool:
        """Whether the tiles say how high the surface is that heights count from."""
        return any("reference_surface_height" in t.statistics for t in self.tiles.values())

    @property
    def takes_ellipsoidal_height(self) -> bool:
        """Whether queries give height above the ellipsoid, or above the reference surface."""
        return self.height_reference == "ellipsoid" or self.has_reference_surface


def read_manifest(folder: Path) -> Manifest:
    """Read and check `folder`/manifest.json. Raises IntegrityError."""
    where = folder / MANIFEST_NAME
    return parse_manifest(read_bytes(where, limit=MAX_MANIFEST_BYTES), where)


def parse_manifest(data: bytes, where: object = MANIFEST_NAME) -> Manifest:
    """Parse a manifest's bytes, checking each field and its own digest."""
    top = parse_json(data, where)
    contract = top.text("contract")
    if contract != CONTRACT:
        raise top.problem("contract", f"is {contract!r}", f"{CONTRACT!r}")
    digest = top.text("manifest_digest", _SHA256)
    if digest != manifest_digest(top.document):
        raise IntegrityError(
            "its digest is not that of its contents: it was edited or damaged",
            where=where,
            expected=f"manifest_digest {manifest_digest(top.document)}",
            remedy=REMEDY,
        )
    top.only(*KEYS)
    heights = top.numbers("heights_m", -12000, 1e6, (1, MAX_LEVELS))
    if any(b <= a for a, b in itertools.pairwise(heights)):
        raise top.problem("heights_m", "do not ascend", "ascending heights")
    lattice = _lattice(top.inner("lattice"))
    manifest = Manifest(
        product=top.text("product", NAME),
        version=top.text("version", VERSION),
        magtiles=top.text("magtiles"),
        created=top.text("created") if "created" in top.document else None,
        identity=_identity(top.inner("identity")),
        lattice=lattice,
        heights_m=tuple(heights),
        height_reference=top.text("height_reference", "|".join(HEIGHT_REFERENCES)),
        files=tuple(_file(f, lattice, len(heights)) for f in top.items("files", 1_000_000)),
        inputs=tuple(_input(f) for f in top.items("inputs", 10_000)),
        manifest_digest=digest,
        document=top.document,
    )
    _check_files(manifest, top)
    return manifest


KEYS = (
    "contract", "product", "version", "magtiles", "created", "identity", "lattice",
    "heights_m", "height_reference", "files", "inputs", "manifest_digest",
)  # fmt: skip


def _lattice(fields: Fields) -> Lattice:
    fields.only(*Lattice.__dataclass_fields__)
    lattice = Lattice(
        south=fields.number("south", -90, 90),
        west=fields.number("west", -360, 360),
        latitude_spacing=fields.number("latitude_spacing", 1e-7, 10),
        longitude_spacing=fields.number("longitude_spacing", 1e-7, 10),
        rows=fields.integer("rows", 1, 10**8),
        columns=fields.integer("columns", 1, 10**8),
        tile_rows=fields.integer("tile_rows", 1, 10**8),
        tile_columns=fields.integer("tile_columns", 1, 10**8),
    )
    if lattice.north > 90 or lattice.columns * lattice.longitude_spacing > 360 * (1 + 1e-12):
        raise fields.problem("", "reaches beyond the globe", "at most 90 N and 360 degrees wide")
    nodes = (lattice.tile_rows + 2 * HALO + 1) * (lattice.tile_columns + 2 * HALO + 1)
    if nodes > MAX_TILE_NODES:
        raise fields.problem("", f"makes tiles of {nodes} nodes", f"at most {MAX_TILE_NODES}")
    return lattice


def _identity(fields: Fields) -> Mapping[str, Any]:
    for key in ("reference_field", "reference_epoch", "anomaly_definition"):
        fields.text(key)
    fields.text("datum", "WGS84")
    fields.inner("units")
    return fields.plain()


def _file(fields: Fields, lattice: Lattice, levels: int) -> FileRecord:
    role = fields.text("role", "|".join(ROLES))
    base: dict[str, Any] = {
        "path": fields.text("path", _PATH),
        "size": fields.integer("size", 0, MAX_FILE_BYTES),
        "sha256": fields.text("sha256", _SHA256),
        "role": role,
        "contract": None if fields.plain().get("contract") is None else fields.text("contract"),
    }
    if role == "temporal":
        fields.only(*TemporalRecord.__dataclass_fields__)
        return TemporalRecord(**base, array_digest=fields.text("array_digest", _SHA256))
    if role == "road":
        fields.only(*RoadRecord.__dataclass_fields__)
        return RoadRecord(
            **base,
            array_digest=fields.text("array_digest", _SHA256),
            bounds=_bounds(fields.inner("bounds")),
            length_m=fields.number("length_m", 0, 1e9),
            spacing_m=fields.number("spacing_m", 1e-3, 1e6),
        )
    if role != "tile":
        fields.only(*base)
        return FileRecord(**base)
    fields.only(*TileRecord.__dataclass_fields__)
    row = fields.integer("row", 0, lattice.shape[0] - 1)
    column = fields.integer("column", 0, lattice.shape[1] - 1)
    return TileRecord(
        **base,
        array_digest=fields.text("array_digest", _SHA256),
        row=row,
        column=column,
        bounds=_bounds(fields.inner("bounds")),
        statistics=_statistics(fields.inner("statistics"), levels),
        flag_fractions=_fractions(fields.inner("flag_fractions")),
    )


def _bounds(fields: Fields) -> Mapping[str, tuple[float, float]]:
    south, north = fields.numbers("latitude", -90, 90, (2, 2))
    west, east = fields.numbers("longitude", -720, 720, (2, 2))
    return {"latitude": (south, north), "longitude": (west, east)}


def _statistics(fields: Fields, levels: int) -> Mapping[str, Mapping[str, tuple[float, ...]]]:
    fields.only(*TILE_VARIABLES)
    found: dict[str, dict[str, tuple[float, ...]]] = {}
    for name in fields.plain():
        inner = fields.inner(name)
        found[name] = {
            key: tuple(inner.numbers(key, -1e38, 1e38, (1, levels))) for key in _STATISTICS
        }
    return found


def _fractions(fields: Fields) -> Mapping[str, float]:
    return {key: fields.number(key, 0, 1) for key in fields.plain()}


def _input(fields: Fields) -> InputRecord:
    fields.only("id", "sha256", "licence", "role")
    return InputRecord(
        id=fields.text("id"),
        sha256=fields.text("sha256", _SHA256),
        licence=fields.text("licence"),
        role=fields.text("role"),
    )


def _check_files(manifest: Manifest, top: Fields) -> None:
    paths = [file.path for file in manifest.files]
    if len({path.lower() for path in paths}) != len(paths):
        raise top.problem("files", "name a path twice", "each path once")
    if any(path != posixpath.normpath(path) or path in UNLISTED for path in paths):
        raise top.problem("files", "hold an unsafe path", "plain paths inside the release")
    if any((file.role == "temporal") != (file.path == TEMPORAL_PATH) for file in manifest.files):
        raise top.problem("files", "have a temporal model elsewhere", f"it at {TEMPORAL_PATH}")
    if any((f.role == "road") != bool(re.fullmatch(ROAD_PATH, f.path)) for f in manifest.files):
        raise top.problem("files", "have a road map elsewhere", "them at roads/<name>.nc")
    if any(path.split("/")[0] in paths for path in paths if "/" in path):
        raise top.problem("files", "use a file as a folder", "plain paths inside the release")
    rows, columns = manifest.lattice.shape
    count = sum(isinstance(file, TileRecord) for file in manifest.files)
    if count != len(manifest.tiles) or count != rows * columns:
        raise top.problem(
            "files", f"list {count} tiles, {len(manifest.tiles)} places",
            f"one tile for each of {rows} x {columns} places",
        )  # fmt: skip
    surfaces = {"reference_surface_height" in t.statistics for t in manifest.tiles.values()}
    if len(surfaces) > 1:
        raise top.problem("files", "have reference_surface_height only in part", "all or none")
