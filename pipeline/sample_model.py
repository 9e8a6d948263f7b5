"""A synthetic field model of the whole Earth: the IGRF below, a random crust above."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.models import FieldModel, cof_text, load_igrf
from magtiles.stages.release.atomic import write_bytes

Floats = NDArray[np.float64]

_YEARS = 5.0


@dataclass(frozen=True)
class WorldSpec:
    """What to synthesise.

    The crust's power is `power_nt2` a degree at the reference radius, less what sources at
    `depth_km` lose: R_n = power (1 - depth / a)^(2n). LCS-1 has 14 to 36 nT^2 at degrees 20 to
    130. The crust begins where the IGRF ends, with degree 14, so that no degree is missing.
    """

    name: str = "world"
    epoch: float = 2025.0
    degree: int = 72
    power_nt2: float = 25.0
    depth_km: float = 6.0
    uncertainty_nt: float = 2.0
    heights_m: tuple[float, ...] = (0.0, 5000.0, 15000.0)
    seed: int = 20260101


WORLD = WorldSpec()


def world_model(spec: WorldSpec = WORLD) -> FieldModel:
    """The model of a spec, the same for the same spec; it holds for five years.

    Coefficients of a degree are independent and alike, so that the crust is as rough everywhere
    and has no direction. Rounded as its file holds them.
    """
    igrf = load_igrf()
    segment = int(igrf.segments(np.array(spec.epoch)))
    rate = igrf.line(segment)[1]
    rng = np.random.default_rng(spec.seed)
    n = np.sqrt(np.arange(1, spec.degree * (spec.degree + 2) + 1)).astype(int)
    shrink = (1.0 - spec.depth_km / igrf.reference_radius_km) ** n
    each = np.sqrt(spec.power_nt2 / ((n + 1) * (2 * n + 1))) * shrink
    gauss = np.where(n > igrf.n_max, each * rng.normal(size=n.size), 0.0)
    variation = np.zeros(n.size)
    gauss[: rate.size], variation[: rate.size] = igrf.at(spec.epoch), rate
    return FieldModel(
        name=f"{spec.name.upper()}-{spec.degree}",
        n_min=1,
        n_max=spec.degree,
        reference_radius_km=igrf.reference_radius_km,
        epochs=np.array([spec.epoch]),
        coefficients=np.asarray(np.round(gauss, 6)[None], np.float64),
        secular_variation=np.round(variation, 6),
        valid=(spec.epoch, spec.epoch + _YEARS),
    )


def write_world(folder: Path, spec: WorldSpec = WORLD) -> list[Path]:
    """Write coefficients, source TOML and product TOML of a spec; the same bytes every time.

    Returns the paths ``<name>.COF``, ``<name>-model.toml`` and ``<name>.toml``. Existing files are
    replaced whole.
    """
    folder.mkdir(parents=True, exist_ok=True)
    contents = {
        f"{spec.name}.COF": cof_text(world_model(spec), made="synthetic"),
        f"{spec.name}-model.toml": _source_toml(spec),
        f"{spec.name}.toml": _product_toml(spec),
    }
    for name, content in contents.items():
        write_bytes(folder / name, content.encode())
    return [folder / name for name in contents]


def _source_toml(spec: WorldSpec) -> str:
    return f"""\
# Synthetic model '{spec.name}': the IGRF to degree 13, a random crust to degree {spec.degree}.
[source]
id = "{spec.name}-model"
kind = "field-model"
files = ["{spec.name}.COF"]
licence = "CC0-1.0"
title = "Synthetic field model of the whole Earth"

[coefficients]
uncertainty_nt = {spec.uncertainty_nt}
"""


def _product_toml(spec: WorldSpec) -> str:
    heights = ", ".join(str(height) for height in spec.heights_m)
    return f"""\
[product]
name = "{spec.name}"
version = "1.0.0"

[model]
coefficients = "{spec.name}-model.toml"
epoch = {int(spec.epoch)}-01-01
heights_m = [{heights}]
"""
