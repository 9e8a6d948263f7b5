"""Maps of any size: blocks against one transform, memory and time by size, one worker and two.

``bench_blocks.py`` does all; name parts of it (``compare``, ``sizes``, ``memory``, ``workers``)
to do those.
A map of 3000 x 3000 nodes, with a void and a coast, is made at once and in blocks, and compared
everywhere. Builds of 1024 to 8192 nodes a side, three levels each, run in processes of their
own, with two workers; the smallest as the median of five. What they cost is in seconds of a
processor, user's and system's, workers included. A build of a small map, just before, tells
what does not grow with the map (its second: the first imports and starts), and is taken off. The
rest is told by node of the source and by node of the release, which has more of them the farther
the map reaches to the north and south. What a build of 4096, five levels, holds in memory is what
no other process shares with its own. Name sizes after ``sizes`` to do only those.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bench_chain
import dask
import distributed
import numpy as np
import psutil
import pyproj
import scipy.fft
import xarray as xr

from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.build import build_product
from magtiles.pipeline.tasks import CLUSTER_SETTINGS
from magtiles.stages.field.components import DeriveComponentsParams, derive_components
from magtiles.stages.field.level import PRODUCTS, SIGMAS
from magtiles.stages.field.voids import FillVoidsParams, fill_voids

COMPARED, SPACING_M = 3000, 250.0
GAINS_M = (0.0, 500.0, 2000.0)
LOW = {"inclination_deg": 8.0, "declination_deg": 37.0}
SIZES = (1024, 2048, 4096, 8192)
BUILT_SPACING_M, COST_LEVELS_M = 100.0, (500.0, 1100.0)
MEMORY_SIZE, LEVELS_M = 4096, (500.0, 700.0, 1100.0, 1900.0)
WORKERS_SIZE, WORKERS_BLOCK = 3000, 1024
SMALL = 256


def example() -> xr.Dataset:
    """Noise as red as a crust's, 100 nT, and 1 nT of white noise; a void and a ragged border."""
    rng = np.random.default_rng(11)
    shape = (COMPARED, COMPARED)
    full = COMPARED + 600
    k = np.hypot(np.fft.fftfreq(full)[:, None], np.fft.rfftfreq(full))
    k[0, 0] = np.inf
    spectrum = scipy.fft.rfft2(rng.standard_normal((full, full))) * k**-1.3 * np.exp(-25.0 * k)
    values = scipy.fft.irfft2(np.nan_to_num(spectrum), s=(full, full))[:COMPARED, :COMPARED]
    values = 30.0 + 100.0 * values / values.std() + rng.standard_normal(shape)
    i, j = np.mgrid[:COMPARED, :COMPARED]
    values[(i - 1024) ** 2 + (j - 1500) ** 2 / 2 < 60**2] = np.nan
    values[j < 40 + 30 * np.sin(i / 50)] = np.nan
    axis = SPACING_M * (np.arange(COMPARED) - COMPARED / 2)
    metres = {"units": "m"}
    crs = pyproj.CRS(proj="tmerc", lat_0=46, lon_0=-120, datum="WGS84")
    grid = xr.Dataset(
        {
            "magnetic_anomaly": (("y", "x"), values, {"units": "nT", "grid_mapping": "crs"}),
            "magnetic_anomaly_uncertainty": ((), 1.0, {"units": "nT"}),
            "height": ((), 300.0, metres),
            "crs": ((), np.int32(0), crs.to_cf()),
        },
        coords={"y": ("y", axis, metres), "x": ("x", axis, metres)},
        attrs={
            "reference_field": "IGRF-14",
            "reference_epoch": "2010-01-01",
            "anomaly_definition": "total-field anomaly",
            "height_reference": "ellipsoid",
            "source": "benchmark",
        },
    )
    return fill_voids(grid, params=FillVoidsParams())


def compare() -> None:
    """Greatest difference of blocks from one transform, everywhere, in sigma as that states it."""
    grid = example()
    print(f"map {COMPARED} x {COMPARED}: one transform, and blocks; greatest difference in sigma")
    for name, angles in (("IGRF", {}), ("inclination 8, declination 37", LOW)):
        print(name)
        for gain in GAINS_M:
            one = derive_components(grid, params=DeriveComponentsParams(height_m=gain, **angles))
            params = DeriveComponentsParams(height_m=gain, block_nodes=1024, **angles)
            report(gain, one, derive_components(grid, params=params))


def report(gain: float, one: xr.Dataset, blocked: xr.Dataset) -> None:
    """Print one height's differences: of values, of splines' gradients, of sigma and flags."""
    found = {"total": 0.0, "vector": 0.0, "tensor": 0.0, "slope": 0.0}
    per_node = one["tensor_uncertainty"].values / 1000.0 * SPACING_M
    for name in PRODUCTS:
        group = {"magnetic": "total", "anomaly": "vector"}.get(name.split("_")[0], "tensor")
        sigma = next(n for n, g in SIGMAS.items() if g == group)
        error = blocked[name].values - one[name].values
        found[group] = max(found[group], float(np.abs(error / one[sigma].values).max()))
        if group != "tensor":
            for axis in (0, 1):
                slope = np.abs(np.diff(error, axis=axis)) / np.delete(per_node, -1, axis)
                found["slope"] = max(found["slope"], float(slope.max()))
    ratios = [(blocked[n] / one[n]).values for n in SIGMAS]
    flags = int((blocked["quality_flag"].values != one["quality_flag"].values).sum())
    print(
        f"  {gain:6.0f} m up: " + ", ".join(f"{k} {v:.4f}" for k, v in found.items()),
        f"(asked: at most 0.1); sigma x {min(r.min() for r in ratios):.3f} to "
        f"{max(r.max() for r in ratios):.3f}; {flags} flags differ",
        flush=True,
    )


def sizes(*wanted: int) -> None:
    """Cost of builds by size."""
    print(f"builds of {1 + len(COST_LEVELS_M)} levels, two workers; microseconds of a processor")
    firsts = None
    for size in wanted or SIZES:
        runs = [in_process(size, None, 2, COST_LEVELS_M) for _ in range(5 if size < 2048 else 1)]
        spent = [made["processor_s"] - made["fixed_s"] for made in runs]
        made = runs[spent.index(statistics.median(spent))]
        grown = statistics.median(spent)
        costs = grown / made["nodes"], grown / (size**2 - SMALL**2)
        firsts = firsts or costs
        node, cell = (
            f"{1e6 * cost:6.2f} ({cost / first:.2f} of the first)"
            for cost, first in zip(costs, firsts, strict=True)
        )
        print(
            f"  {size:5} a side: {node} a node of the release, {cell} of the source (asked: 0.8 "
            f"to 1.2); {made['processor_s']:.1f} s, {made['fixed_s']:.1f} s of it for {SMALL} a "
            f"side, in {made['seconds']:.1f} s; at most {made['whole_gb']:.2f} GB, "
            f"{made['own_gb']:.2f} in the build's own process, {made['worker_gb']:.2f} in a worker",
            {step: [round(s, 1) for s in both] for step, both in made["steps"].items()},
            [round(1e6 * s / made["nodes"], 2) for s in spent] if len(spent) > 1 else "",
            flush=True,
        )


def memory() -> None:
    """The most memory that a large build holds."""
    made = in_process(MEMORY_SIZE, None, 2, LEVELS_M)
    print(
        f"{MEMORY_SIZE} a side, {1 + len(LEVELS_M)} levels: at most {made['whole_gb']:.2f} GB "
        f"(asked: below 4), {made['own_gb']:.2f} in the build's own process, "
        f"{made['worker_gb']:.2f} in a worker; {made['seconds']:.1f} s"
    )


def workers() -> None:
    """Time of one build in blocks by one worker, and by two."""
    # To watch their memory takes time from two workers, and none from one.
    made = [
        in_process(WORKERS_SIZE, WORKERS_BLOCK, count, LEVELS_M, watched=False) for count in (1, 2)
    ]
    for count, found in enumerate(made, 1):
        steps = {step: [round(s, 1) for s in both] for step, both in found["steps"].items()}
        print(f"  {count} workers: {found['seconds']:.1f} s, of it (and of a processor) {steps}")
    one, two = (found["seconds"] for found in made)
    print(f"two workers are {one / two:.2f} times as fast (asked: at least 1.6)")


def in_process(
    size: int, block: int | None, count: int, levels: Sequence[float], watched: bool = True
) -> dict[str, Any]:
    """What `build` prints, in a process of its own."""
    arguments = json.dumps([size, block, count, levels, watched])
    command = [sys.executable, __file__, "build", arguments]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    made: dict[str, Any] = json.loads(printed.splitlines()[-1])
    return made


def build(size: int, block: int | None, count: int, levels: Sequence[float], watched: bool) -> None:
    """Build a map of that size with so many workers and print, as JSON, what it took."""
    with (
        dask.config.set(CLUSTER_SETTINGS),
        distributed.LocalCluster(
            n_workers=count, threads_per_worker=1, dashboard_address="127.0.0.1:0", memory_limit=0
        ) as cluster,
    ):
        address = cluster.scheduler_address
        small = [built(SMALL, None, address, levels) for _ in range(2)][1]
        made = built(size, block, address, levels, watched)
        made["nodes"] -= small["nodes"]
        print(json.dumps(made | {"fixed_s": small["processor_s"]}))


def built(
    size: int, block: int | None, scheduler: str, levels: Sequence[float], watched: bool = False
) -> dict[str, Any]:
    """What it took to build a map of that size; memory where that is watched."""
    bench_chain.SIZE, bench_chain.SPACING_M = size, BUILT_SPACING_M
    steps: dict[str, list[float]] = {}
    last: list[Any] = [0.0, 0.0, "start"]

    def progress(what: str, done: int, total: int) -> None:
        now = time.perf_counter(), processor_s()
        what = "derive-components" if what.startswith("blocks of") else what
        spent = steps.setdefault(last[2], [0.0, 0.0])
        steps[last[2]] = [s + n - m for s, n, m in zip(spent, now, last[:2], strict=True)]
        last[:] = *now, what

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        product = bench_chain.write_inputs(folder)
        text = product.read_text().replace(str(list(bench_chain.LEVELS_M)), str(list(levels)))
        product.write_text(text + (f"block_nodes = {block}\n" if block else ""))
        memory = Watch()
        with memory if watched else contextlib.nullcontext():
            last[:] = time.perf_counter(), processor_s(), "start"
            result = build_product(
                product,
                store=folder / "store",
                work=folder / "work",
                progress=progress,
                scheduler=scheduler,
            )
        progress("end", 1, 1)
        with open_artifact(next(folder.glob("work/*/level-*.nc"))) as level:
            nodes = level["magnetic_anomaly"].size
        # What was published is read-only, to the folder's own removal too.
        for part in [result.path, *result.path.rglob("*")]:
            part.chmod(0o755)
    seconds, processor = (sum(spent) for spent in zip(*steps.values(), strict=True))
    took = {"seconds": seconds, "processor_s": processor, "steps": steps, "nodes": nodes}
    return took | memory.gigabytes


def processor_s() -> float:
    """Seconds of a processor that this process and its children have had."""
    me = psutil.Process()
    times = [process.cpu_times() for process in [me, *me.children(recursive=True)]]
    return sum(spent.user + spent.system for spent in times)


class Watch:
    """The most memory that this process and its children hold for themselves, meanwhile."""

    def __init__(self) -> None:
        self.gigabytes = {"whole_gb": 0.0, "own_gb": 0.0, "worker_gb": 0.0}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        me = psutil.Process()
        while not self._over.wait(0.5):
            try:
                own = me.memory_full_info().uss / 1e9
                others = [c.memory_full_info().uss / 1e9 for c in me.children(recursive=True)]
            except psutil.Error:  # a child that has just ended
                continue
            seen = own + sum(others), own, max(others, default=0.0)
            for name, value in zip(self.gigabytes, seen, strict=True):
                self.gigabytes[name] = max(self.gigabytes[name], value)


def main() -> None:
    """Do all parts, or those named."""
    if sys.argv[1:2] == ["build"]:
        build(*json.loads(sys.argv[2]))
        return
    parts = {"compare": compare, "sizes": sizes, "memory": memory, "workers": workers}
    if sys.argv[1:2] == ["sizes"]:
        sizes(*map(int, sys.argv[2:]))
        return
    for name in sys.argv[1:] or parts:
        parts[name]()


if __name__ == "__main__":
    main()
