"""What a product's map is made of, and running the stages that make it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magtiles.catalog.kernels.bspline import HALO
from magtiles.catalog.releases.lattice import Lattice
from magtiles.pipeline.progress import Progress
from magtiles.pipeline.runner import StageResult, run_stage
from magtiles.pipeline.tasks import Tasks
from magtiles.stages.declare import Stage


class Steps:
    """Runs stages one after another and says so."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._done, self._total = progress, 0, total

    def report(self, what: str) -> None:
        """Tell that one more step begins."""
        self._progress(what, self._done, self._total)
        self._done += 1

    def expect(self, more: int) -> None:
        """Count on more steps than were known of at first."""
        self._total += more

    def within(self, what: str) -> Callable[[int, int], None]:
        """How to tell of parts of one step: called with how many are done and how many there are.

        The step itself does not count before the next one is reported.
        """
        return lambda done, total: self._progress(what, done, total)

    def run(
        self, stage: Stage, inputs: Mapping[str, Any], out: Path, params: Mapping[str, Any]
    ) -> Path:
        """Run a stage on files and give back its artifact."""
        self.report(stage.name)
        result: StageResult = run_stage(stage, inputs, out, params)
        return result.out


@dataclass(frozen=True)
class MapPlan:
    """A map that is ready to be made, level by level.

    Attributes
    ----------
    lattice, heights : where its nodes are; heights ascend.
    level : makes the component grid of one height, on every node of the lattice and its halo.
    artifacts : what was made on the way, in order.
    inputs : of the manifest: id, sha256, licence and role of each.
    source : the TOML or coefficient file that the product names.
    core_field : file of the coefficients that the anomaly counts from, if they are at hand.
    surface : ellipsoidal height of what the heights count from, on the same nodes, if known.
    begin : asks for all that levels made in blocks need, before the first of them; none where
        they are made at once.
    """

    lattice: Lattice
    heights: Sequence[float]
    level: Callable[[float], Path]
    artifacts: Sequence[Path]
    inputs: Sequence[Mapping[str, str]]
    source: Path
    core_field: Path | None
    surface: Path | None = None
    begin: Callable[[Tasks], None] | None = None


def node_axes(lattice: Lattice) -> dict[str, tuple[float, float, int]]:
    """First node, spacing and number of nodes of a lattice with its halo, by axis."""
    return {
        "latitude": (
            lattice.south - HALO * lattice.latitude_spacing,
            lattice.latitude_spacing,
            lattice.rows + 1 + 2 * HALO,
        ),
        "longitude": (
            lattice.west - HALO * lattice.longitude_spacing,
            lattice.longitude_spacing,
            lattice.columns + 1 + 2 * HALO,
        ),
    }


@dataclass(frozen=True)
class PartResult:
    """A part of a release beside its map.

    Attributes
    ----------
    files : by their place in the release; pictures too.
    artifacts : what was made on the way, in order.
    inputs : of the manifest: id, sha256, licence and role of each.
    """

    files: Mapping[str, Path]
    artifacts: Sequence[Path]
    inputs: Sequence[Mapping[str, str]]
