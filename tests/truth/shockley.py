"""Shockley's Monte Carlo of calibration circles (2012, section 3.2.1), beside his tables.

Run as a script, it prints the tables of docs/calibration.md:

    python tests/truth/shockley.py

His field, noise, revolutions and number of runs are as printed. How far scale factors,
distortion and biases vary, and how many samples a revolution has, the paper does not say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magtiles.schemas.errors import MagtilesError
from magtiles.stages.vehicle.calibration.fit import Fit
from magtiles.stages.vehicle.calibration.planar import (
    modified_ellipsoid,
    strict_ellipse,
    swinging,
)

Real = NDArray[np.float64]

NT_PER_MG = 100.0
CORE = NT_PER_MG * np.array([200.0, -21.0, 493.0])
NOISE = NT_PER_MG * 2.0
REVOLUTIONS = 3
SAMPLES = 1080  # one a degree
SCALE = 0.1  # scale factors, uniform within 1 +- this
DISTORTION = 0.1  # uniform within +- this
BIASES = {"inside": (0.0, 140.0), "larger": (300.0, 600.0)}
"""Length of the horizontal bias, mG, from and to, in any direction; the field's is 201 mG."""

HIS = {  # table 3.1 and 3.2: swinging, strict ellipse, modified ellipsoid
    "x scale factor": ((-0.0771, 0.0276), (0.3929, 0.7357), (0.0139, 0.0243)),
    "y scale factor": ((-0.0761, 0.0275), (0.3890, 0.7221), (0.0137, 0.0241)),
    "xy distortion": (None, (0.0278, 0.0660), (-0.0106, 0.0285)),
    "x bias, mG": ((0.0, 0.0), (0.0863, 3.6898), (0.0863, 3.6898)),
    "y bias, mG": ((0.0, 0.0), (0.1682, 4.1115), (0.1682, 4.1115)),
    "heading, degrees": (None, None, (0.0234, 2.1145)),
}


@dataclass(frozen=True)
class Run:
    """One simulated calibration: readings (n, 3) nT, and what made them."""

    raw: Real
    matrix: Real  # the true correction, C^-1 (2, 2)
    bias: Real  # (3,)
    heading: Real  # (n,), radians


def simulate(rng: np.random.Generator, *, triangular: bool, bias_mg: tuple[float, float]) -> Run:
    """Three level circles from heading 180 degrees, read by a distorted, biased, noisy sensor."""
    scale = 1.0 + rng.uniform(-SCALE, SCALE, 3)
    across = rng.uniform(-DISTORTION, DISTORTION)
    distort = np.diag(scale)
    # Triangular: x is true and y leans toward it. Symmetric: each leans as much.
    distort[1, 0] = across
    distort[0, 1] = 0.0 if triangular else across
    distort[2, 2] = 1.0
    towards = rng.uniform(0.0, 2.0 * np.pi)
    length = NT_PER_MG * rng.uniform(*bias_mg)
    bias = np.array([length * np.cos(towards), length * np.sin(towards), rng.normal(0.0, 3000.0)])
    heading = np.pi + np.linspace(0.0, 2.0 * np.pi * REVOLUTIONS, SAMPLES)
    magnetic = heading - np.arctan2(CORE[1], CORE[0])
    level = np.hypot(CORE[0], CORE[1])
    body = np.column_stack(
        [level * np.cos(magnetic), -level * np.sin(magnetic), np.full(SAMPLES, CORE[2])]
    )
    raw = body @ distort.T + bias + rng.normal(0.0, NOISE, (SAMPLES, 3))
    return Run(raw, np.linalg.inv(distort[:2, :2]), bias, heading)


def as_printed(raw: Real, core: Real) -> tuple[Real, Real]:
    """Matrix (2, 2) and bias (2,) of eq. 2.23-2.27 with k = 0, or LinAlgError."""
    x, y = raw[:, 0], raw[:, 1]
    design = np.column_stack([x**2, y**2, 2.0 * x * y, -2.0 * x, -2.0 * y])
    horizontal = np.full(len(raw), core[0] ** 2 + core[1] ** 2)
    q11, q22, q12, p4, p5 = np.linalg.lstsq(design, horizontal, rcond=None)[0]
    form = np.array([[q11, q12], [q12, q22]])
    values, vectors = np.linalg.eigh(form)
    if values[0] <= 0.0:
        raise np.linalg.LinAlgError("the form has no real root")
    return (vectors * np.sqrt(values)) @ vectors.T, np.linalg.solve(form, [p4, p5])


@dataclass
class Errors:
    """Estimated less true, run by run, and the headings' errors sample by sample."""

    values: list[list[float]] = field(default_factory=list)
    heading: list[Real] = field(default_factory=list)
    failed: int = 0

    def add(self, run: Run, matrix: Real, bias: Real) -> None:
        off = matrix - run.matrix
        # The one distortion term of a symmetric root; of a triangular one, the one below.
        across = off[1, 0]
        drift = (bias[:2] - run.bias[:2]) / NT_PER_MG
        self.values.append([off[0, 0], off[1, 1], across, *drift])
        calibrated = (run.raw[:, :2] - bias[:2]) @ matrix.T
        found = np.arctan2(CORE[1], CORE[0]) - np.arctan2(calibrated[:, 1], calibrated[:, 0])
        self.heading.append(np.degrees(np.angle(np.exp(1j * (found - run.heading)))))

    def rows(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of each error."""
        values = np.array(self.values)
        whole = [*values.T, np.concatenate(self.heading)]
        return {n: (float(np.mean(v)), float(np.std(v))) for n, v in zip(HIS, whole, strict=True)}


METHODS: dict[str, Callable[..., Fit]] = {
    "swinging": swinging,
    "strict ellipse": strict_ellipse,
    "modified ellipsoid": modified_ellipsoid,
}
PRINTED = "strict ellipse, k = 0"


def monte_carlo(
    runs: int, *, triangular: bool, bias: str, methods: tuple[str, ...] = (*METHODS, PRINTED),
    known_kind: bool = False, seed: int = 2012,
) -> dict[str, Errors]:  # fmt: skip
    """Errors of each method over `runs` simulations.

    `known_kind`: ask for the distortion that there is; otherwise for the symmetric, as he did.
    """
    rng = np.random.default_rng(seed)
    found = {name: Errors() for name in methods}
    asked = {"distortion": "triangular" if triangular and known_kind else "symmetric"}
    for _ in range(runs):
        run = simulate(rng, triangular=triangular, bias_mg=BIASES[bias])
        for name, errors in found.items():
            try:
                if name == PRINTED:
                    matrix, centre = as_printed(run.raw, CORE)
                else:
                    options = {} if name == "swinging" else asked
                    fit = METHODS[name](run.raw, CORE, outlier_sigma=5.0, **options)
                    matrix, centre = fit.matrix[:2, :2], fit.bias
            except (MagtilesError, np.linalg.LinAlgError):
                errors.failed += 1
                continue
            errors.add(run, matrix, centre)
    return found


def _cell(value: tuple[float, float] | None) -> str:
    return "" if value is None else f"{value[0]:.4f} ± {value[1]:.4f}"


def his_table() -> str:
    """Tables 3.1 and 3.2 as one: mean and standard deviation."""
    lines = ["| error | swinging | strict ellipse | modified ellipsoid |", "|---|---|---|---|"]
    lines += [f"| {name} | {' | '.join(map(_cell, row))} |" for name, row in HIS.items()]
    return "\n".join(lines)


def table(found: dict[str, Errors]) -> str:
    """The same of our methods, with the runs that failed."""
    columns = [errors.rows() if errors.values else {} for errors in found.values()]
    lines = [f"| error | {' | '.join(found)} |", "|---" * (len(found) + 1) + "|"]
    for name in HIS:
        lines.append(f"| {name} | {' | '.join(_cell(c.get(name)) for c in columns)} |")
    lines.append(f"| failed runs | {' | '.join(str(e.failed) for e in found.values())} |")
    return "\n".join(lines)


def main() -> None:
    """Print the page's tables."""
    runs = 1000
    print(f"His:\n\n{his_table()}")
    for bias, (low, high) in BIASES.items():
        for triangular in (False, True):
            kind = "triangular" if triangular else "symmetric"
            print(f"\nOurs, {kind} distortion, biases of {low:g} to {high:g} mG:\n")
            print(table(monte_carlo(runs, triangular=triangular, bias=bias)))
    print("\nOurs, triangular distortion asked for as such, biases of 0 to 140 mG:\n")
    methods = ("strict ellipse", "modified ellipsoid")
    print(table(
        monte_carlo(runs, triangular=True, bias="inside", methods=methods, known_kind=True)
    ))  # fmt: skip


if __name__ == "__main__":
    main()
