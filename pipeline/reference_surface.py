"""The surface that a survey's heights count from: found, checked, and laid on the lattice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline.source_paths import data_files, find_source, manifest_inputs
from magtiles.pipeline.steps import Steps, node_axes
from magtiles.schemas.errors import SourceError
from magtiles.stages.field import surface as sampling
from magtiles.stages.ingest import surface as ingest
from magtiles.stages.ingest.source import (
    SURFACE_GRID,
    IngestGridParams,
    IngestSurfaceParams,
    Source,
    load_source,
)

SurfaceSource = Source[IngestSurfaceParams]


@dataclass(frozen=True)
class ReferenceSurface:
    """Sources of a surface's height, and of the geoid that it lies above where it does.

    Where heights count from mean sea level the surface is the geoid itself.
    """

    surface: SurfaceSource
    geoid: SurfaceSource | None = None

    @property
    def sources(self) -> Iterator[tuple[str, SurfaceSource]]:
        """Each by its role."""
        yield "surface", self.surface
        if self.geoid is not None:
            yield "geoid", self.geoid

    @property
    def steps(self) -> int:
        """How many stages `lay` runs."""
        return 2 if self.geoid is None else 3

    def inputs(self, data: Path | None) -> list[dict[str, str]]:
        """Inputs of a manifest."""
        found = []
        for role, source in self.sources:
            found += manifest_inputs(source, data_files(source, data), role)
        return found

    def lay(
        self, grid: Path, lattice: Lattice, folder: Path, data: Path | None, steps: Steps
    ) -> list[Path]:
        """Artifacts of its heights, the last of them at every node of a lattice and its halo.

        `grid` is the survey, filled. Raises SourceError, FormatError and ContractError for bad
        surfaces, CoverageError for those that end short of the survey.
        """
        ingested = {}
        for role, source in self.sources:
            files = [source.path, *data_files(source, data)]
            ingested[role] = steps.run(ingest.STAGE, {"files": files}, folder / f"{role}.nc", {})
        made = steps.run(
            sampling.STAGE,
            {"grid": grid, **ingested},
            folder / "reference-surface.nc",
            node_axes(lattice),
        )
        return [*ingested.values(), made]


def load_reference_surface(
    surface: str | None,
    geoid: str | None,
    counts_from: str,
    survey: Source[IngestGridParams],
    product: Path,
) -> ReferenceSurface | None:
    """The keys `anomaly.surface` and `anomaly.geoid` of a product, found and read; None without.

    Raises SourceError where they do not fit the height reference, the survey or each other.
    """
    if surface is None and geoid is None:
        return None
    _check_wanted(surface, geoid, counts_from, survey, product)
    of_geoid = None if geoid is None else _load(geoid, "geoid", "mean_sea_level", product)
    if surface is None:
        assert of_geoid is not None
        return ReferenceSurface(of_geoid)
    of_terrain = _load(surface, "surface", "terrain", product)
    _check_above(of_terrain.params, of_geoid is not None, product)
    return ReferenceSurface(of_terrain, of_geoid)


def _check_wanted(
    surface: str | None,
    geoid: str | None,
    counts_from: str,
    survey: Source[IngestGridParams],
    product: Path,
) -> None:
    takes = {
        "terrain": "surface, and geoid where that is above sea level",
        "mean_sea_level": "geoid alone",
        "ellipsoid": "neither surface nor geoid",
    }[counts_from]
    if (counts_from == "terrain") != (surface is not None) or counts_from == "ellipsoid":
        given = " and ".join(
            k for k, v in (("surface", surface), ("geoid", geoid)) if v is not None
        )
        raise SourceError(
            f"there is {given} with height_reference = '{counts_from}'",
            where=f"{product} anomaly",
            expected=takes,
        )
    if counts_from == "mean_sea_level" and survey.params.undulation_m is not None:
        raise SourceError(
            "there is a geoid, and undulation_m in the source",
            where=f"{product} anomaly.geoid",
            expected="one of them",
            remedy=f"remove one, the number from {survey.path}",
        )


def _load(name: str, key: str, kind: str, product: Path) -> SurfaceSource:
    path = find_source(name, product, f"anomaly.{key}")
    source = load_source(path, SURFACE_GRID)
    where = f"{path} [{SURFACE_GRID.table}]"
    if source.params.surface not in (None, kind):
        raise SourceError(
            f"surface is '{source.params.surface}'",
            where=where,
            expected=f"'{kind}', as {product.name} names it under {key}",
        )
    ingest.check_surface_keys(source.params, where)
    return source


def _check_above(params: IngestSurfaceParams, has_geoid: bool, product: Path) -> None:
    """Raise SourceError for a geoid that a DEM lacks or does not need, as far as its TOML says."""
    needs = params.height_reference == "mean_sea_level" and params.undulation_m is None
    if params.height_reference is None or needs == has_geoid:
        return
    if needs:
        raise SourceError(
            "the surface's heights are above sea level, and there is no geoid",
            where=f"{product} anomaly",
            expected="heights above the ellipsoid",
            remedy="name a geoid = ..., or state undulation_m in the surface's TOML",
        )
    raise SourceError(
        "there is a geoid, but the surface's heights are ellipsoidal already",
        where=f"{product} anomaly.geoid",
        remedy="remove it, or correct height_reference in the surface's TOML",
    )
