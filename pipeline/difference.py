"""What changed from one release to another: the bump it is due, and each value's change."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from magtiles.catalog import Release, open_release
from magtiles.catalog.flags import QualityFlag
from magtiles.catalog.releases import versions
from magtiles.catalog.releases.lattice import HALO, Lattice
from magtiles.pipeline.plotting import QUANTITIES, preview_figure
from magtiles.pipeline.preview import assemble_level, figure_note, figure_title
from magtiles.schemas.errors import UsageError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SIGMAS = {
    "total": "magnetic_anomaly_uncertainty",
    "vector": "vector_uncertainty",
    "tensor": "tensor_uncertainty",
}
_NODE = 1e-6  # of a cell: positions nearer than this to a node of the other lattice are that node


@dataclass(frozen=True)
class LevelChange:
    """How one quantity changed at one level, over the nodes that both releases answer for.

    Attributes
    ----------
    nodes, changed : how many nodes were compared, and how many are not the same to the bit.
    rms, largest : of new minus old, in `unit`; `latitude`, `longitude` say where the largest is.
    sigmas : the largest change over the old release's stated 1 sigma at its node.
    """

    quantity: str
    unit: str
    height_m: float
    nodes: int
    changed: int
    rms: float
    largest: float
    latitude: float | None
    longitude: float | None
    sigmas: float


@dataclass(frozen=True)
class SigmaChange:
    """How a stated 1 sigma changed at one level, over the nodes that both releases answer for.

    Attributes
    ----------
    changed : at how many of the `nodes`.
    median, smallest, largest : of new over old.
    """

    of: str
    height_m: float
    nodes: int
    changed: int
    median: float
    smallest: float
    largest: float


@dataclass(frozen=True)
class Difference:
    """What changed from an old release to a new one.

    Attributes
    ----------
    bump, reason : the smallest bump that the change is due (None: nothing changed), and why.
    enough : whether the new release's version is that far above the old one's.
    levels : by level that both have, and quantity.
    sigmas : by level that both have, and sigma: of the total, the vector, the tensor.
    flags : by level that both have, how many of the nodes they answer for have other flags.
    height_references : what heights count from in the old and in the new release.
    only_old, only_new : levels that the other does not have, m.
    gained, lost : nodes of the new lattice that only the new release answers for, and of the old
        one that only the old does, at the lowest common level.
    interpolated : whether the lattices differ, and the new one was interpolated at the old nodes.
    """

    old: str
    new: str
    bump: str | None
    reason: str
    enough: bool
    levels: tuple[LevelChange, ...]
    sigmas: tuple[SigmaChange, ...]
    flags: dict[float, int]
    height_references: tuple[str, str]
    only_old: tuple[float, ...]
    only_new: tuple[float, ...]
    gained: int
    lost: int
    interpolated: bool


def compare_releases(old: Path, new: Path) -> Difference:
    """Compare two releases, each verified as it is read.

    Values are compared on the nodes of the old release; a new one on another lattice is
    interpolated there with cubic splines. Raises IntegrityError for a damaged release.
    """
    before, after = open_release(old), open_release(new)
    change = versions.required_bump(before.manifest, after.manifest)
    heights = [h for h in before.manifest.heights_m if h in after.manifest.heights_m]
    pairs = [_Level(before, after, height) for height in heights]
    levels = tuple(one for pair in pairs for one in pair.changes())
    return Difference(
        old=f"{before.manifest.product} {before.manifest.version}",
        new=f"{after.manifest.product} {after.manifest.version}",
        bump=change.bump,
        reason=change.reason,
        enough=_enough(before, after, change.bump),
        levels=levels,
        sigmas=tuple(one for pair in pairs for one in pair.sigmas()),
        flags={pair.height: pair.flags_changed() for pair in pairs},
        height_references=(before.manifest.height_reference, after.manifest.height_reference),
        only_old=tuple(h for h in before.manifest.heights_m if h not in heights),
        only_new=tuple(h for h in after.manifest.heights_m if h not in heights),
        gained=pairs[0].gained if pairs else 0,
        lost=pairs[0].lost if pairs else 0,
        interpolated=bool(pairs) and not pairs[0].same_nodes,
    )


def difference_figure(old: Path, new: Path, *, height: float | None, quantity: str) -> Figure:
    """Draw new minus old of one quantity at one level, the old uncertainty and the new flags.

    Raises UsageError for a height that is not a level of both.
    """
    before, after = open_release(old), open_release(new)
    common = [h for h in before.manifest.heights_m if h in after.manifest.heights_m]
    wanted = height if height is not None else next(iter(common), None)
    if wanted not in common:
        raise UsageError(
            "no such level in both releases",
            where="--level",
            expected=f"one of {', '.join(f'{h:g}' for h in common) or 'none'}",
        )
    pair, kind = _Level(before, after, float(wanted)), QUANTITIES[quantity]
    lattice = before.manifest.lattice
    title = figure_title(
        before.manifest.product,
        f"{before.manifest.version} to {after.manifest.version}",
        quantity,
        float(wanted),
        before.manifest.height_reference,
    )
    return preview_figure(
        lattice.latitudes(np.arange(lattice.rows + 1)),
        lattice.longitudes(np.arange(lattice.columns + 1)),
        np.where(pair.both, pair.change(kind.variable), np.nan),
        pair.old[kind.uncertainty],
        np.where(pair.both, pair.old["quality_flag"], QualityFlag.BEYOND_COVERAGE).astype(np.uint8),
        quantity=quantity,
        title=title.replace(": ", ": change of "),
        note=figure_note(after.manifest.identity),
        change=True,
    )


class _Level:
    """One level of two releases on the core nodes of the old one."""

    def __init__(self, before: Release, after: Release, height: float) -> None:
        self.height = height
        self.lattice = before.manifest.lattice
        self.old = _cores(_arrays(before, height))
        self._wide = _arrays(after, height)
        self._new = _cores(self._wide)
        self._y, self._x, inside = _places(self.lattice, after.manifest.lattice)
        self.same_nodes = _on_nodes(self._y[inside]) and _on_nodes(self._x[inside])
        self._node = _nearest(self._y, self._x, inside)
        answers = inside & _covered(self._new["quality_flag"][self._node])
        answered = _covered(self.old["quality_flag"])
        self.both = answers & answered
        self.lost = int(np.count_nonzero(answered & ~answers))
        y, x, inside = _places(after.manifest.lattice, self.lattice)
        known = inside & answered[_nearest(y, x, inside)]
        self.gained = int(np.count_nonzero(_covered(self._new["quality_flag"]) & ~known))

    def change(self, variable: str) -> NDArray[np.float64]:
        """New minus old of a variable, (rows, columns); meaningless where not `both`."""
        old = self.old[variable].astype(np.float64)
        if self.same_nodes:
            return np.asarray(self._new[variable][self._node] - old, np.float64)
        # The halo keeps the spline's ends away, as it does for the reader.
        place = (self._y + HALO, self._x + HALO)
        smooth = ndimage.map_coordinates(
            self._wide[variable].astype(np.float64), place, order=3, mode="nearest"
        )
        return np.asarray(smooth - old, np.float64)

    def changes(self) -> list[LevelChange]:
        return [self._summary(name) for name in QUANTITIES]

    def sigmas(self) -> list[SigmaChange]:
        return [
            self._sigma(name, variable) for name, variable in _SIGMAS.items() if self.both.any()
        ]

    def _sigma(self, name: str, variable: str) -> SigmaChange:
        old, new = self.old[variable][self.both], self._new[variable][self._node][self.both]
        ratio = new.astype(np.float64) / old
        return SigmaChange(
            of=name,
            height_m=self.height,
            nodes=ratio.size,
            changed=int(np.count_nonzero(new != old)),
            median=float(np.median(ratio)),
            smallest=float(ratio.min()),
            largest=float(ratio.max()),
        )

    def flags_changed(self) -> int:
        """How many nodes that both answer for have other flags."""
        other = self.old["quality_flag"] != self._new["quality_flag"][self._node]
        return int(np.count_nonzero(other & self.both))

    def _summary(self, quantity: str) -> LevelChange:
        kind = QUANTITIES[quantity]
        change = np.where(self.both, self.change(kind.variable), 0.0)
        row, column = np.unravel_index(int(np.argmax(np.abs(change))), change.shape)
        nodes, largest = int(np.count_nonzero(self.both)), float(change[row, column])
        sigmas = np.abs(change) / self.old[kind.uncertainty]
        return LevelChange(
            quantity=quantity,
            unit=kind.unit,
            height_m=self.height,
            nodes=nodes,
            changed=int(np.count_nonzero(change)),
            rms=float(np.sqrt((change**2).sum() / max(nodes, 1))),
            largest=largest,
            latitude=float(self.lattice.latitudes(np.asarray(row))) if largest else None,
            longitude=float(self.lattice.longitudes(np.asarray(column))) if largest else None,
            sigmas=float(sigmas.max()),
        )


def _arrays(release: Release, height: float) -> dict[str, NDArray[Any]]:
    names = ["quality_flag"]
    for kind in QUANTITIES.values():
        names += [name for name in (kind.variable, kind.uncertainty) if name not in names]
    level = release.manifest.heights_m.index(height)
    arrays = assemble_level(release.tiles(), release.manifest.lattice, level, names, halo=HALO)
    return dict(zip(names, arrays, strict=True))


def _cores(arrays: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: array[HALO:-HALO, HALO:-HALO] for name, array in arrays.items()}


def _places(
    nodes: Lattice, on: Lattice
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Where the core nodes of one lattice lie on another, in cells, and whether inside it."""
    rows = nodes.latitudes(np.arange(nodes.rows + 1))
    columns = nodes.longitudes(np.arange(nodes.columns + 1))
    return on.locate(*np.broadcast_arrays(rows[:, np.newaxis], columns))


def _nearest(
    y: NDArray[np.float64], x: NDArray[np.float64], inside: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Index of the nearest node; the first where there is none."""
    row, column = (np.where(inside, np.rint(one), 0).astype(np.intp) for one in (y, x))
    return row, column


def _covered(flags: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.asarray((flags & QualityFlag.BEYOND_COVERAGE) == 0)


def _on_nodes(cells: NDArray[np.float64]) -> bool:
    return bool((np.abs(cells - np.rint(cells)) < _NODE).all())


def _enough(before: Release, after: Release, bump: str | None) -> bool:
    old = versions.parse_version(before.manifest.version)
    new = versions.parse_version(after.manifest.version)
    return bump is None or new >= versions.bumped(old, bump)
