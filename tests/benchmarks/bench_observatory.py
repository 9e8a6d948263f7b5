"""A year of one-minute IAGA-2002 against ``pandas.read_csv`` of the same numbers, in one process.

525,600 rows of four elements in 12 or 365 files: asked is a series, with its times, gaps and
conversions, in no more time than pandas takes for bare columns of CSV, and less than 1 GB.
"""

from __future__ import annotations

import resource
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "truth"))

import iaga

from magtiles.stages.ingest.observatory.stage import (
    IngestObservatoryParams,
    ingest_observatory,
)

ROUNDS = 7
MINUTES = 525_600


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one run."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def write_year(folder: Path, files: int) -> tuple[list[Path], list[Path]]:
    """The year as IAGA-2002 and as CSV of the four numbers, each in so many files."""
    stamps, values = iaga.minutes("2015-01-01", MINUTES), iaga.field(MINUTES)
    records, tables = [], []
    for number, part in enumerate(np.array_split(np.arange(MINUTES), files)):
        lines = iaga.header() + iaga.rows(stamps[part], values[:, part])
        records.append(iaga.write(folder / f"{number:03d}.min", lines))
        tables.append(folder / f"{number:03d}.csv")
        frame = pd.DataFrame(values[:, part].T, columns=list("XYZF"))
        frame.to_csv(tables[-1], index=False, float_format="%.2f")
    return records, tables


def parse_ratio(files: int) -> float:
    """Time to ingest a year over the time that pandas takes for a CSV of its numbers alone.

    Prints it, and that over the time pandas takes for the same files, by their blanks.
    """
    with tempfile.TemporaryDirectory() as folder:
        records, tables = write_year(Path(folder), files)
        skipped = len(iaga.header())
        works: tuple[Callable[[], object], ...] = (
            lambda: ingest_observatory(records, params=IngestObservatoryParams()),
            lambda: pd.concat([pd.read_csv(table) for table in tables]),
            lambda: pd.concat(
                [pd.read_csv(r, sep=r"\s+", skiprows=skipped, header=None) for r in records]
            ),
        )
        for work in works:
            work()
        rounds = [[seconds(work) for work in works] for _ in range(ROUNDS)]
    ours, bare, same = (statistics.median(times) for times in zip(*rounds, strict=True))
    print(f"{MINUTES} minutes in {files} files: ingest {ours:.3f} s")
    print(f"  read_csv of the numbers alone {bare:.3f} s, ratio {ours / bare:.2f} (at most 1)")
    print(f"  read_csv of the same files {same:.3f} s, ratio {ours / same:.2f}")
    return ours / bare


def main() -> None:
    """Print the ratios and the memory."""
    parse_ratio(12)
    parse_ratio(365)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    gigabytes = peak / (1e9 if sys.platform == "darwin" else 1e6 / 1.024)
    print(f"peak memory {gigabytes:.2f} GB, writing the files included (asked: below 1)")


if __name__ == "__main__":
    main()
