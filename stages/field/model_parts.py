"""A field model taken apart: the core field, and the crustal field that is the anomaly."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, decimal_year, power_spectrum
from magtiles.schemas.errors import ParameterError

Floats = NDArray[np.float64]

_log = logging.getLogger(__name__)

_WEAKEST_DIPOLE_NT = 10_000.0
"""Rms of degree 1 below which degrees 1 and up are no core field (43,000 nT today)."""


@dataclass(frozen=True)
class ModelParts:
    """Core and crust, and the degrees between them that neither has (empty if none)."""

    core: FieldModel
    crust: FieldModel
    missing: range

    def crust_at(self, epoch: str) -> Floats:
        """Coefficients (k,) of the crust, nT; it does not change, so its nearest date will do."""
        return self.crust.at(float(np.clip(decimal_year(epoch), *self.crust.valid)))

    @property
    def reference_field(self) -> str:
        """Name of the core field that the anomaly counts from."""
        return f"{self.core.name} to degree {self.core.n_max}"

    @property
    def definition(self) -> str:
        """What the total-field anomaly is."""
        lost = ""
        if self.missing:
            lost = f"; degrees {self.missing[0]} to {self.missing[-1]} are in neither"
        return (
            f"|core + crust| - |core|: crust {self.crust.name} of degrees {self.crust.n_min} to "
            f"{self.crust.n_max}, core {self.reference_field}{lost}"
        )


def split_model(
    model: FieldModel,
    core: FieldModel | None,
    *,
    epoch: str,
    core_degree: int,
    crust_degree: int,
    highest_degree: int | None,
) -> ModelParts:
    """The core of degrees up to `core_degree` and the crust from `crust_degree` up.

    The core is `model`'s own unless another model is given as `core`. Nothing may be counted
    twice; degrees that are lost between the two are an error in one model, which has them, and
    a warning between two (IGRF ends at 13).

    Raises ParameterError for those, for a model without such degrees, whose lowest degrees are
    no core field, or that holds at one date only, and for an epoch outside the validity.
    """
    source = model if core is None else core
    _check_core(source, core_degree, epoch, own=core is None)
    highest = model.n_max if highest_degree is None else highest_degree
    if not max(crust_degree, model.n_min) <= highest <= model.n_max:
        raise ParameterError(
            f"no degrees {crust_degree} to {highest} in {model.name}",
            where="crust_degree, highest_degree",
            expected=f"degrees within {model.n_min} to {model.n_max}, ascending",
        )
    parts = source.degrees(1, core_degree), model.degrees(crust_degree, highest)
    low, high = parts[0].n_max, parts[1].n_min
    if high <= low:
        raise ParameterError(
            f"degrees {high} to {low} would be counted twice",
            where="core_degree, crust_degree",
            expected=f"a crust from degree {low + 1}",
        )
    missing = range(low + 1, high)
    if missing and core is None:
        raise ParameterError(
            f"degrees {missing[0]} to {missing[-1]} would be lost",
            where="core_degree, crust_degree",
            expected=f"a crust from degree {low + 1}",
        )
    if missing:
        _log.warning(
            "degrees %d to %d are neither in the core field %s nor in the crust: the total field "
            "lacks them (some 5 nT for 14 and 15); the uncertainty allows for them",
            missing[0], missing[-1], source.name,
        )  # fmt: skip
    return ModelParts(*parts, missing)


def _check_core(core: FieldModel, core_degree: int, epoch: str, *, own: bool) -> None:
    remedy = 'name a core field, such as core = "IGRF-14"' if own else None
    dipole = 0.0
    if core.n_min == 1:
        _check_covers(core, epoch)
        dipole = float(np.sqrt(power_spectrum(core.at(epoch))[0]))
    if core_degree < 1 or dipole < _WEAKEST_DIPOLE_NT:
        raise ParameterError(
            f"degrees {core.n_min} to {core_degree} of {core.name} are no core field",
            where="core_degree" if core_degree < 1 else core.name,
            expected=f"degrees from 1, with a dipole above {_WEAKEST_DIPOLE_NT:g} nT",
            remedy=remedy,
        )
    if core.valid[0] == core.valid[1]:
        raise ParameterError(
            f"{core.name} has no secular variation: it holds at {core.valid[0]:g} only",
            where=core.name,
            expected="a core field that a filter can have at its own date",
            remedy='name the whole set of its files, or a core field such as core = "IGRF-14"',
        )


def _check_covers(model: FieldModel, epoch: str) -> None:
    if not model.covers(epoch):
        raise ParameterError(
            f"epoch {epoch} is outside the validity of {model.name}",
            where="epoch",
            expected=f"{model.valid[0]:g} to {model.valid[1]:g}",
        )
