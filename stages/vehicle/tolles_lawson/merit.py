"""How well a compensation does: figure of merit and improvement ratio."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.vehicle.tolles_lawson.manoeuvres import Manoeuvre, heading_groups, mark

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Merit:
    """What manoeuvres do to a signal.

    Attributes
    ----------
    figure_nt : peak to peak over each manoeuvre, averaged over repetitions and summed over axes
        and headings: twelve for roll, pitch and yaw on four headings (Sheriff 2002, "figure of
        merit"; Geological Survey of Canada 1991).
    manoeuvres : how many kinds and headings are in the sum.
    noise_nt : standard deviation over all manoeuvres.
    """

    figure_nt: float
    manoeuvres: int
    noise_nt: float


def measure(signal: Floats, found: list[Manoeuvre]) -> Merit:
    """Merit of a band-passed signal (time,), nT; at least one manoeuvre.

    Manoeuvres of unknown kind each count alone.
    """
    swings: dict[tuple[str, int], list[float]] = {}
    for number, (one, heading) in enumerate(zip(found, heading_groups(found), strict=True)):
        key = (one.kind, number if one.kind == "unknown" else heading)
        swings.setdefault(key, []).append(float(np.ptp(signal[one.start : one.stop])))
    noise = float(np.std(signal[mark(found, signal.size)]))
    return Merit(sum(float(np.mean(v)) for v in swings.values()), len(swings), noise)
