"""Every stage there is, listed: nothing is discovered at run time."""

from __future__ import annotations

from magtiles.stages.declare import Stage
from magtiles.stages.field import (
    carry_forward,
    components,
    continuation,
    core_field,
    crop,
    evaluate_model,
    model_components,
    rereference,
    sphere,
    surface,
    voids,
)
from magtiles.stages.field.survey import grid as survey_grid
from magtiles.stages.ingest import grid, index
from magtiles.stages.ingest import surface as ingest_surface
from magtiles.stages.ingest.log import stage as log
from magtiles.stages.ingest.observatory import stage as observatory
from magtiles.stages.release import expect_total, tiles
from magtiles.stages.road import features, match, merge, resample
from magtiles.stages.temporal import assemble, baseline, check, diurnal, fit_fogm
from magtiles.stages.vehicle import align, reduce
from magtiles.stages.vehicle.calibration import apply as apply_calibration
from magtiles.stages.vehicle.calibration import calibrate
from magtiles.stages.vehicle.tolles_lawson import apply as apply_tolles_lawson
from magtiles.stages.vehicle.tolles_lawson import fit as fit_tolles_lawson

STAGES: tuple[Stage, ...] = (
    grid.STAGE,
    ingest_surface.STAGE,
    observatory.STAGE,
    index.STAGE,
    log.STAGE,
    align.STAGE,
    calibrate.STAGE,
    apply_calibration.STAGE,
    expect_total.STAGE,
    fit_tolles_lawson.STAGE,
    apply_tolles_lawson.STAGE,
    resample.STAGE,
    merge.STAGE,
    features.STAGE,
    match.STAGE,
    evaluate_model.STAGE,
    core_field.GRID_STAGE,
    core_field.TRACK_STAGE,
    rereference.STAGE,
    check.STAGE,
    baseline.STAGE,
    fit_fogm.STAGE,
    assemble.STAGE,
    diurnal.RECORD_STAGE,
    diurnal.BASELINE_STAGE,
    reduce.STAGE,
    survey_grid.ANOMALY_STAGE,
    survey_grid.TOTAL_STAGE,
    crop.STAGE,
    voids.STAGE,
    carry_forward.STAGE,
    continuation.STAGE,
    components.STAGE,
    model_components.STAGE,
    sphere.STAGE,
    surface.STAGE,
    tiles.STAGE,
)
"""In the order of the work: ingest, field, release."""
