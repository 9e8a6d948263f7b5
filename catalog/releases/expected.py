"""What a magnetometer is expected to measure: the release's core field at a date, and its anomaly.

The core field is evaluated from the release's own ``core_field.shc``, whose bytes are verified
and parsed when it is first asked for; nothing is imported for it before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from magtiles.catalog.kernels.bspline import Floats
from magtiles.catalog.kernels.geodesy import metres_per_degree
from magtiles.catalog.releases.anomaly import Anomaly
from magtiles.catalog.releases.arguments import broadcast
from magtiles.catalog.releases.manifest import Manifest
from magtiles.catalog.releases.positions import Nodes
from magtiles.schemas.errors import ContractError

if TYPE_CHECKING:
    from magtiles.catalog.models import FieldModel
    from magtiles.catalog.models.dates import Date

CORE_FIELD = "core_field.shc"

_KM_PER_DEGREE = 1e-3 * 180.0 / np.pi  # from metres per degree to a radius in kilometres


class ReleaseAnomaly(Anomaly):
    """The anomaly of a release together with its core field.

    ``expected_*`` take, besides a place as `Anomaly` does, a `time` in UTC: ISO text, datetime,
    datetime64 or decimal year, scalar or array; all four broadcast to the shape ``...`` of the
    answer. Height is metres above the ellipsoid. The answer is NaN where the anomaly's is.

    The anomaly is what the measured magnitude exceeds the core field's by, at the map's own
    epoch; it is added to the core field of the date asked for.

    Raises
    ------
    ContractError : the release has no core field, or its heights count from a surface whose own
        height it does not know.
    FormatError : the core field is no model.
    QueryError : as `Anomaly`, and for a time that is none or outside the span of the core
        field; a release opened with ``allow_extrapolated=True`` goes on along the last straight
        line of its coefficients.
    """

    def __init__(
        self,
        manifest: Manifest,
        nodes: Nodes,
        allow_extrapolated: bool,
        read: Callable[[str], bytes],
    ) -> None:
        super().__init__(manifest, nodes, allow_extrapolated)
        self._read = read

    def expected_total_field(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike, time: Date
    ) -> Floats:
        """|core| + total anomaly, nT; shape (...,)."""
        place, year = self._arguments(latitude, longitude, height, time)
        anomaly = self.total(*place)
        core = self._core_vector(place, year, anomaly)
        return np.asarray(np.linalg.norm(core, axis=-1) + anomaly)[()]

    def expected_total_with_gradient(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike, time: Date
    ) -> tuple[Floats, Floats]:
        """|core| + total anomaly, nT, (...,), and its gradient north, east, down, nT/km, (..., 3).

        With B the core field and G its tensor, the gradient of |B| is B.G / |B|: at middle
        latitudes some 4 or 5 nT/km along the meridian, and 20 to 30 downward, where the field
        grows.
        """
        place, year = self._arguments(latitude, longitude, height, time)
        anomaly, slope = self.total_with_gradient(*place)
        core, tensor = self._core_with_gradient(place, year, anomaly)
        strength = np.linalg.norm(core, axis=-1)
        of_core = np.einsum("...i,...ij->...j", core, tensor) / strength[..., None]
        return np.asarray(strength + anomaly)[()], slope + of_core

    def expected_vector(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike, time: Date
    ) -> Floats:
        """Core field and anomaly vector, north, east, down, nT; shape (..., 3)."""
        place, year = self._arguments(latitude, longitude, height, time)
        anomaly = self.vector(*place)
        core = self._core_vector(place, year, anomaly[..., 0])
        return np.asarray(core + anomaly)

    def expected_vector_with_gradient(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike, time: Date
    ) -> tuple[Floats, Floats]:
        """Core field and anomaly vector, nT, (..., 3), and its gradient, nT/km, (..., 3, 3).

        As in `vector_with_gradient`, element [..., i, j] is the derivative of component i along
        axis j. The components are those along the north, east and down of each place, so that
        what the axes turn by is in it: some 8 nT/km for a field of 50,000 nT, and eastward as
        much times the tangent of latitude. The core's own tensor, in axes that stay, is symmetric
        and traceless; this is not.
        """
        place, year = self._arguments(latitude, longitude, height, time)
        anomaly, slope = self.vector_with_gradient(*place)
        core, tensor = self._core_with_gradient(place, year, anomaly[..., 0])
        return core + anomaly, slope + tensor + turning(core, place[0], place[2])

    @cached_property
    def _core(self) -> FieldModel:
        _refuse_unknown_surface(self._manifest)
        return core_field(self._manifest, self._read)

    def _arguments(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike, time: Date
    ) -> tuple[tuple[Floats, Floats, Floats], Floats]:
        """Latitude, longitude and height, and decimal year, all of the answer's shape."""
        years = self._core.years(time, allow_extrapolated=self._extrapolate)
        shape, flat = broadcast(latitude=latitude, longitude=longitude, height=height, time=years)
        lat, lon, h, year = (values.reshape(shape) for values in flat)
        return (lat, lon, h), year

    def _core_vector(self, place: tuple[Floats, ...], year: Floats, anomaly: Floats) -> Floats:
        """The core field (..., 3), nT; NaN where the `anomaly` (...) is."""
        from magtiles.catalog.models import evaluate

        known = np.isfinite(anomaly)
        lat, lon, h = (values[known] for values in place)
        vector = np.full((*known.shape, 3), np.nan)
        vector[known] = evaluate(self._core, lat, lon, h, year[known], allow_extrapolated=True)
        return vector

    def _core_with_gradient(
        self, place: tuple[Floats, ...], year: Floats, anomaly: Floats
    ) -> tuple[Floats, Floats]:
        """The core field (..., 3), nT, and its tensor (..., 3, 3), nT/km, in axes that stay."""
        from magtiles.catalog.models import evaluate

        known = np.isfinite(anomaly)
        lat, lon, h = (values[known] for values in place)
        vector, tensor = np.full((*known.shape, 3), np.nan), np.full((*known.shape, 3, 3), np.nan)
        vector[known], tensor[known] = evaluate(
            self._core, lat, lon, h, year[known], gradient=True, allow_extrapolated=True
        )
        return vector, tensor


def core_field(manifest: Manifest, read: Callable[[str], bytes]) -> FieldModel:
    """The core field of a release, parsed from the bytes that `read` gives of its file.

    Raises ContractError for a release without one, FormatError for one that is no model.
    """
    from magtiles.catalog.models import parse_model

    field = str(manifest.document["identity"]["reference_field"])
    if CORE_FIELD not in {file.path for file in manifest.files}:
        raise ContractError(
            f"has no {CORE_FIELD}; its reference field is '{field}'",
            where=_name(manifest),
            expected="the coefficients of the core field that its anomaly counts from",
            remedy="add a core field of your own to `total` or `vector`",
        )
    text = read(CORE_FIELD).decode("utf-8", errors="replace")
    return replace(parse_model(text, f"{_name(manifest)}: {CORE_FIELD}"), name=field)


def turning(vector: Floats, latitude: Floats, height: Floats) -> Floats:
    """What the turning of north, east and down adds to the gradient of a vector, nT/km.

    A step north turns north toward down by 1 / (M + h), a step east turns east toward down
    by 1 / (N + h) and toward north by tan(latitude) / (N + h); M and N are the ellipsoid's radii
    of curvature. `vector` (..., 3) nT; answer (..., 3, 3), component by direction.
    """
    north_m, east_m = metres_per_degree(latitude, height)
    meridian, parallel = _KM_PER_DEGREE * north_m, _KM_PER_DEGREE * east_m
    north, east, down = np.moveaxis(vector, -1, 0)
    sine, cosine = np.sin(np.radians(latitude)), np.cos(np.radians(latitude))
    out = np.zeros((*vector.shape, 3))
    out[..., 0, 0], out[..., 2, 0] = down / meridian, -north / meridian
    out[..., 0, 1], out[..., 2, 1] = -sine * east / parallel, -cosine * east / parallel
    out[..., 1, 1] = (sine * north + cosine * down) / parallel
    return out


def _name(manifest: Manifest) -> str:
    return f"release {manifest.product} {manifest.version}"


def _refuse_unknown_surface(manifest: Manifest) -> None:
    if not manifest.takes_ellipsoidal_height:
        surface = manifest.height_reference.replace("_", " ")
        raise ContractError(
            f"its heights count from {surface}, whose own height it does not know",
            where=_name(manifest),
            expected="a release with heights above the ellipsoid, or a reference_surface_height",
            remedy="a core field cannot be evaluated above an unknown surface",
        )
