"""Temporal models with analytic curves, made straight from the contract: truth for the reader."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from magtiles.catalog.kernels.activity_classes import ANY

ELEMENTS = ("north", "east", "down", "total")
MINUTE = np.arange(1440.0)

# Code, latitude, longitude, dip latitude, and the amplitude of each element's curve.
Station = tuple[str, float, float, float, tuple[float, float, float, float]]

MIDDLE: Station = ("MID", 44.0, 10.0, 41.2, (-20.0, 15.0, 10.0, 3.0))
SOUTH: Station = ("SOU", 20.0, 12.0, 11.3, (60.0, 5.0, -8.0, 40.0))


def bump(minute: Any) -> Any:
    """A day's curve: zero at local midnight, 1 at noon."""
    return 0.5 - 0.5 * np.cos(2.0 * np.pi * np.asarray(minute) / 1440.0)


def temporal_dataset(
    stations: Sequence[Station] = (MIDDLE, SOUTH),
    months: Sequence[str] = ("2024-02", "2024-03"),
    growth: float = 0.5,
) -> xr.Dataset:
    """Curves amplitude * bump * (1 + growth * month's index); pooled sigma and tau by a rule.

    sigma is 1 + station + 10 * (stormy) + 0.1 * element, and tau 600 s times (1 + station);
    classes: any; quiet and stormy; and stormy nights, too few.
    """
    time = np.array(months, "datetime64[M]").astype("datetime64[ns]")
    scale = 1.0 + growth * np.arange(len(months))
    amplitude = np.array([s[4] for s in stations])
    curves = amplitude[:, :, None, None] * scale[:, None] * bump(MINUTE)
    kp = np.array([ANY, 0, 1, 1], np.int8)
    local_time = np.array([ANY, ANY, ANY, 0], np.int8)
    n, station = len(stations), np.arange(len(stations))[:, None, None]
    shape = (n, 4, len(kp))
    sigma = (
        1.0 + station + 10.0 * (kp == 1) + 100.0 * (local_time == 0)
        + 0.1 * np.arange(4)[:, None]
    )  # fmt: skip
    counts = np.broadcast_to(np.array([480, 400, 80, 12], np.int32), shape)
    segment = np.array("2024-02-01", "datetime64[ns]") + np.arange(480) * np.timedelta64(3, "h")
    per_segment = np.ones((n, 4, segment.size), np.float32)
    of_segment, of_class = (
        ("observatory", "element", "segment"),
        ("observatory", "element", "class"),
    )
    s, nt = {"units": "s"}, {"units": "nT"}
    fits: dict[str, Any] = {}
    for end in ("", "_low", "_high", "_autocorrelation"):
        fits["sigma" + end] = (of_segment, 5.0 * per_segment, nt)
        fits["tau" + end] = (of_segment, 900.0 * per_segment, s)
    of_minute = ("observatory", "element", "month", "minute")
    return xr.Dataset(
        {
            "iaga_code": ("observatory", np.array([s[0] for s in stations])),
            "latitude": ("observatory", [s[1] for s in stations], {"units": "degrees_north"}),
            "longitude": ("observatory", [s[2] for s in stations], {"units": "degrees_east"}),
            "elevation": ("observatory", np.zeros(n), {"units": "m"}),
            "dip_latitude": ("observatory", [s[3] for s in stations], {"units": "degree"}),
            "element": ("element", np.array(ELEMENTS)),
            "month": ("month", time),
            "minute": ("minute", MINUTE, {"units": "min"}),
            "baseline": (of_minute, curves, nt),
            "baseline_standard_error": (of_minute, np.full(curves.shape, 0.5), nt),
            "quiet_day": (
                ("observatory", "month", "rank"),
                np.broadcast_to(_quiet_days(time), (n, len(months), 5)),
            ),
            "quiet_day_choice": (
                ("observatory", "month"),
                np.ones((n, len(months)), np.uint8),
                {"flag_masks": np.array([1, 2, 4], np.uint8), "flag_meanings": "list kp data"},
            ),
            "segment_start": ("segment", segment),
            "kp": ("segment", np.full(segment.size, 1.0), {"units": "1"}),
            **fits,
            "tau_unidentified": (of_segment, np.zeros(per_segment.shape, np.uint8)),
            "class_kp": ("class", kp),
            "class_season": ("class", np.full(kp.size, ANY, np.int8)),
            "class_local_time": ("class", local_time),
            "class_segments": (of_class, counts),
            "class_sigma": (of_class, sigma, nt),
            "class_tau": (of_class, np.broadcast_to(600.0 * (1.0 + station), shape), s),
            "class_tau_unidentified": (
                of_class, np.broadcast_to(((kp == 1) & (station == 1)).astype(np.uint8), shape)
            ),
        },
        attrs={"source": "analytic curves", "segment_s": 10800.0, "cadence_s": 60.0},
    )  # fmt: skip


def _quiet_days(month: Any) -> Any:
    days = month[:, None] + np.arange(5) * np.timedelta64(3, "D")
    days[:, 4] = np.datetime64("NaT")
    return days
