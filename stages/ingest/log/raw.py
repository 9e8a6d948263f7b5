"""What every log reader hands over: streams with their own times, as the log has them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtiles.stages.vehicle.positions import Attitudes, Fixes, Real, Times


@dataclass(frozen=True)
class FieldSamples:
    """The field as the sensor gave it, in order of recording.

    Attributes
    ----------
    time : (n,) of the log's clock.
    values : (n, 3) in the sensor's axes, or (n,) total, in `unit`.
    unit : None where the format does not say.
    topic : what the log calls it.
    restamped : (n,) where the sample had no time of its own and got that of its recording.
    sigma : (3,) 1 sigma that the log states, in `unit`; None where it states none.
    """

    time: Times
    values: Real
    unit: str | None
    topic: str
    restamped: NDArray[np.bool_] | None = None
    sigma: Real | None = None


@dataclass(frozen=True)
class Speeds:
    """Speed over ground (n,), m/s, in order of time."""

    time: Times
    speed: Real


@dataclass(frozen=True)
class RawLog:
    """A log as read, before the conventions of magtiles.

    Attributes
    ----------
    samples : those of the field, that become the rows of the track.
    fixes, attitudes, speeds : None where the log has none.
    clock : ``utc``, or ``boot`` where times count from no known instant.
    height_reference : what the format's heights count from; None where it does not say.
    rows : what the log has for every sample itself (n,), by its name in track/1: `latitude`,
        `longitude`, `height`, `speed`, `line`, `flight`, ...
    row_attrs : attributes of those of `rows` that track/1 does not define.
    run : (n,) changes wherever samples do not follow those before them, as at a survey's next
        line; None of a logger's own record, by one clock.
    attrs : notes for the track's attributes.
    """

    samples: FieldSamples
    fixes: Fixes | None = None
    attitudes: Attitudes | None = None
    speeds: Speeds | None = None
    clock: Literal["utc", "boot"] = "utc"
    height_reference: str | None = None
    rows: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    row_attrs: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    run: NDArray[np.int64] | None = None
    attrs: Mapping[str, Any] = field(default_factory=dict)


def rising(time: Times) -> NDArray[np.intp]:
    """Indices that put times in order and leave each once, the first of its kind."""
    return np.unique(time, return_index=True)[1]
