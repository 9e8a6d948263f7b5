"""Stage ``match-road``: how well other passes are found on road maps, by every method."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr

from magtiles.catalog.kernels.road_match import (
    BIN_M,
    FORMS,
    LEAST_PEAK,
    LEAST_RATIO,
    METHODS,
    MINIMUM_DISTANCE_M,
    Floats,
    Form,
    least_samples,
)
from magtiles.schemas.errors import ContractError
from magtiles.stages.declare import Many, Params, Stage, quantity
from magtiles.stages.road.match_features import FEATURE_METHODS, feature_misses
from magtiles.stages.road.matchability import with_matchability
from magtiles.stages.road.network import LocalPlane, Network, driven

BOUNDS_M = (3.0, 10.0, 20.0)
"""The paper's classes of miss distance (figures 4.8 to 4.23)."""
OFF_MAP_M = 20.0
"""A section that ends farther than this from every map point has no right answer."""


class MatchRoadParams(Params):
    """Parameters of match-road."""

    section_m: tuple[float, ...] = quantity(
        "m", default=(0.0, 3.0), min_length=1, doc="Lengths of sections; 0 is a single epoch."
    )
    same_vehicle_nt: float = quantity(
        "nT", default=266.0, gt=0, doc="1 sigma of a sample, map and section of one vehicle."
    )
    cross_vehicle_nt: float = quantity(
        "nT", default=719.0, gt=0, doc="1 sigma of a sample, map and section of different vehicles."
    )
    least_ratio: float = quantity(
        "1", default=LEAST_RATIO, ge=1, doc="MLR: how many times as likely as any other place."
    )
    minimum_distance_m: float = quantity(
        "m", default=MINIMUM_DISTANCE_M, gt=0, doc="MLR: how far another place is at least."
    )
    bin_m: float = quantity("m", default=BIN_M, gt=0, doc="ABL: length of a bin.")
    least_peak: float = quantity(
        "1", default=LEAST_PEAK, gt=0, lt=1, doc="ABL: least normalised likelihood of the peak."
    )
    feature_rms: float = quantity(
        "1", default=1.0, gt=0, doc="Features: greatest misfit by RSS, in sigma."
    )


@dataclass
class Case:
    """Misses, m, of one combination; NaN where the method told nothing."""

    key: dict[str, Any]
    misses: list[float] = field(default_factory=list)


def match_road(
    road: Sequence[xr.Dataset], section: Sequence[xr.Dataset], *, params: MatchRoadParams
) -> xr.Dataset:
    """Match every section of other passes with maps, and count how far off the answers are.

    Maps of one vehicle (or the same several), spacing and state of calibration are searched
    together; a map never meets a pass that it holds. Likelihoods are those of Shockley (2012,
    eq. 2.51) with one sigma for all samples, methods those of his 4.3, forms and features of
    4.6; the miss is the horizontal distance between where the map has the section's last sample
    and where the pass has it.

    Parameters
    ----------
    road : road-map/1, the maps.
    section : road-map/1, passes of any vehicle resampled like the maps.

    Returns
    -------
    match-report/1. `percent_within` (case, bound) counts answers within 3, 10 and 20 m among
    those given, `percent_available` the answers given among all sections.

    Raises ContractError for a pass that no map fits in spacing and calibration, or that only
    maps which hold it do.
    """
    plane = LocalPlane.around(road)
    cases: dict[tuple[Any, ...], Case] = {}
    for one in section:
        groups = list(_groups(road, one))
        if not groups:
            raise _no_partner(road, one)
        for maps in groups:
            pair = _pair(maps[0], one)
            sigma = params.same_vehicle_nt if _same_vehicle(pair) else params.cross_vehicle_nt
            for key, misses in _examine(maps, one, plane, sigma, params):
                whole = pair | key
                case = cases.setdefault(tuple(whole.values()), Case(whole))
                case.misses.extend(misses)
    return _report(list(cases.values()), _told_apart(road), params)


def _groups(roads: Sequence[xr.Dataset], one: xr.Dataset) -> Iterator[list[xr.Dataset]]:
    """Maps that belong together and fit a pass, without those that hold it."""
    groups: dict[str, list[xr.Dataset]] = {}
    own = set(one["pass_digest"].values.tolist())
    for road in roads:
        fits = all(road.attrs[key] == one.attrs[key] for key in ("spacing_m", "calibrated"))
        if fits and not own & set(road["pass_digest"].values.tolist()):
            groups.setdefault(_vehicles(road), []).append(road)
    yield from groups.values()


def _no_partner(roads: Sequence[xr.Dataset], one: xr.Dataset) -> ContractError:
    said = {"true": "calibrated", "false": "uncalibrated"}
    name = str(one["pass_name"].values[0])
    own = f"{said[one.attrs['calibrated']]}, every {one.attrs['spacing_m']:g} m"
    held = {f"{said[r.attrs['calibrated']]}, every {r.attrs['spacing_m']:g} m" for r in roads}
    if own in held:
        return ContractError(
            "every map that fits it already holds it",
            where=f"pass {name} (role section)",
            expected="a pass that the map was not made of",
        )
    return ContractError(
        f"is {own}",
        where=f"pass {name} (role section)",
        expected=f"as a map: {'; '.join(sorted(held))}",
        remedy="calibrate both or none, and resample both with one spacing_m",
    )


def _told_apart(roads: Sequence[xr.Dataset]) -> list[xr.Dataset]:
    """The roads with their matchability among those that they are searched with."""
    groups: dict[tuple[str, str], list[int]] = {}
    for i, road in enumerate(roads):
        groups.setdefault((_vehicles(road), road.attrs["calibrated"]), []).append(i)
    made = list(roads)
    for chosen in groups.values():
        alike = with_matchability([roads[i] for i in chosen])
        for i, road in zip(chosen, alike, strict=True):
            made[i] = road
    return made


def _vehicles(road: xr.Dataset) -> str:
    return "+".join(sorted(map(str, road["vehicle_name"].values)))


def _pair(road: xr.Dataset, one: xr.Dataset) -> dict[str, Any]:
    return {
        "map_vehicle": _vehicles(road),
        "section_vehicle": _vehicles(one),
        "calibrated": int(road.attrs["calibrated"] == "true"),
        "spacing": float(road.attrs["spacing_m"]),
    }


def _same_vehicle(pair: dict[str, Any]) -> bool:
    return bool(pair["map_vehicle"] == pair["section_vehicle"])


def _examine(
    maps: Sequence[xr.Dataset], one: xr.Dataset, plane: LocalPlane, sigma: float,
    params: MatchRoadParams,
) -> Iterator[tuple[dict[str, Any], list[float]]]:  # fmt: skip
    """Misses of every length, form and method; of features too where both sides have them."""
    key: dict[str, Any]
    spacing = float(one.attrs["spacing_m"])
    for length in params.section_m:
        samples = round(length / spacing) + 1
        for form in FORMS:
            if samples < least_samples(form):
                continue
            misses = _misses(maps, one, plane, sigma, form, samples, params)
            for column, method in enumerate(METHODS):
                key = {"section_length": (samples - 1) * spacing, "form": form, "method": method}
                yield key, misses[:, column].tolist()
    for form in FORMS:
        found = feature_misses(maps, one, plane, sigma, form, params.feature_rms)
        for column, name in enumerate(FEATURE_METHODS):
            if len(found):
                key = {"section_length": np.nan, "form": form, "method": name}
                yield key, found[:, column].tolist()


def _misses(
    maps: Sequence[xr.Dataset], one: xr.Dataset, plane: LocalPlane, sigma: float, form: Form,
    samples: int, params: MatchRoadParams,
) -> Floats:  # fmt: skip
    """Horizontal misses (sections, methods), m; NaN where a method tells nothing."""
    from scipy.spatial import cKDTree

    variances = [np.full(r["field_body"].shape, sigma**2) for r in maps]
    network = Network.of(maps, variances, plane, form, samples)
    if not len(network.position):
        return np.empty((0, len(METHODS)))
    values = driven(one, one["field_body"].values.astype(np.float64))
    truth = plane.metres(one)
    off = cKDTree(network.position).query(truth)[0]
    rows = []
    for last in range(samples - 1, len(values)):
        if off[last] > OFF_MAP_M:
            continue
        choice = network.choose(
            values[last - samples + 1 : last + 1],
            minimum_distance_m=params.minimum_distance_m,
            bin_points=max(1, round(params.bin_m / float(one.attrs["spacing_m"]))),
        )
        told = [
            choice.index(m, least_ratio=params.least_ratio, least_peak=params.least_peak)
            for m in METHODS
        ]
        rows.append([_miss(network.position, index, truth[last]) for index in told])
    return np.array(rows, dtype=np.float64).reshape(-1, len(METHODS))


def _miss(position: Floats, index: int, truth: Floats) -> float:
    return float("nan") if index < 0 else float(np.hypot(*(position[index] - truth)))


def _report(
    cases: Sequence[Case], roads: Sequence[xr.Dataset], params: MatchRoadParams
) -> xr.Dataset:
    """The table of all cases, and the matchability of the maps."""
    per_case, bound = ("case",), np.array(BOUNDS_M)
    misses = [np.array(case.misses, dtype=np.float64) for case in cases]
    told = [m[np.isfinite(m)] for m in misses]
    within = [[_percent(t <= b) for b in BOUNDS_M] for t in told]
    text = ("map_vehicle", "section_vehicle", "form", "method")
    variables: dict[str, Any] = {
        name: (per_case, np.array([case.key[name] for case in cases])) for name in text
    }
    variables |= {
        "calibrated": (per_case, np.array([c.key["calibrated"] for c in cases], np.int8)),
        "spacing": (per_case, np.array([c.key["spacing"] for c in cases]), {"units": "m"}),
        "section_length": (
            per_case, np.array([c.key["section_length"] for c in cases]), {"units": "m"}
        ),
        "sections": (per_case, np.array([m.size for m in misses], np.int32)),
        "percent_available": (
            per_case, np.array([_percent(np.isfinite(m)) for m in misses]), {"units": "percent"}
        ),
        "percent_within": (("case", "bound"), np.array(within), {"units": "percent"}),
        "median_miss": (
            per_case, np.array([np.median(t) if t.size else np.nan for t in told]), {"units": "m"}
        ),
        "bound": (("bound",), bound, {"units": "m"}),
        "road": (("road",), np.array([str(r.attrs["road"]) for r in roads])),
        "road_vehicle": (("road",), np.array([_vehicles(r) for r in roads])),
        "matchability": (
            ("road",), np.array([r.attrs.get("matchability", np.nan) for r in roads]),
            {"units": "1"},
        ),
    }  # fmt: skip
    attrs = {"source": "; ".join(sorted({str(r.attrs["source"]) for r in roads}))}
    sigmas = {
        "same_vehicle_nt": params.same_vehicle_nt,
        "cross_vehicle_nt": params.cross_vehicle_nt,
    }
    return xr.Dataset(variables, attrs=attrs | sigmas)


def _percent(mask: Any) -> float:
    return 100.0 * float(np.mean(mask)) if np.size(mask) else float("nan")


STAGE = Stage(
    name="match-road",
    version=1,
    params=MatchRoadParams,
    inputs={"road": Many("road-map/1"), "section": Many("road-map/1")},
    output="match-report/1",
    run=match_road,
)
