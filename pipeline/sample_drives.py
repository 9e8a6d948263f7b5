"""The sample's drives: four vehicles over a parking lot, a loop, a road and a suburb, as files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from magtiles.pipeline.road_paths import Route, through, turn
from magtiles.pipeline.road_truth import Furniture, Passing, Road
from magtiles.pipeline.ros_log import write_ros_log
from magtiles.pipeline.sample_vehicles import (
    CAR,
    REFERENCE,
    SUV,
    TRUCK,
    Drive,
    Vehicle,
    record,
    stepped,
)
from magtiles.stages.release.atomic import atomic_path

Floats = NDArray[np.float64]

DATE = "2024-05-06"
MAPPING = (TRUCK, SUV, CAR)
VEHICLES = (*MAPPING, REFERENCE)
PASSES = 3

_LANE_M, _U_TURN_M = 3.5, 6.0
_BULB = float(np.degrees(np.arccos(0.5 * (_LANE_M / (2.0 * _U_TURN_M) + 1.0))))
_U_TURN = (  # swings right, then round to the left into the other lane
    turn(_BULB, _U_TURN_M),
    turn(-180.0 - 2.0 * _BULB, _U_TURN_M),
    turn(_BULB, _U_TURN_M),
)

LOT = Road(
    Route(
        "calibration", 45.86, -121.40, 300.0, 0.0,
        ((30.0, 0.0), turn(-3 * 360.0, 6.0), (150.0, 0.0), turn(90.0, 15.0), (120.0, 0.0)),
        11.0, lateral_m_s2=0.8,
    ),
    Furniture(start_m=240.0), DATE, 1,
)  # fmt: skip
"""Three circles on a clean lot, then a street."""

LOOP = Road(
    Route(
        "loop", 45.90, -121.50, 310.0, 90.0,
        tuple(
            through(((0, 0), (0, 225), (-250, 225), (-250, -225), (0, -225), (0, 0)), 25.0)
        ),
        11.0, ((600.0, 70.0),),
    ),
    Furniture(bridges=((950.0, 985.0),)), DATE, 2,
    (Passing("suv", 2, 300.0), Passing("car", 3, 1120.0)),
)  # fmt: skip
"""Once around, with a traffic light and a bridge."""

ROAD = Road(
    Route(
        "road", 45.98, -121.30, 290.0, 70.0,
        (
            (900.0, 0.0), turn(20.0, 800.0), (700.0, 0.0),
            *_U_TURN,
            (700.0, 0.0), turn(-20.0, 800.0 + _LANE_M), (900.0, 0.0),
        ),
        18.0, ((450.0, 45.0), (3300.0, 45.0)),
    ),
    Furniture(end_m=1900.0, bridges=((1000.0, 1030.0), (1550.0, 1575.0))), DATE, 3,
    (Passing("truck", 1, 1300.0), Passing("car", 2, 2900.0)),
)  # fmt: skip
"""Out in one lane, a U-turn, and back in the other."""

SUBURB = Road(
    Route(
        "suburb", 46.05, -121.62, 320.0, 90.0,
        tuple(
            through(
                (
                    (0, 0), (0, 300), (150, 300), (150, 0), (300, 0), (300, 300),
                    (0, 300), (0, 150), (300, 150), (300, 0), (0, 0),
                ),
                8.0,
            )
        ),
        9.0, ((735.0, 15.0), (1650.0, 15.0)),
    ),
    Furniture(), DATE, 4, (Passing("truck", 2, 1000.0),),
)  # fmt: skip
"""Three streets east and west crossed by three north and south."""

ROADS = (LOT, LOOP, ROAD)
"""What the sample holds unless asked for more."""

_TOML = """\
# {title}.
[source]
id = "{stem}"
kind = "track"
files = ["{stem}.mcap"]
licence = "CC0-1.0"
title = "{title}"

[log]
sensor_to_body = "forward,left,up"
lever_arm_m = {lever}
"""


def write_drives(folder: Path, roads: Iterable[Road] = ROADS) -> list[Path]:
    """Write the drives over roads as ROS 2 logs with their truth; the same bytes every time.

    A drive is ``<vehicle>-<route>-<pass>.mcap`` with its source TOML and ``-truth.nc``; the
    reference and the calibration are driven once. ``<route>-truth.nc`` is the field along each
    route, ``vehicles-truth.nc`` the calibrations. docs/sample.md describes them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [_write_netcdf(folder / "vehicles-truth.nc", vehicles_truth())]
    for road in roads:
        truth = road.truth(REFERENCE.above_m)
        paths.append(_write_netcdf(folder / f"{road.route.name}-truth.nc", truth))
        for vehicle, number in passes(road):
            paths += write_drive(folder, road, vehicle, number)
    return paths


def roads_tables(folder: str) -> list[str]:
    """The [[roads]] tables of a product of the drives in `folder`, over loop and road, as lines."""
    lines = []
    for road, split in ((LOOP, "false"), (ROAD, "true")):
        name = road.route.name
        lines += ["", "[[roads]]", f'name = "{name}"', f"split = {split}"]
        lines += ["attitude_lag_s = 0.0", "fix_lag_s = 0.0", "[roads.logs]"]
        for vehicle in MAPPING:
            logs = (f'"{folder}/{vehicle.name}-{name}-{n + 1}.toml"' for n in range(PASSES))
            lines.append(f"{vehicle.name} = [{', '.join(logs)}]")
        lines.append("[roads.calibration]")
        for vehicle in MAPPING:
            lines.append(f'{vehicle.name} = "{folder}/{vehicle.name}-{LOT.route.name}-1.toml"')
    return lines


def passes(road: Road) -> Iterator[tuple[Vehicle, int]]:
    """The drives over a road: each vehicle's, numbered from 1."""
    for vehicle in VEHICLES:
        once = road is LOT or vehicle is REFERENCE
        for number in range(1, 2 if once else PASSES + 1):
            yield vehicle, number


def start_of(road: Road, vehicle: Vehicle, number: int) -> np.datetime64:
    """When a drive begins: passes on days of their own, vehicles and roads hours apart."""
    hours = 24 * (number - 1) + 12 + vehicle.seed
    return np.datetime64(DATE, "m") + np.timedelta64(60 * hours + 15 * (road.seed - 1), "m")


def vehicles_truth() -> xr.Dataset:
    """Calibration of each vehicle: field = matrix @ (raw - bias), raw = distortion @ field + bias.

    Matrices are (vehicle, axis, raw_axis) and (vehicle, raw_axis, axis), the bias nT; axes
    forward, right, down.
    """
    square = ("vehicle", "axis", "raw_axis")
    metres = {"units": "m"}
    variables: dict[str, Any] = {
        "matrix": (square, np.stack([v.matrix for v in VEHICLES]), {"units": "1"}),
        "bias": (("vehicle", "raw_axis"), [v.hard_iron_nt for v in VEHICLES], {"units": "nT"}),
        "distortion": (
            ("vehicle", "raw_axis", "axis"),
            np.stack([v.distortion for v in VEHICLES]),
            {"units": "1"},
        ),
        "noise": ("vehicle", [v.noise_nt for v in VEHICLES], {"units": "nT"}),
        "height_above_road": ("vehicle", [v.above_m for v in VEHICLES], metres),
        "lever_arm": (("vehicle", "axis"), [v.lever_m for v in VEHICLES], metres),
        "speed_scale": ("vehicle", [v.speed_scale for v in VEHICLES], {"units": "1"}),
    }
    axes = ["forward", "right", "down"]
    coords = {"vehicle": [v.name for v in VEHICLES], "axis": axes, "raw_axis": axes}
    return xr.Dataset(variables, coords, {"title": "true calibrations of the sample vehicles"})


def write_drive(folder: Path, road: Road, vehicle: Vehicle, number: int) -> list[Path]:
    """Write one drive: its log, source TOML and truth."""
    stem = f"{vehicle.name}-{road.route.name}-{number}"
    made = record(road, vehicle, number, start_of(road, vehicle, number))
    log, toml = folder / f"{stem}.mcap", folder / f"{stem}.toml"
    write_ros_log(log, made.topics)
    title = f"Synthetic drive of the {vehicle.name} over route {road.route.name}, pass {number}"
    text = _TOML.format(stem=stem, title=title, lever=list(vehicle.lever_m))
    with atomic_path(toml) as temporary:
        temporary.write_text(text, encoding="ascii")
    truth = _write_netcdf(folder / f"{stem}-truth.nc", _drive_truth(road, vehicle, made))
    return [log, toml, truth]


def _drive_truth(road: Road, vehicle: Vehicle, made: Drive) -> xr.Dataset:
    motion = made.motion
    latitude, longitude = road.route.geodetic(motion.north, motion.east)
    about = "at the sensor, without the vehicle's own field and noise"
    columns: dict[str, Any] = {
        "distance": (motion.distance, "m", "along the middle of the lane"),
        "offset": (motion.offset, "m", "to the right of the middle of the lane"),
        "speed": (motion.speed, "m s-1", "over the ground"),
        "heading": (np.degrees(motion.heading) % 360.0, "degree", "clockwise from north"),
        "field_body": (made.field_body, "nT", about),
        "disturbance": (made.disturbance, "nT", "magnitude of passing trucks' field"),
        "latitude": (latitude, "degrees_north", "of the sensor"),
        "longitude": (longitude, "degrees_east", "of the sensor"),
    }
    variables = {
        name: (
            ("time", "axis")[: values.ndim],
            _shortened(name, values),
            {"units": unit, "long_name": about},
        )
        for name, (values, unit, about) in columns.items()
    }
    height = road.route.height_m + vehicle.above_m
    return xr.Dataset(
        variables,
        coords={"time": made.time},
        attrs={
            "title": f"truth of a drive of the {vehicle.name} over route {road.route.name}",
            "height": height,
            "height_reference": "ellipsoid",
        },
    )


def _shortened(name: str, values: Floats) -> NDArray[Any]:
    """Rounded to 0.1 mm for degrees, else to a thousandth or, of nT, an eighth: it packs well."""
    if name in ("latitude", "longitude"):
        return stepped(values, 2.0**-30)
    step = 2.0**-3 if name in ("field_body", "disturbance") else 2.0**-10
    return stepped(values, step).astype(np.float32)


def _write_netcdf(path: Path, dataset: xr.Dataset) -> Path:
    packing = {"zlib": True, "complevel": 1, "shuffle": True}
    encoding: dict[Any, Any] = {
        name: packing if variable.size > 100 else {} for name, variable in dataset.variables.items()
    }
    for options in encoding.values():
        options["_FillValue"] = None
    with atomic_path(path) as temporary:
        dataset.to_netcdf(temporary, engine="netcdf4", format="NETCDF4", encoding=encoding)
    return path
