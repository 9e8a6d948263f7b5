"""Every stage there is, listed: nothing is discovered at run time."""

from __future__ import annotations

from magtiles.stages.declare import Stage
from magtiles.stages.field import components, continuation, crop, voids
from magtiles.stages.ingest import grid
from magtiles.stages.release import tiles

STAGES: tuple[Stage, ...] = (
    grid.STAGE,
    crop.STAGE,
    voids.STAGE,
    continuation.STAGE,
    components.STAGE,
    tiles.STAGE,
)
"""In the order of the work: ingest, field, release."""
