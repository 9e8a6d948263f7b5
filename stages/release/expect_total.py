"""What a release and its core field let a scalar magnetometer expect: ``expect-total-field``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from magtiles.catalog import open_release
from magtiles.catalog.releases.manifest import MANIFEST_NAME
from magtiles.schemas.errors import UsageError
from magtiles.stages.declare import FILES, Params, Stage, quantity
from magtiles.stages.field.core_field import ellipsoidal_height


class ExpectTotalFieldParams(Params):
    """Parameters of expect-total-field."""

    allow_extrapolated: bool = quantity(
        "1", default=False, doc="Answer beyond the map's coverage and its core field's span."
    )


def expect_total_field(
    track: xr.Dataset, release: list[Path], *, params: ExpectTotalFieldParams
) -> xr.Dataset:
    """The track with `expected_total` (time,), nT: |core field| at each time, and the anomaly.

    `release` is the path of a release's ``manifest.json``. NaN where a place is unknown or the map
    does not cover it.

    Raises UsageError for what is no manifest, IntegrityError for a release that is not what it
    says, ContractError where heights or the release's surface are not known above the ellipsoid,
    QueryError for times beyond the core field's span.
    """
    if len(release) != 1 or release[0].name != MANIFEST_NAME:
        raise UsageError(
            f"is {', '.join(path.name for path in release)}",
            where="role release",
            expected=f"the {MANIFEST_NAME} of one release",
            remedy=f"give release=STORE/PRODUCT/VERSION/{MANIFEST_NAME}",
        )
    opened = open_release(release[0].parent, allow_extrapolated=params.allow_extrapolated)
    latitude, longitude = track["latitude"].values, track["longitude"].values
    height = np.broadcast_to(ellipsoidal_height(track), latitude.shape)
    known = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(height)
    expected = np.full(latitude.shape, np.nan)
    expected[known] = opened.anomaly.expected_total_field(
        latitude[known], longitude[known], height[known], track["time"].values[known]
    )
    about = f"core field and anomaly of {opened.manifest.product} {opened.manifest.version}"
    return track.assign(expected_total=("time", expected, {"units": "nT", "long_name": about}))


STAGE = Stage(
    name="expect-total-field",
    version=1,
    params=ExpectTotalFieldParams,
    inputs={"track": "track/1", "release": FILES},
    output="track/1",
    run=expect_total_field,
)
