"""A source TOML: which files a data set has, and what those files do not say themselves."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from magtiles.schemas.errors import IntegrityError, SourceError
from magtiles.stages.declare import IsoDate, Params, parse_params, quantity

TOTAL_FIELD_ANOMALY = "total-field anomaly: |F| minus the reference field's magnitude"


def _rising(band: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= band[0] < band[1]:
        raise ValueError("two wavelengths in km, the shorter first")
    return band


class IngestGridParams(Params):
    """The [grid] keys of a source: what an anomaly grid's file does not say itself."""

    crs: str | None = quantity("1", default=None, doc="CRS: EPSG code, PROJ string or WKT.")
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
        "nT", default=None, gt=0, doc="1 sigma of the grid's own error."
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
    units: str | None = quantity(
        "1", default=None, doc="Unit of the values; default nT where the file does not say."
    )
    no_data: float | None = quantity(
        "1", default=None, doc="Value that marks a void where the file does not say, as stored."
    )
    registration: Literal["pixel", "point"] | None = quantity(
        "1", default=None, doc="Whether values are for cells or for their coordinates."
    )
    band: int | None = quantity("1", default=None, ge=1, doc="Raster band, counted from 1.")
    variable: str | None = quantity("1", default=None, doc="Variable of a netCDF file.")
    allow_ballpark_datum: bool = quantity(
        "1", default=False, doc="Accept a datum whose relation to WGS84 is not known."
    )


class SourceParams(Params):
    """The [source] keys: identity, files and rights of a data set."""

    id: str = quantity("1", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", doc="Name, unique.")
    kind: str = quantity("1", min_length=1, doc="Contract of the data, such as anomaly-grid.")
    files: tuple[str, ...] = quantity("1", min_length=1, doc="Its files, relative to the TOML.")
    licence: str = quantity("1", min_length=1, doc="Under which terms the data may be used.")
    title: str | None = quantity("1", default=None, doc="One line for people.")
    url: str | None = quantity("1", default=None, doc="Where it is published.")
    citation: str | None = quantity("1", default=None, doc="How to cite it.")
    sha256: dict[str, str] = quantity("1", default={}, doc="Digest of each file, by its name.")


@dataclass(frozen=True)
class Source:
    """A source TOML, read: its own path, the [source] table and the raw table of its kind."""

    path: Path
    source: SourceParams
    grid: IngestGridParams

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of the data files, beside the TOML."""
        return tuple(self.path.parent / name for name in self.source.files)


def load_source(path: Path) -> Source:
    """Read a source TOML of kind ``anomaly-grid``.

    Raises SourceError that names the file and the table's key.
    """
    tables = load_toml(path)
    for name in tables:
        if name not in ("source", "grid"):
            raise SourceError(f"unknown table [{name}]", where=path, expected="[source], [grid]")
    if "source" not in tables:
        raise SourceError("table [source] is missing", where=path, remedy="add it")
    header: SourceParams = parse_params(
        SourceParams, tables["source"], where=f"{path} [source]", error=SourceError
    )
    if header.kind != "anomaly-grid":
        raise SourceError(
            f"key 'kind' is '{header.kind}'",
            where=f"{path} [source]",
            expected="'anomaly-grid'",
        )
    grid: IngestGridParams = parse_params(
        IngestGridParams, tables.get("grid", {}), where=f"{path} [grid]", error=SourceError
    )
    return Source(path, header, grid)


def load_toml(path: Path) -> dict[str, dict[str, Any]]:
    """The tables of a TOML file. Raises SourceError naming file and line."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as caught:
        raise SourceError(f"cannot be read: {caught.strerror}", where=path) from None
    except UnicodeDecodeError as caught:
        raise SourceError(f"byte {caught.start} is not UTF-8", where=path) from None
    except tomllib.TOMLDecodeError as caught:
        raise SourceError(f"is not TOML: {caught}", where=path) from None
    for name, table in document.items():
        if not isinstance(table, dict):
            raise SourceError(
                f"key '{name}' stands outside any table",
                where=path,
                remedy="move it under the [table] it belongs to",
            )
    return document


def locate(files: Sequence[Path]) -> tuple[Path, Source | None]:
    """The one data file that `files` name, and the source TOML that describes it, if any.

    A data file given beside a TOML stands in for the TOML's file of the same name, so that a
    local copy can be used. Raises SourceError for none or several, IntegrityError when the
    digest is not the one stated.
    """
    tomls = [p for p in files if p.suffix.lower() == ".toml"]
    given = {p.name: p for p in files if p.suffix.lower() != ".toml"}
    if len(tomls) > 1:
        raise SourceError(f"{len(tomls)} source TOMLs", expected="one", where=tomls[1])
    source = load_source(tomls[0]) if tomls else None
    named = {p.name: p for p in source.files} if source else {}
    stray = sorted(set(given) - set(named)) if source else []
    if stray:
        raise SourceError(
            f"does not name the data file '{stray[0]}' given beside it",
            where=f"{tomls[0]} [source] files",
            expected=f"one of {', '.join(named)}",
        )
    data = named | given
    if len(data) != 1:
        raise SourceError(
            f"{len(data)} data files: {', '.join(sorted(data)) or 'none'}",
            where="files",
            expected="one grid file",
            remedy="ingest each grid alone",
        )
    path = next(iter(data.values()))
    if source is not None:
        _check_digest(path, source)
    return path, source


def merge(params: IngestGridParams, source: Source | None) -> IngestGridParams:
    """The [grid] keys of a source together with parameters given directly.

    Raises SourceError where both state a key differently.
    """
    if source is None:
        return params
    stated = _stated(source.grid)
    for key, value in _stated(params).items():
        if stated.setdefault(key, value) != value:
            raise SourceError(
                f"key '{key}' is {stated[key]!r}, but the parameter says {value!r}",
                where=f"{source.path} [grid]",
                remedy="state it once",
            )
    return IngestGridParams(**stated)


def _stated(params: IngestGridParams) -> dict[str, Any]:
    values: Mapping[str, Any] = {name: getattr(params, name) for name in params.model_fields_set}
    return {k: v for k, v in values.items() if v is not None}


def _check_digest(path: Path, source: Source) -> None:
    expected = source.source.sha256.get(path.name)
    if expected is None or not path.is_file():
        return
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != expected.lower():
        raise IntegrityError(
            f"sha256 is {found}",
            where=path,
            expected=f"{expected} as {source.path.name} states",
            remedy="fetch the file again, or correct the digest if the data set was replaced",
        )
