"""A product TOML: what is built from which source, and at which heights."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from magtiles.catalog.models.igrf import igrf_files
from magtiles.pipeline.reference_surface import ReferenceSurface, load_reference_surface
from magtiles.pipeline.road_sources import RoadSources, RoadsTable, load_roads
from magtiles.pipeline.source_paths import find_source
from magtiles.pipeline.temporal_part import TemporalSources, TemporalTable, load_temporal
from magtiles.schemas.errors import MissingInputError, SourceError
from magtiles.stages.declare import IsoDate, Params, parse_params, quantity
from magtiles.stages.field.direction import DECLINATION_DEG, INCLINATION_DEG
from magtiles.stages.ingest.field_model import FIELD_MODEL, igrf_coefficients, model_files
from magtiles.stages.ingest.source import (
    ANOMALY_GRID,
    IngestGridParams,
    Source,
    load_source,
    load_toml,
)
from magtiles.stages.release.plan import Bounds

_LOWEST_M, _HIGHEST_M = -12_000.0, 100_000.0
"""From the deepest sea to where a map of one survey's plane ends to be one of the round Earth."""


class ProductTable(Params):
    """[product]: the name and version of the release."""

    name: str = quantity(
        "1", pattern=r"^[a-z0-9][a-z0-9._-]{0,63}$", doc="Name of the product, in lower case."
    )
    version: str = quantity(
        "1", pattern=r"^(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)$", doc="Version, such as 1.0.0."
    )


def _south_north(limits: tuple[float, float]) -> tuple[float, float]:
    if not -90.0 <= limits[0] < limits[1] <= 90.0:
        raise ValueError("south, then north, within -90 to 90")
    return limits


def _west_east(limits: tuple[float, float]) -> tuple[float, float]:
    if not all(-180.0 <= limit <= 360.0 for limit in limits) or limits[0] == limits[1]:
        raise ValueError("west, then east, within -180 to 360")
    return limits


class RegionTable(Params):
    """region: limits of the release, WGS84 degrees."""

    latitude: Annotated[tuple[float, float], pydantic.AfterValidator(_south_north)] = quantity(
        "degrees_north", doc="South and north limits."
    )
    longitude: Annotated[tuple[float, float], pydantic.AfterValidator(_west_east)] = quantity(
        "degrees_east", doc="West and east limits; west > east crosses the date line."
    )

    @property
    def bounds(self) -> Bounds:
        """South, north, west, east; east counted on from west."""
        (south, north), (west, east) = self.latitude, self.longitude
        return south, north, west, west + ((east - west) % 360.0 or 360.0)


def _distinct(heights: tuple[float, ...]) -> tuple[float, ...]:
    if not heights:
        raise ValueError("at least one height")
    if len(set(heights)) < len(heights):
        raise ValueError("each height once")
    if not all(_LOWEST_M <= height <= _HIGHEST_M for height in heights):
        raise ValueError(f"metres, within {_LOWEST_M:g} to {_HIGHEST_M:g}")
    return heights


class AnomalyTable(Params):
    """[anomaly]: the map, its levels and its lattice."""

    source: str = quantity("1", doc="Path of a source TOML, or the id of one in the catalog.")
    heights_m: Annotated[tuple[float, ...], pydantic.AfterValidator(_distinct)] = quantity(
        "m", doc="Heights of the levels; the survey's own surface is added."
    )
    height_reference: Literal["ellipsoid", "mean_sea_level", "terrain"] = quantity(
        "1", doc="What heights count from: the source's."
    )
    surface: str | None = quantity(
        "1", default=None, doc="Source TOML of the terrain's height (a DEM), or an id."
    )
    geoid: str | None = quantity(
        "1", default=None, doc="Source TOML of the geoid, for a survey or a DEM above sea level."
    )
    region: RegionTable | None = quantity("1", default=None, doc="Limits; default all data.")
    spacing_m: float | None = quantity(
        "m",
        default=None,
        gt=0,
        doc="Node spacing; default the smaller of the source's cell and half the lowest gain.",
    )
    tile_deg: float | None = quantity(
        "degree", default=None, gt=0, le=90, doc="Size of a tile; default some 300 cells or more."
    )
    inclination_deg: float | None = INCLINATION_DEG
    declination_deg: float | None = DECLINATION_DEG
    allow_downward_continuation: bool = quantity(
        "1", default=False, doc="Permit levels below the survey (flagged)."
    )
    block_nodes: int | None = quantity(
        "1",
        default=None,
        ge=128,
        doc="Make levels in blocks of so many nodes a side; default blocks of 2560 where the "
        "survey has more than 3072 x 3072 nodes, or a level twice that.",
    )


class ModelTable(Params):
    """[model]: the map of a field model's crust, in place of [anomaly]."""

    coefficients: str = quantity(
        "1", doc="A coefficient file or folder, a source TOML, or the id of one in the catalog."
    )
    core: str | None = quantity(
        "1", default=None, doc="Core field of another model: IGRF-14, or a file; default its own."
    )
    epoch: IsoDate = quantity("1", doc="Date of the core field.")
    heights_m: Annotated[tuple[float, ...], pydantic.AfterValidator(_distinct)] = quantity(
        "m", doc="Heights of the levels above the ellipsoid."
    )
    core_degree: int = quantity("1", default=15, ge=1, doc="Highest degree of the core field.")
    crust_degree: int = quantity("1", default=16, ge=2, doc="Lowest degree of the anomaly.")
    highest_degree: int | None = quantity(
        "1", default=None, ge=2, doc="Highest degree of the anomaly; default the model's."
    )
    region: RegionTable | None = quantity(
        "1", default=None, doc="Limits; default the globe between 85 degrees south and north."
    )
    spacing_m: float | None = quantity(
        "m", default=None, gt=0, doc="Node spacing; default an eighth of the shortest wavelength."
    )
    tile_deg: float | None = quantity(
        "degree", default=None, gt=0, le=90, doc="Size of a tile; default some 300 cells or more."
    )
    uncertainty_nt: float | None = quantity(
        "nT",
        default=None,
        gt=0,
        doc="1 sigma of a component at the ellipsoid; default the source's.",
    )


class ProductTables(Params):
    """The whole of a product TOML: one of [anomaly] and [model], and what goes with it."""

    product: ProductTable = quantity("1", doc="Name and version.")
    anomaly: AnomalyTable | None = quantity("1", default=None, doc="The map of a survey.")
    model: ModelTable | None = quantity("1", default=None, doc="The map of a field model.")
    temporal: TemporalTable | None = quantity("1", default=None, doc="Variations in time.")
    roads: tuple[RoadsTable, ...] = quantity("1", default=(), doc="Maps of roads.")


@dataclass(frozen=True)
class SurveyMap:
    """The map of a survey: what is asked of it, its source TOML's path, and that TOML read.

    `surface` is what its heights count from, where the product says how high that is.
    """

    table: AnomalyTable
    path: Path
    source: Source[IngestGridParams]
    surface: ReferenceSurface | None = None


@dataclass(frozen=True)
class ModelMap:
    """The map of a field model.

    Attributes
    ----------
    table : what is asked of it.
    path : the source TOML, or the coefficient file or folder itself.
    id, licence, url : as the TOML says; the name of the file, "not stated" and None without.
    files : of the coefficients.
    core : file of another core field, if one was asked for.
    """

    table: ModelTable
    path: Path
    id: str
    licence: str
    url: str | None
    files: tuple[Path, ...]
    core: Path | None


@dataclass(frozen=True)
class Product:
    """A product with what its map is made from, found and read."""

    path: Path
    product: ProductTable
    map: SurveyMap | ModelMap
    temporal: TemporalSources | None = None
    roads: tuple[RoadSources, ...] = ()

    @property
    def sources(self) -> Iterator[Source[Any]]:
        """Every source TOML it is made from; coefficient files are not among them."""
        if isinstance(self.map, SurveyMap):
            yield self.map.source
            if self.map.surface is not None:
                yield from (source for _, source in self.map.surface.sources)
        if self.temporal is not None:
            yield from (*self.temporal.observatories, *self.temporal.indices)
        for roads in self.roads:
            yield from roads.sources


def load_product(path: Path) -> Product:
    """Read a product TOML and the source it names.

    Raises SourceError naming file and key.
    """
    document = load_toml(path, lists=("roads",))
    tables: ProductTables = parse_params(ProductTables, document, where=path, error=SourceError)
    made_from = _map(tables.anomaly, tables.model, path)
    temporal = None if tables.temporal is None else load_temporal(tables.temporal, path)
    return Product(path, tables.product, made_from, temporal, load_roads(tables.roads, path))


def _map(survey: AnomalyTable | None, model: ModelTable | None, path: Path) -> SurveyMap | ModelMap:
    if model is not None and survey is None:
        return _model_map(model, path)
    if survey is not None and model is None:
        return _survey_map(survey, path)
    found = "is neither [anomaly] nor" if model is None else "are both [anomaly] and"
    raise SourceError(
        f"there {found} [model]",
        where=path,
        expected="one: a survey's map, or a field model's",
        remedy="add one" if model is None else "make two products of it",
    )


def _survey_map(survey: AnomalyTable, path: Path) -> SurveyMap:
    source_path = find_source(survey.source, path, "anomaly.source")
    source = load_source(source_path, ANOMALY_GRID)
    _check_reference(survey, source, path)
    surface = load_reference_surface(
        survey.surface, survey.geoid, survey.height_reference, source, path
    )
    return SurveyMap(survey, source_path, source, surface)


def _model_map(model: ModelTable, product: Path) -> ModelMap:
    core = None if model.core is None else _find_core(model.core, product)
    direct = product.parent / model.coefficients
    if direct.exists() and direct.suffix != ".toml":
        files = tuple(model_files(direct))
        return ModelMap(model, direct, direct.stem, "not stated", None, files, core)
    if direct.suffix not in ("", ".toml"):
        raise MissingInputError(
            f"coefficient file '{model.coefficients}' does not exist",
            where=f"{product} model.coefficients",
            expected=f"a file at {direct}",
            remedy="correct the path, or name a source TOML, whose files --from can find",
        )
    path = find_source(model.coefficients, product, "model.coefficients")
    source = load_source(path, FIELD_MODEL)
    header = source.source
    return ModelMap(model, path, header.id, header.licence, header.url, source.files, core)


def _find_core(name: str, product: Path) -> Path:
    file = igrf_coefficients(name)
    if file is None and (product.parent / name).is_file():
        file = product.parent / name
    if file is None:
        known = ", ".join(f"IGRF-{generation}" for generation in sorted(igrf_files()))
        raise SourceError(
            f"'{name}' is no core field at hand",
            where=f"{product} model.core",
            expected=f"one of {known}, or the path of a coefficient file",
        )
    return file


def _check_reference(anomaly: AnomalyTable, source: Source[IngestGridParams], path: Path) -> None:
    stated = source.params.height_reference
    if stated is not None and stated != anomaly.height_reference:
        raise SourceError(
            f"height_reference is '{anomaly.height_reference}'",
            where=f"{path} anomaly",
            expected=f"'{stated}', which the source states",
            remedy="give heights above the source's own reference",
        )
