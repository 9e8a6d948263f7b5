"""Levels made in blocks by a cluster: same bytes whichever, workers that die, builds cut short."""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import distributed
import numpy as np
import pytest

from magtiles.catalog import open_release
from magtiles.pipeline import large_levels, receipts, tasks
from magtiles.pipeline.artifacts import open_artifact
from magtiles.pipeline.build import build_product
from magtiles.pipeline.large_levels import LevelJob
from magtiles.pipeline.sample import DEMO, synthesize, write_survey
from magtiles.pipeline.tasks import Tasks, working
from magtiles.schemas import contracts
from magtiles.schemas.errors import CoverageError, MagtilesError, UsageError
from magtiles.stages.release.checks import replay_checks

SPEC = replace(DEMO, name="wide", width_m=190e3, length_m=150e3, dipoles=150, levels_m=(2500.0,))


def build(folder: Path, product: Path, **options):
    return build_product(product, store=folder / "store", work=folder / "work", **options)


@pytest.fixture(scope="module")
def products(tmp_path_factory) -> dict[str, Path]:
    """The product made at once, and in blocks."""
    folder = tmp_path_factory.mktemp("inputs")
    once = write_survey(folder, synthesize(SPEC))[-1]
    blocked = folder / "blocked.toml"
    blocked.write_text(once.read_text() + "block_nodes = 128\n")
    return {"once": once, "blocked": blocked}


@pytest.fixture(scope="module")
def built(products, tmp_path_factory) -> Path:
    """The release made in blocks by a local cluster."""
    return build(tmp_path_factory.mktemp("built"), products["blocked"]).path


def digests(release: Path) -> dict[str, str]:
    return {
        str(path.relative_to(release)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(release.rglob("*"))
        if path.is_file()
    }


@contextlib.contextmanager
def cluster(threads: int = 1, *, processes: bool = False) -> Iterator[str]:
    """The address of a scheduler as one would run it by hand."""
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=threads,
        processes=processes,
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        protocol="tcp://",
    ) as made:
        yield made.scheduler_address


def test_blocks_agree_with_one_transform(products, built, tmp_path):
    once = open_release(build(tmp_path, products["once"]).path).anomaly
    blocked = open_release(built).anomaly
    rng = np.random.default_rng(3)
    latitude, longitude = rng.uniform(45.4, 46.6, 5000), rng.uniform(-122.6, -120.4, 5000)
    for height in (1500.0, 2000.0, 2500.0):
        place = latitude, longitude, height
        assert np.array_equal(once.flags(*place), blocked.flags(*place))
        sigma = once.uncertainty(*place)
        # Measured: 0.040 sigma in value, 0.028 in gradient.
        assert np.nanmax(np.abs(once.total(*place) - blocked.total(*place)) / sigma) < 0.06
        sigma = once.uncertainty(*place, quantity="tensor")[..., None]
        gradients = (a.total_with_gradient(*place)[1] for a in (once, blocked))
        assert np.nanmax(np.abs(np.subtract(*gradients)) / sigma) < 0.06


def test_the_same_bytes_whichever_cluster(products, built, tmp_path, monkeypatch):
    with cluster(processes=True) as address:
        monkeypatch.chdir(tmp_path)  # where the worker is not
        again = build(Path(), products["blocked"], scheduler=address)
    assert digests(again.path) == digests(built)
    levels = tmp_path / "work" / "wide"
    assert not list(levels.glob("*.blocks"))
    assert not list(levels.rglob("*.tmp"))
    for level in levels.glob("level-*.nc"):
        with open_artifact(level) as opened:
            contracts.check(opened, "component-grid/1")


def test_checks_that_workers_made_hold_in_one_process(built):
    assert replay_checks(open_release(built)) < 0.01


def test_building_again_makes_nothing(products, built, monkeypatch):
    def never(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(large_levels, "_make_level", never)
    monkeypatch.setattr(large_levels, "_make_blocks", never)
    result = build(built.parents[2], products["blocked"])
    assert result.path == built
    assert not result.changed


def jobs(products, folder: Path) -> LevelJob:
    """A level of the survey, filled, with nothing else of the build."""
    build(folder, products["once"])
    grid = folder / "work" / "wide" / "filled.nc"
    return LevelJob.of(grid, {"height_m": 1000.0, "block_nodes": 128}, folder / "level.nc")


def test_an_interrupted_level_goes_on_from_its_blocks(products, tmp_path):
    job, here = jobs(products, tmp_path), Tasks()
    [begun] = large_levels.begin(here, [job])
    for task in begun[:4]:  # the map on its plane, the whole of it and two blocks
        task.result()
    kept = {path.name: path.stat().st_mtime_ns for path in job.folder.glob("*.nc")}
    assert len(kept) == 3
    spoilt = job.block(0, 1)
    spoilt.write_bytes(spoilt.read_bytes()[:-100])
    [begun] = large_levels.begin(here, [job])
    here.results(begun[:-1], lambda done: None)
    after = {path.name: path.stat().st_mtime_ns for path in job.folder.glob("*.nc")}
    assert len(after) == len(begun) - 2 >= 5
    assert {name for name in kept if after[name] != kept[name]} == {spoilt.name}
    # A worker of an earlier build that comes late.
    job.block(1, 0).write_bytes(b"another's")
    begun[-1].result()
    assert not job.folder.exists()
    assert receipts.why_stale(job.out, job.made_from) is None
    # A build that was killed before the blocks had gone.
    job.folder.mkdir()
    assert not large_levels.begin(here, [job])[0]
    assert not job.folder.exists()


def test_levels_are_the_same_one_at_a_time_and_together(products, tmp_path, monkeypatch):
    first, here = jobs(products, tmp_path), Tasks()
    params = [{"height_m": height, "block_nodes": 128} for height in (500.0, 1000.0, 20000.0)]
    made = []
    for name in ("together", "alone"):
        levels = [
            LevelJob.of(first.grid, p, tmp_path / name / f"{n}.nc") for n, p in enumerate(params)
        ]
        begun = large_levels.begin(here, levels)
        shared = set(map(id, begun[0][2:-1])) & set(map(id, begun[2][2:-1]))
        assert bool(shared) == (name == "together")
        for tasks_of_level in begun:
            here.results(tasks_of_level, lambda done: None)
        made.append([receipts.digest(level.out) for level in levels])
        monkeypatch.setattr(large_levels, "_groups", lambda jobs, *_: [[job] for job in jobs])
    assert made[0] == made[1]


def test_a_worker_that_dies_is_replaced(tmp_path, monkeypatch):
    # Workers cannot import this file: functions within functions are sent as they are.
    def die_once(mark: Path) -> int:
        """What a worker does that runs out of memory, the first time."""
        with contextlib.suppress(FileExistsError):
            mark.touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    def die() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def refuse() -> None:
        raise CoverageError("too far", where="there", expected="nearer", remedy="come back")

    monkeypatch.setattr(tasks, "_WORKER_BYTES", 1 << 62)  # one worker
    with working(None, [tmp_path]) as place:
        place.expand()
        before = place.tasks.submit(os.getpid).result()
        died = place.tasks.submit(die_once, tmp_path / "mark")
        sums = [place.tasks.submit(max, n, 2, after=[died]) for n in range(4)]
        told: list[int] = []
        assert place.tasks.results(sums, told.append) == [2, 2, 2, 3]
        assert told == [1, 2, 3, 4]
        assert died.result() not in (before, os.getpid())
        with pytest.raises(CoverageError, match="there: too far; expected nearer; come back"):
            place.tasks.results([place.tasks.submit(refuse)], told.append)
        with pytest.raises(MagtilesError, match="workers died again and again"):
            place.tasks.submit(die).result()


def test_a_scheduler_that_is_not_there(products, tmp_path, monkeypatch):
    monkeypatch.setattr(tasks, "_PATIENCE_S", 0.5)
    with pytest.raises(
        UsageError, match=r"tcp://127\.0\.0\.1:9: no scheduler with workers answers"
    ):
        build(tmp_path, products["blocked"], scheduler="tcp://127.0.0.1:9")
    with pytest.raises(UsageError, match="expected an address such as tcp://"):
        build(tmp_path, products["blocked"], scheduler="nowhere")
    assert not list(tmp_path.rglob("*.nc"))  # said before the work


def test_workers_that_cannot_do_our_work_are_refused(tmp_path, monkeypatch):
    folders = [tmp_path, tmp_path / "store"]
    with cluster(threads=2) as address, pytest.raises(MagtilesError, match="has 2 threads"), \
            working(address, folders):  # fmt: skip
        pass
    code, packages = tasks._describe_worker()
    with cluster() as address:
        for function, found, what in (
            ("_describe_worker", ("other", packages), "has not this version of magtiles"),
            ("_describe_worker", (code, {"numpy": "1"}), "has not these versions of libraries"),
            ("_read_token", "", f"does not see .*expected {folders[0]}"),
        ):
            with monkeypatch.context() as patched:
                patched.setattr(tasks, function, AnsweredByWorker(found, getattr(tasks, function)))
                with pytest.raises(MagtilesError, match=what), working(address, folders):
                    pass
        with working(address, folders):
            pass
    assert [*tmp_path.rglob("*")] == [folders[1]]


class AnsweredByWorker:
    """A function that gives something else in a worker, which alone is given itself."""

    def __init__(self, found: object, function: Callable) -> None:
        self.found, self.function = found, function

    def __call__(self, *arguments: object, dask_worker: object = None) -> object:
        return self.function(*arguments) if dask_worker is None else self.found
