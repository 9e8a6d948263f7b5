"""The variables of an anomaly tile (anomaly-tile/1): one table for cutter, writer and reader.

There are no fill values: a tile is finite everywhere, and `quality_flag` says where not to
believe it. Standard names stand only where the CF table has one for exactly that quantity.
"""

from __future__ import annotations

from dataclasses import dataclass

CONTRACT = "anomaly-tile/1.0.0"

NODES = ("latitude", "longitude")
LEVELS = ("height", "latitude", "longitude")


@dataclass(frozen=True)
class TileVariable:
    """Dimensions, dtype, unit (None: has none) and description of a variable."""

    dims: tuple[str, ...]
    dtype: str
    units: str | None
    long_name: str
    required: bool = True


def _field(name: str, units: str) -> TileVariable:
    return TileVariable(LEVELS, "float32", units, name)


TILE_VARIABLES: dict[str, TileVariable] = {
    "height": TileVariable(("height",), "float64", "m", "height above the reference surface"),
    "latitude": TileVariable(("latitude",), "float64", "degrees_north", "geodetic latitude"),
    "longitude": TileVariable(("longitude",), "float64", "degrees_east", "geodetic longitude"),
    "crs": TileVariable((), "int32", None, "coordinate reference system"),
    "magnetic_anomaly": _field("total-field magnetic anomaly", "nT"),
    "anomaly_north": _field("magnetic anomaly, component toward true north", "nT"),
    "anomaly_east": _field("magnetic anomaly, component toward east", "nT"),
    "anomaly_down": _field("magnetic anomaly, component downward", "nT"),
    "gradient_nn": _field("north derivative of the north component", "nT km-1"),
    "gradient_ne": _field("north derivative of the east component", "nT km-1"),
    "gradient_nd": _field("north derivative of the down component", "nT km-1"),
    "gradient_ee": _field("east derivative of the east component", "nT km-1"),
    "gradient_ed": _field("east derivative of the down component", "nT km-1"),
    "magnetic_anomaly_uncertainty": _field("1 sigma of the total-field anomaly", "nT"),
    "vector_uncertainty": _field("1 sigma of each anomaly component", "nT"),
    "tensor_uncertainty": _field("1 sigma of each gradient", "nT km-1"),
    "quality_flag": TileVariable(LEVELS, "uint8", None, "why a value is filled or doubtful"),
    "ambient_north": TileVariable(NODES, "float32", "1", "ambient field direction, north part"),
    "ambient_east": TileVariable(NODES, "float32", "1", "ambient field direction, east part"),
    "ambient_down": TileVariable(NODES, "float32", "1", "ambient field direction, down part"),
    "reference_surface_height": TileVariable(
        NODES, "float32", "m", "ellipsoidal height of the surface that height counts from", False
    ),
}

UNITS: dict[str, str] = {
    name: rule.units for name, rule in TILE_VARIABLES.items() if rule.units is not None
}
