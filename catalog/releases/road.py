"""The map of one road: the field along it, where a place lies on it, and likelihoods."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from functools import cached_property, lru_cache
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtiles.catalog.kernels.geodesy import metres_per_degree, wrap_longitude
from magtiles.catalog.kernels.road_match import (
    BIN_M,
    FORMS,
    LEAST_PEAK,
    LEAST_RATIO,
    METHODS,
    MINIMUM_DISTANCE_M,
    Floats,
    Form,
    Method,
    SectionMap,
    choose,
    least_samples,
    prepare,
)
from magtiles.catalog.kernels.road_near import RoadIndex, gaussian, make_index
from magtiles.catalog.releases.arguments import broadcast, check_positions, numbers, refuse
from magtiles.catalog.releases.road_answers import Feature, Match, Nearest, SectionLikelihood
from magtiles.catalog.releases.road_file import RoadData
from magtiles.schemas.errors import QueryError

_PREPARED = 8
"""Combinations of form and noise that a road keeps prepared."""


class Road:
    """The map of one road, driven in one direction, from `Release.roads`.

    Field and uncertainty are nT in the vehicle's frame (forward, right, down), linear between
    points; sections are successive samples at the map's own spacing in the order of driving.
    A road may be shared between threads.

    Attributes
    ----------
    name, direction, calibrated, spacing_m, length_m : of the map; a backward map was driven
        against the road's distance.
    vehicles : that it was made with.
    matchability : of the whole road, 0 to 1, or None (see docs/matching.md).
    variables : all arrays by name, as in the file; read-only.
    attributes : of the file.
    """

    def __init__(self, name: str, data: RoadData) -> None:
        self.name = name
        self.variables: Mapping[str, NDArray[Any]] = data.variables
        self.attributes: Mapping[str, Any] = data.attributes
        self.direction = str(data.attributes["direction"])
        self.calibrated = data.attributes["calibrated"] == "true"
        self.spacing_m = float(data.attributes["spacing_m"])
        self.length_m = float(np.ptp(data.variables["distance"]))
        self.vehicles: tuple[str, ...] = tuple(data.variables["vehicle_name"].tolist())
        whole = data.attributes.get("matchability")
        self.matchability = None if whole is None else float(whole)
        self._driven = np.s_[::-1] if self.direction == "backward" else np.s_[:]
        self._section_map = lru_cache(_PREPARED)(self._prepare)
        self._gaussian = lru_cache(_PREPARED)(self._prepare_gaussian)

    @property
    def distance(self) -> Floats:
        """Of the map's points (n,), m, ascending."""
        return self.variables["distance"]

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """Stretches that stand out, in order."""
        if "feature_peak" not in self.variables:
            return ()
        names = (f.name for f in fields(Feature))
        columns = [self.variables[f"feature_{name}"].tolist() for name in names]
        return tuple(Feature(*row) for row in zip(*columns, strict=True))

    def field(self, distance: ArrayLike) -> Floats:
        """Field (..., 3), nT, at distances (...), m; NaN off the ends of the road."""
        return self._linear(distance, self._field)

    def uncertainty(self, distance: ArrayLike) -> Floats:
        """1 sigma (..., 3), nT, of the field at distances (...), m; NaN off the ends."""
        return self._linear(distance, self._sigma)

    def position(self, distance: ArrayLike) -> tuple[Floats, Floats]:
        """Latitude and longitude (...), degrees, at distances (...), m; NaN off the ends."""
        found = self._linear(distance, self._line)
        return found[..., 0], wrap_longitude(found[..., 1])

    def nearest(self, latitude: ArrayLike, longitude: ArrayLike) -> Nearest:
        """The nearest place on the road to each position, degrees; shape (...,).

        It is on one of the two lines at the nearest point of the map. NaN gives NaN; a
        latitude beyond 90 degrees or an infinite longitude raises QueryError.
        """
        from magtiles.catalog.kernels import road_near_compiled as kernels

        shape, (lat, lon) = broadcast(latitude=latitude, longitude=longitude)
        place, offset = np.empty(lat.size), np.empty(lat.size)
        arguments: Any = (*self._index_arrays, lat, lon, place, offset)
        if kernels.nearest(*arguments) >= 0:
            check_positions(shape, lat, lon)
        return Nearest(self._distance_of(place).reshape(shape)[()], offset.reshape(shape)[()])

    def section(self, distance: float, samples: int) -> Floats:
        """The map's own section (samples, 3), nT, whose last sample lies at a distance, m.

        Raises QueryError where it would begin before the road or end after it.
        """
        back = -self.spacing_m if self.direction == "forward" else self.spacing_m
        found = self.field(distance + back * np.arange(samples)[::-1])
        if not np.isfinite(found).all():
            raise QueryError(
                f"{samples} samples up to {distance:g} m are not all on the road",
                where=f"road {self.name}",
                expected=f"{self.distance[0]:g} to {self.distance[-1]:g} m",
            )
        return found

    def log_likelihood(
        self,
        section: ArrayLike,
        *,
        form: Form = "measured",
        noise_nt: float = 0.0,
        within: tuple[float, float] | None = None,
    ) -> SectionLikelihood:
        """How likely a measured section is at every point of the map, or in a window of it.

        Shockley (2012) eq. 2.49: variances are the map's and the noise's, added.

        Parameters
        ----------
        section : (K, 3) or (3,), nT, at the map's spacing in the order of driving.
        form : "measured", "demeaned" or "differenced" samples are compared.
        noise_nt : 1 sigma of each measured sample, beyond the map's uncertainty.
        within : least and greatest distance of the last sample, m.

        Raises QueryError for a section of another shape, not finite or longer than the map, a
        form that is none, or a window without a place for it.
        """
        samples = self._samples(section, form)
        start, stop = self._window(len(samples), within)
        found = self._section_map(form, self._noise(noise_nt)).log_likelihood(samples, start, stop)
        last = np.arange(start, stop, dtype=np.float64) + (len(samples) - 1)
        if self.direction == "backward":
            last, found = last[::-1], found[::-1]
        return SectionLikelihood(self._distance_of(last), found)

    def match(
        self,
        section: ArrayLike,
        *,
        method: Method = "ml",
        form: Form = "measured",
        noise_nt: float = 0.0,
        within: tuple[float, float] | None = None,
        least_ratio: float = LEAST_RATIO,
        minimum_distance_m: float = MINIMUM_DISTANCE_M,
        bin_m: float = BIN_M,
        least_peak: float = LEAST_PEAK,
    ) -> Match:
        """Where on the road a section was measured, if the method can tell (Shockley 2012, 4.3).

        "ml": the most likely place. "mlr": that, if it is `least_ratio` times as likely as any
        other at least `minimum_distance_m` away. "abl": the centre of the bin of `bin_m` that
        holds most of the likelihood, if the greatest holds `least_peak` of all.

        The rest is as of `log_likelihood`. Raises QueryError as that, and for another method.
        """
        if method not in METHODS:
            raise QueryError(
                f"is {method!r}", where="method", expected=f"one of {', '.join(METHODS)}"
            )
        samples = self._samples(section, form)
        start, stop = self._window(len(samples), within)
        found = self._section_map(form, self._noise(noise_nt)).log_likelihood(samples, start, stop)
        last = slice(start + len(samples) - 1, stop + len(samples) - 1)
        choice = choose(
            found, self._plane[last], self._run[last],
            minimum_distance_m=minimum_distance_m,
            bin_points=max(1, round(bin_m / self.spacing_m)),
        )  # fmt: skip
        index = choice.index(method, least_ratio=least_ratio, least_peak=least_peak)
        likely = float(found[choice.best if index < 0 else index])
        if index < 0:
            return Match(np.nan, np.nan, np.nan, likely, choice.ratio, choice.peak)
        distance = float(self._distance_of(np.array(last.start + index, np.float64)))
        latitude, longitude = self.position(distance)
        return Match(distance, float(latitude), float(longitude), likely, choice.ratio, choice.peak)

    def log_likelihood_at(
        self,
        latitude: ArrayLike,
        longitude: ArrayLike,
        section: ArrayLike,
        *,
        noise_nt: float = 0.0,
        lateral_sigma_m: float = np.inf,
    ) -> Floats:
        """How likely a section is that ends at each position: the update of a particle filter.

        Each position counts as the nearest place on the road (Shockley 2012, 5.1). With
        `lateral_sigma_m` its distance from there counts too, as a Gaussian without its constant
        (the paper: 6 m). Between the map's points the field, one over the variance, and the
        variance's logarithm are linear.

        Parameters
        ----------
        latitude, longitude : (...) degrees of each particle.
        section : (3,) or (K, 3) nT, as of `log_likelihood`; its last sample is measured here.
        noise_nt : as of `log_likelihood`; what a new one needs is prepared at its first use.

        Returns
        -------
        Logarithms, (...,). NaN where a coordinate is NaN, or a section would begin before the
        road. Raises QueryError as `nearest` and `log_likelihood`.
        """
        from magtiles.catalog.kernels import road_near_compiled as kernels

        if not lateral_sigma_m > 0.0:
            raise QueryError(f"is {lateral_sigma_m!r}", where="lateral_sigma_m", expected="> 0")
        samples = self._samples(section, "measured")
        shape, lat, lon = _flat(latitude, longitude)
        answer = np.empty(lat.size)
        values = self._gaussian(self._noise(noise_nt))
        arguments: Any = (
            *self._index_arrays, lat, lon, values, samples, lateral_sigma_m**-2.0, answer
        )  # fmt: skip
        if kernels.log_likelihood(*arguments) >= 0:
            check_positions(shape, lat, lon)
        return answer.reshape(shape)[()]

    def __repr__(self) -> str:
        return f"<Road {self.name}, {self.length_m:g} m every {self.spacing_m:g} m>"

    @cached_property
    def _field(self) -> Floats:
        return self.variables["field_body"].astype(np.float64)

    @cached_property
    def _sigma(self) -> Floats:
        return self.variables["field_body_uncertainty"].astype(np.float64)

    @cached_property
    def _unwrapped(self) -> Floats:
        unwrapped: Floats = np.unwrap(self.variables["longitude"], period=360.0)
        return unwrapped

    @cached_property
    def _line(self) -> Floats:
        """Latitude and unwrapped longitude, (n, 2)."""
        return np.column_stack([self.variables["latitude"], self._unwrapped])

    @cached_property
    def _height(self) -> float:
        height = self.variables["height"]
        known = height[np.isfinite(height)]
        return float(known.mean()) if known.size else 0.0

    @cached_property
    def _plane(self) -> Floats:
        """Metres north and east of the middle of the road, (n, 2), in the order of driving."""
        latitude = self.variables["latitude"]
        north, east = metres_per_degree(latitude, self._height)
        y = (latitude - latitude.mean()) * north.mean()
        x = (self._unwrapped - self._unwrapped.mean()) * east.mean()
        return np.ascontiguousarray(np.column_stack([y, x])[self._driven])

    @cached_property
    def _run(self) -> NDArray[np.int64]:
        return np.zeros(self.distance.size, np.int64)

    @cached_property
    def _index_arrays(self) -> Any:
        index = make_index(
            self.variables["latitude"][self._driven],
            self.variables["longitude"][self._driven],
            self._height,
        )
        return tuple(getattr(index, f.name) for f in fields(RoadIndex))

    def _prepare(self, form: Form, noise: float) -> SectionMap:
        return prepare(self._field[self._driven], self._variance(noise), form)

    def _prepare_gaussian(self, noise: float) -> Floats:
        return gaussian(self._field[self._driven], self._variance(noise))

    def _variance(self, noise: float) -> Floats:
        variance: Floats = self._sigma[self._driven] ** 2 + noise**2
        return variance

    def _distance_of(self, place: Floats) -> Floats:
        """Metres along the road of places counted in points from where driving begins."""
        if self.direction == "backward":
            return float(self.distance[-1]) - self.spacing_m * place
        return float(self.distance[0]) + self.spacing_m * place

    def _linear(self, distance: ArrayLike, values: Floats) -> Floats:
        """Values (n, k) at distances (...,): (..., k)."""
        at = numbers("distance", distance)
        refuse(np.isinf(at).ravel(), at.shape, "distance", at.ravel(), "finite metres, or NaN")
        place = (at - self.distance[0]) / self.spacing_m
        last = len(values) - 1
        # Rounding must not put an end of the road off it.
        inside = (place >= -1e-6) & (place <= last + 1e-6)
        place = np.clip(np.where(inside, place, 0.0), 0.0, last)
        i = np.minimum(place.astype(np.intp), last - 1)
        t = (place - i)[..., None]
        found = (1.0 - t) * values[i] + t * values[i + 1]
        return np.where(inside[..., None], found, np.nan)

    def _samples(self, section: ArrayLike, form: Form) -> Floats:
        if form not in FORMS:
            raise QueryError(f"is {form!r}", where="form", expected=f"one of {', '.join(FORMS)}")
        if _is_whole(section, least_samples(form)):
            return section.reshape(-1, 3)
        samples = np.ascontiguousarray(np.atleast_2d(numbers("section", section)))
        least = least_samples(form)
        if samples.ndim != 2 or samples.shape[1] != 3 or len(samples) < least:
            raise QueryError(
                f"has the shape {np.shape(section)}",
                where="section",
                expected=f"(K, 3) nT, {least} or more {form} samples",
            )
        refuse(
            ~np.isfinite(samples).ravel(), samples.shape, "section", samples.ravel(), "finite nT"
        )
        return samples

    def _noise(self, noise_nt: float) -> float:
        if not 0.0 <= noise_nt < np.inf:
            raise QueryError(f"is {noise_nt!r}", where="noise_nt", expected="0 or more, finite")
        return float(noise_nt)

    def _window(self, samples: int, within: tuple[float, float] | None) -> tuple[int, int]:
        """First and one past the last start of a section, in points from where driving begins."""
        start, stop = 0, self.distance.size - samples + 1
        if within is not None:
            ends = np.array(within, np.float64)
            if self.direction == "backward":
                ends = (self.distance[-1] - ends[::-1]) / self.spacing_m
            else:
                ends = (ends - self.distance[0]) / self.spacing_m
            if not np.isfinite(ends).all():
                raise QueryError(f"is {within!r}", where="within", expected="two finite distances")
            start = max(start, int(np.ceil(ends[0] - 1e-6)) - samples + 1)
            stop = min(stop, int(np.floor(ends[1] + 1e-6)) - samples + 2)
        if start >= stop:
            raise QueryError(
                f"no place for {samples} samples",
                where=f"road {self.name}" if within is None else f"within {within}",
                expected=f"room on {self.distance[0]:g} to {self.distance[-1]:g} m",
            )
        return start, stop


def _flat(latitude: ArrayLike, longitude: ArrayLike) -> tuple[tuple[int, ...], Floats, Floats]:
    """Broadcast positions; plain arrays of one shape are taken as they are."""
    if (
        type(latitude) is np.ndarray
        and type(longitude) is np.ndarray
        and latitude.dtype == longitude.dtype == np.float64
        and latitude.shape == longitude.shape
    ):
        return latitude.shape, latitude.reshape(-1), longitude.reshape(-1)
    shape, (lat, lon) = broadcast(latitude=latitude, longitude=longitude)
    return shape, lat, lon


def _is_whole(section: ArrayLike, least: int) -> TypeGuard[Floats]:
    """Whether a section is at once what the kernels take: most are, 50 times a second."""
    return (
        type(section) is np.ndarray
        and section.dtype == np.float64
        and section.shape[-1:] == (3,)
        and section.ndim <= 2
        and section.size >= 3 * least
        and section.flags.c_contiguous
        and math.isfinite(section.sum())
    )
