"""Which passes may be merged: what they must agree in, and what must be new."""

from __future__ import annotations

from collections.abc import Sequence

import xarray as xr

from magtiles.schemas.errors import ContractError

_MEANING = {
    "road": "the road",
    "spacing_m": "the spacing",
    "frame": "the frame",
    "calibrated": "'calibrated'",
    "direction": "the direction",
    "height_reference": "what heights count from",
}


def check_passes(passes: Sequence[xr.Dataset], road: xr.Dataset | None) -> None:
    """Raise ContractError, naming the pass, unless all may be merged (into `road`)."""
    if road is None and len(passes) < 2:
        raise ContractError(
            "there is one pass",
            where="passes",
            expected="two at least, or a road to add one to",
        )
    for one in passes:
        _check_single(one, road)
    datasets = [*passes] if road is None else [road, *passes]
    for other in datasets[1:]:
        _check_alike(datasets[0], other)
    _check_new(datasets)
    _check_vehicles(datasets)


def _name(dataset: xr.Dataset) -> str:
    first, *others = (str(name) for name in dataset["pass_name"].values)
    return f"pass '{first}'" if not others else f"the map of '{first}' and {len(others)} others"


def _shown(value: object) -> str:
    return f"'{value}'" if isinstance(value, str) else f"{value:g}"


def _check_single(one: xr.Dataset, road: xr.Dataset | None) -> None:
    if one.sizes["pass"] == 1:
        return
    held = set(one["pass_digest"].values)
    same = road is not None and held == set(road["pass_digest"].values)
    raise ContractError(
        "the map would be updated with itself"
        if same
        else f"a map of {len(held)} passes is given as one pass",
        where="passes",
        expected="single passes, from resample-by-distance",
        remedy="give the map as road, and as passes what it does not hold",
    )


def _check_alike(first: xr.Dataset, other: xr.Dataset) -> None:
    for key, meaning in _MEANING.items():
        if first.attrs[key] != other.attrs[key]:
            raise ContractError(
                f"{meaning} of {_name(first)} is {_shown(first.attrs[key])}, of {_name(other)} "
                f"{_shown(other.attrs[key])}",
                where=f"passes attrs.{key}",
                expected="the same in all",
                remedy="calibrate all passes, or none"
                if key == "calibrated"
                else "resample them alike, or make a map of each",
            )


def _check_new(datasets: Sequence[xr.Dataset]) -> None:
    seen: dict[str, str] = {}
    for dataset in datasets:
        for digest, name in zip(
            dataset["pass_digest"].values, dataset["pass_name"].values, strict=True
        ):
            if digest in seen:
                raise ContractError(
                    f"pass '{name}' has the samples of pass '{seen[digest]}'",
                    where="passes",
                    expected="each pass once",
                    remedy="leave it out: it would count twice",
                )
            seen[str(digest)] = str(name)


def _check_vehicles(datasets: Sequence[xr.Dataset]) -> None:
    if datasets[0].attrs["calibrated"] == "true":
        return
    vehicles = sorted({str(n) for d in datasets for n in d["vehicle_name"].values})
    if len(vehicles) > 1:
        raise ContractError(
            f"uncalibrated passes of different vehicles ({', '.join(vehicles)})",
            where="passes",
            expected="one vehicle, or calibrated passes: the mean of two vehicles' own fields "
            "is the field of none",
            remedy="run apply-calibration before resample-by-distance",
        )
