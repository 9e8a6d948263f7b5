"""A source TOML: which files a data set has, and what those files do not say themselves."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import pydantic

from magtiles.schemas.errors import IntegrityError, SourceError
from magtiles.stages.declare import IsoDate, Params, parse_params, quantity
from magtiles.stages.ingest.raw import ELEVATION, FLUX_DENSITY, Quantity

TOTAL_FIELD_ANOMALY = "total-field anomaly: |F| minus the reference field's magnitude"


_Column = Annotated[int, pydantic.Field(ge=1)]


def _rising(band: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= band[0] < band[1]:
        raise ValueError("two wavelengths in km, the shorter first")
    return band


class GridFileParams(Params):
    """What the file of any grid does not say itself; `measures` is what its values are."""

    measures: ClassVar[Quantity]

    crs: str | None = quantity("1", default=None, doc="CRS: EPSG code, PROJ string or WKT.")
    units: str | None = quantity(
        "1",
        default=None,
        doc="Unit of the values; default nT, or m of heights, where the file does not say.",
    )
    no_data: float | None = quantity(
        "1", default=None, doc="Value that marks a void where the file does not say, as stored."
    )
    registration: Literal["pixel", "point"] | None = quantity(
        "1", default=None, doc="Whether values are for cells or for their coordinates."
    )
    band: int | None = quantity("1", default=None, ge=1, doc="Raster band, counted from 1.")
    variable: str | None = quantity("1", default=None, doc="Variable of a netCDF file.")
    member: str | None = quantity(
        "1", default=None, doc="File of a zip archive that holds several."
    )
    columns: tuple[_Column, _Column, _Column] = quantity(
        "1", default=(1, 2, 3), doc="Columns of x, y and value of a text grid, counted from 1."
    )
    allow_ballpark_datum: bool = quantity(
        "1", default=False, doc="Accept a datum whose relation to WGS84 is not known."
    )

    @property
    def all_columns(self) -> tuple[int, ...]:
        """Columns of a text grid to read: x, y, value and, where it has one, its uncertainty."""
        return self.columns


class IngestGridParams(GridFileParams):
    """The [grid] keys of a source: what an anomaly grid's file does not say itself."""

    measures = FLUX_DENSITY

    height_m: float | None = quantity("m", default=None, doc="Height of the survey surface.")
    height_reference: Literal["ellipsoid", "mean_sea_level", "terrain"] | None = quantity(
        "1", default=None, doc="What the height counts from."
    )
    undulation_m: float | None = quantity(
        "m", default=None, doc="Geoid height above the ellipsoid, where height is above sea level."
    )
    reference_field: str | None = quantity(
        "1", default=None, min_length=1, doc="Core field model that was removed, such as IGRF-13."
    )
    reference_epoch: IsoDate | None = quantity(
        "1", default=None, doc="Date of the anomaly and its reference field, ISO."
    )
    anomaly_definition: str | None = quantity(
        "1", default=None, min_length=1, doc=f"What the anomaly is; default: {TOTAL_FIELD_ANOMALY}."
    )
    uncertainty_nt: float | None = quantity(
        "nT",
        default=None,
        gt=0,
        doc="1 sigma of the grid's own error; where the file has its own, of nodes it leaves out.",
    )
    line_spacing_m: float | None = quantity(
        "m", default=None, gt=0, doc="Spacing of the flight lines."
    )
    source_distance_m: float | None = quantity(
        "m", default=None, gt=0, doc="From the survey surface down to the magnetic sources."
    )
    wavelength_band_km: Annotated[tuple[float, float], pydantic.AfterValidator(_rising)] | None = (
        quantity("km", default=None, doc="Wavelengths the grid holds, shortest and longest.")
    )
    uncertainty_column: int | None = quantity(
        "1", default=None, ge=1, doc="Column of a text grid with 1 sigma of the value."
    )

    @property
    def all_columns(self) -> tuple[int, ...]:
        """As `GridFileParams.all_columns`."""
        return self.columns + (
            () if self.uncertainty_column is None else (self.uncertainty_column,)
        )


class IngestSurfaceParams(GridFileParams):
    """The [surface] keys of a source: the height of terrain or geoid."""

    measures = ELEVATION

    surface: Literal["terrain", "mean_sea_level"] | None = quantity(
        "1", default=None, doc="Which surface it is: a DEM's terrain, or the geoid."
    )
    height_reference: Literal["ellipsoid", "mean_sea_level"] | None = quantity(
        "1", default=None, doc="What its heights count from; the geoid's from the ellipsoid."
    )
    undulation_m: float | None = quantity(
        "m", default=None, doc="Geoid height that makes heights above sea level ellipsoidal."
    )


class SourceParams(Params):
    """The [source] keys: identity, files and rights of a data set."""

    id: str = quantity("1", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", doc="Name, unique.")
    kind: str = quantity("1", min_length=1, doc="Contract of the data, such as anomaly-grid.")
    files: tuple[str, ...] = quantity("1", min_length=1, doc="Its files, relative to the TOML.")
    licence: str = quantity("1", min_length=1, doc="Under which terms the data may be used.")
    title: str | None = quantity("1", default=None, doc="One line for people.")
    url: str | None = quantity("1", default=None, doc="Where it is published.")
    urls: tuple[str, ...] = quantity(
        "1", default=(), doc="Where its files, or zip or tar archives of them, are fetched from."
    )
    citation: str | None = quantity("1", default=None, doc="How to cite it.")
    sha256: dict[str, str] = quantity("1", default={}, doc="Digest of each file, by its name.")


P = TypeVar("P", bound=Params)


@dataclass(frozen=True)
class SourceKind(Generic[P]):
    """A kind of source: its contract's name and the table that its files need beside [source]."""

    name: str
    table: str
    params: type[P]


ANOMALY_GRID = SourceKind("anomaly-grid", "grid", IngestGridParams)
SURFACE_GRID = SourceKind("surface-grid", "surface", IngestSurfaceParams)


@dataclass(frozen=True)
class Source(Generic[P]):
    """A source TOML, read: its own path, the [source] table and the table of its kind."""

    path: Path
    kind: SourceKind[P]
    source: SourceParams
    params: P

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of the data files, beside the TOML."""
        return source_files(self.path, self.source)


def source_files(path: Path, header: SourceParams) -> tuple[Path, ...]:
    """Paths of the data files that the source TOML at `path` names, beside it."""
    return tuple(path.parent / name for name in header.files)


def load_header(path: Path) -> SourceParams:
    """The [source] table of a source TOML of any kind.

    Raises SourceError that names the file and the key.
    """
    return _header(path, load_toml(path))


def load_source(path: Path, kind: SourceKind[P]) -> Source[P]:
    """Read a source TOML of one kind.

    Raises SourceError that names the file and the table's key.
    """
    tables = load_toml(path)
    header = _header(path, tables)
    if header.kind != kind.name:
        raise SourceError(
            f"key 'kind' is '{header.kind}'",
            where=f"{path} [source]",
            expected=f"'{kind.name}'",
        )
    for name in tables:
        if name not in ("source", kind.table):
            raise SourceError(
                f"unknown table [{name}]", where=path, expected=f"[source], [{kind.table}]"
            )
    params: P = parse_params(
        kind.params,
        tables.get(kind.table, {}),
        where=f"{path} [{kind.table}]",
        error=SourceError,
    )
    return Source(path, kind, header, params)


def _header(path: Path, tables: dict[str, dict[str, Any]]) -> SourceParams:
    if "source" not in tables:
        raise SourceError("table [source] is missing", where=path, remedy="add it")
    header: SourceParams = parse_params(
        SourceParams, tables["source"], where=f"{path} [source]", error=SourceError
    )
    return header


def load_toml(path: Path, *, lists: Sequence[str] = ()) -> dict[str, Any]:
    """The tables of a TOML file; those of a name in `lists` may be several, [[name]].

    Raises SourceError naming file and line.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as caught:
        raise SourceError(f"cannot be read: {caught.strerror}", where=path) from None
    except UnicodeDecodeError as caught:
        raise SourceError(f"byte {caught.start} is not UTF-8", where=path) from None
    except tomllib.TOMLDecodeError as caught:
        raise SourceError(f"is not TOML: {caught}", where=path) from None
    for name, table in document.items():
        several = table if name in lists and isinstance(table, list) else [table]
        if not all(isinstance(one, dict) for one in several):
            raise SourceError(
                f"key '{name}' stands outside any table",
                where=path,
                remedy="move it under the [table] it belongs to",
            )
    return document


def locate_all(files: Sequence[Path], kind: SourceKind[P]) -> tuple[list[Path], Source[P] | None]:
    """The data files that `files` name, and the source TOML that describes them, if any.

    A data file given beside a TOML stands in for the TOML's file of the same name, so that a
    local copy can be used. Raises SourceError for several TOMLs, none or unknown files;
    IntegrityError when a digest is not the one stated.
    """
    tomls = [p for p in files if p.suffix.lower() == ".toml"]
    direct = [p for p in files if p.suffix.lower() != ".toml"]
    if len(tomls) > 1:
        raise SourceError(f"{len(tomls)} source TOMLs", expected="one", where=tomls[1])
    if not tomls:
        if not direct:
            raise SourceError("no data file", where="files", remedy="name one")
        return direct, None
    source = load_source(tomls[0], kind)
    named, given = {p.name: p for p in source.files}, {p.name: p for p in direct}
    for stray in sorted(set(given) - set(named)):
        raise SourceError(
            f"does not name the data file '{stray}' given beside it",
            where=f"{tomls[0]} [source] files",
            expected=f"one of {', '.join(named)}",
        )
    found = list((named | given).values())
    for path in found:
        _check_digest(path, source.source, tomls[0])
    return found, source


def locate(files: Sequence[Path], kind: SourceKind[P]) -> tuple[Path, Source[P] | None]:
    """The one data file that `files` name, and its source TOML: see `locate_all`.

    Raises SourceError for several files too.
    """
    found, source = locate_all(files, kind)
    if len(found) != 1:
        raise SourceError(
            f"{len(found)} data files: {', '.join(sorted(p.name for p in found))}",
            where="files",
            expected="one file",
            remedy="ingest each alone",
        )
    return found[0], source


def merge(params: P, source: Source[P] | None) -> P:
    """The keys of a source's own table together with parameters given directly.

    Raises SourceError where both state a key differently.
    """
    if source is None:
        return params
    stated = _stated(source.params)
    for key, value in _stated(params).items():
        if stated.setdefault(key, value) != value:
            raise SourceError(
                f"key '{key}' is {stated[key]!r}, but the parameter says {value!r}",
                where=f"{source.path} [{source.kind.table}]",
                remedy="state it once",
            )
    return type(params)(**stated)


def _stated(params: Params) -> dict[str, Any]:
    values: Mapping[str, Any] = {name: getattr(params, name) for name in params.model_fields_set}
    return {k: v for k, v in values.items() if v is not None}


def _check_digest(path: Path, header: SourceParams, toml: Path) -> None:
    expected = header.sha256.get(path.name)
    if expected is None or not path.is_file():
        return
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != expected.lower():
        raise IntegrityError(
            f"sha256 is {found}",
            where=path,
            expected=f"{expected} as {toml.name} states",
            remedy="fetch the file again, or correct the digest if the data set was replaced",
        )
