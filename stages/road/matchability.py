"""How well a place on a road can be told from all others by the field alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from magtiles.catalog.kernels.road_match import Floats
from magtiles.schemas.errors import ContractError
from magtiles.stages.road.network import LocalPlane, Network, driven

SECTION_M = 3.0
"""Length of the section: four samples a metre apart, the paper's choice."""
WITHIN_M = 10.0


def matchability(
    roads: Sequence[xr.Dataset], *, section_m: float = SECTION_M, within_m: float = WITHIN_M
) -> list[Floats]:
    """The share of the expected likelihood that lies near the truth, at every point, 0 to 1.

    A section that ends at a point is as the map has it, but for errors of the map's own
    uncertainty. Averaged over these, its likelihood (Shockley 2012, eq. 2.49) at another place
    is that of the map's own section with both variances added. The share of the places within
    `within_m` of the point in the sum over all places of all `roads` is its matchability: 1
    where nothing else looks like it, `2 within_m` over the length of all roads where all looks
    alike.

    Parameters
    ----------
    roads : road-map/1, of one spacing, among which a place is to be told.

    Returns
    -------
    For each road (n,), NaN at the points up to which no whole section was driven.

    Raises ContractError for roads of different spacing.
    """
    from magtiles.catalog.kernels.road_match_compiled import share_within

    spacing = _spacing(roads)
    samples = max(1, round(section_m / spacing) + 1)
    variances = [2.0 * r["field_body_uncertainty"].values.astype(np.float64) ** 2 for r in roads]
    network = Network.of(roads, variances, LocalPlane.around(roads), "measured", samples)
    answers, start = [], 0
    for road in roads:
        field = driven(road, road["field_body"].values.astype(np.float64))
        share = np.full(len(field), np.nan)
        for last in range(samples - 1, len(field)):
            likely = network.log_likelihood(field[last - samples + 1 : last + 1])
            share[last] = share_within(likely, network.position, start, within_m**2)
            start += 1
        answers.append(driven(road, share))
    return answers


def with_matchability(
    roads: Sequence[xr.Dataset], *, section_m: float = SECTION_M, within_m: float = WITHIN_M
) -> list[xr.Dataset]:
    """The roads with variable and attribute `matchability`: at each point, and their mean.

    Roads of each spacing are told apart among themselves. Raises as `matchability`.
    """
    made: dict[int, Floats] = {}
    for spacing in {float(r.attrs["spacing_m"]) for r in roads}:
        alike = [i for i, r in enumerate(roads) if float(r.attrs["spacing_m"]) == spacing]
        shares = matchability([roads[i] for i in alike], section_m=section_m, within_m=within_m)
        made |= dict(zip(alike, shares, strict=True))
    return [_with(road, made[i]) for i, road in enumerate(roads)]


def _with(road: xr.Dataset, share: Floats) -> xr.Dataset:
    told = np.isfinite(share)
    variable = ("point", share, {"units": "1", "long_name": "matchability"})
    changed = road.assign(matchability=variable)
    if told.any():
        changed.attrs["matchability"] = float(share[told].mean())
    return changed


def _spacing(roads: Sequence[xr.Dataset]) -> float:
    spacings = [float(r.attrs["spacing_m"]) for r in roads]
    for road, spacing in zip(roads, spacings, strict=True):
        if spacing != spacings[0]:
            raise ContractError(
                f"has points every {spacing:g} m",
                where=f"road {road.attrs['road']}",
                expected=f"{spacings[0]:g} m as road {roads[0].attrs['road']}",
                remedy="resample both with one spacing_m",
            )
    return spacings[0]
