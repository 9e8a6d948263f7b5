"""Stage ``ingest-surface``: the heights of terrain or of the geoid become a surface-grid/1."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from magtiles.schemas.errors import SourceError
from magtiles.stages.declare import FILES, Stage
from magtiles.stages.ingest.gridded import datum_attributes, read_grid, regular, settle
from magtiles.stages.ingest.source import SURFACE_GRID, IngestSurfaceParams
from magtiles.stages.rows import by_rows

_NAMES = {"terrain": "height of the terrain", "mean_sea_level": "geoid height"}


def ingest_surface(files: Sequence[Path], *, params: IngestSurfaceParams) -> xr.Dataset:
    """One DEM or geoid grid as a surface-grid/1: metres, ascending nodes, voids NaN.

    `files` and formats are those of ``ingest-grid``; `params` the [surface] keys of the source
    TOML. Heights above sea level stay what they are unless `undulation_m` is given, which makes
    them ellipsoidal.

    Raises FormatError for files that are missing, damaged, irregular, void, or with heights
    that no surface has; SourceError for keys that are missing, unknown, or do not fit.
    """
    file = settle(read_grid(files, SURFACE_GRID, params), ("surface", "height_reference"))
    params = file.params
    check_surface_keys(params, file.where)
    grid = regular(file)
    raised = params.undulation_m or 0.0
    heights = by_rows(grid.values.shape, np.float64, lambda a, b: grid.values[a:b] + raised)
    reference = "ellipsoid" if params.undulation_m is not None else params.height_reference
    attributes = {
        "units": "m",
        "positive": "up",
        "long_name": f"{_NAMES[str(params.surface)]} above {str(reference).replace('_', ' ')}",
        "grid_mapping": "crs",
    }
    facts = {"surface": params.surface, "height_reference": reference, "source": file.name}
    return grid.dataset(
        {"surface_height": (grid.dims, heights, attributes)},
        facts | datum_attributes(grid, file),
    )


def check_surface_keys(params: IngestSurfaceParams, where: str) -> None:
    """Raise SourceError for keys that contradict one another."""
    above_sea = params.height_reference == "mean_sea_level"
    if params.surface == "mean_sea_level" and above_sea:
        raise SourceError(
            "sea level's own heights count from mean sea level",
            where=where,
            expected='height_reference = "ellipsoid" for a geoid',
            remedy='a DEM has surface = "terrain"',
        )
    if params.undulation_m is not None and not above_sea:
        raise SourceError(
            f"key 'undulation_m' with height_reference = '{params.height_reference}'",
            where=where,
            expected="only where heights are above mean sea level",
        )


STAGE = Stage(
    name="ingest-surface",
    version=1,
    params=IngestSurfaceParams,
    inputs={"files": FILES},
    output="surface-grid/1",
    run=ingest_surface,
)
