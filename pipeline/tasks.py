"""Work that can be done side by side: here, by a local cluster, or by one that is already there."""

from __future__ import annotations

import concurrent.futures
import contextlib
import gc
import importlib.metadata
import logging
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from magtiles.pipeline import receipts
from magtiles.schemas.errors import MagtilesError, UsageError
from magtiles.stages.release.atomic import writing

if TYPE_CHECKING:
    import distributed

Value = TypeVar("Value")
Asked = TypeVar("Asked")

_WORKER_BYTES = 2 << 30
"""Memory that one worker may need: a block of a large map, with what Python itself takes."""
_PATIENCE_S = 30
_STARTS = 3
CLUSTER_SETTINGS: Mapping[str, Any] = {
    # How long to wait where no worker is left: one that dies as it comes is not replaced.
    "distributed.scheduler.no-workers-timeout": "300s",
    # A second task for a busy worker would wait while another worker has nothing to do.
    "distributed.scheduler.worker-saturation": 1.0,
    # To look at what a worker is doing every 10 ms takes time of it.
    "distributed.worker.profile.enabled": False,
    # To give memory back at every turn made blocks take a third longer.
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
}
"""How a cluster is best set up for a build."""
_WORKERS_DIE = "check memory; a script that builds must do so below if __name__ == '__main__':"
SCRATCH = ".scratch"
"""Name of the folder of a local cluster's own files, and of unpacked ones, in the build's."""


@dataclass
class Task(Generic[Value]):
    """Work that was asked for; done in a cluster, or here when its result is asked for."""

    work: Callable[[], Value]
    future: Any = None
    _done: list[Value] = field(default_factory=list)

    def result(self) -> Value:
        """What the work gave, or raises what it raised."""
        if not self._done:
            self._done.append(self.work() if self.future is None else _result(self.future))
        return self._done[0]


class Tasks:
    """Where work is done: in a cluster once there is one, in this process until then."""

    def __init__(self) -> None:
        self._starting: concurrent.futures.Future[distributed.Client] | None = None

    def use(self, starting: concurrent.futures.Future[distributed.Client]) -> None:
        """Do what is submitted from now on in the cluster that is being started."""
        self._starting = starting

    @property
    def in_cluster(self) -> bool:
        """Whether there is a cluster."""
        return self._starting is not None

    @property
    def workers(self) -> int:
        """How many tasks are done side by side, as far as is known now."""
        if self._starting is None:
            return 1
        return len(self._starting.result().scheduler_info(n_workers=-1)["workers"]) or 1

    def submit(
        self, function: Callable[..., Value], *arguments: Any, after: Sequence[Task[Any]] = ()
    ) -> Task[Value]:
        """Ask for a call of a function of a module, once the tasks `after` are done."""
        if self._starting is None:
            return Task(lambda: _here(function, arguments, after))
        client, waited = self._starting.result(), [task.future for task in after]
        key = f"{function.__name__.strip('_')}-{secrets.token_hex(8)}"
        return Task(
            lambda: function(*arguments),
            client.submit(_alone, function, arguments, waited, key=key, pure=False),
        )

    def results(self, tasks: Sequence[Task[Value]], done: Callable[[int], None]) -> list[Value]:
        """Results in order of the tasks; `done` is told how many there are so far.

        Raises what the first task to fail raised.
        """
        if self._starting is None:
            return [_counted(task, done, n) for n, task in enumerate(tasks, 1)]
        import distributed

        loop = self._starting.result().loop
        finished = distributed.as_completed([task.future for task in tasks], loop=loop)
        for n, future in enumerate(finished, 1):
            gc.collect(1)  # the young: of what is old there is little
            if future.status != "finished":
                _result(future)
            done(n)
        return [task.result() for task in tasks]

    def map(self, function: Callable[[Asked], Value], over: Sequence[Asked]) -> list[Value]:
        """What a function of a module gives for each of some arguments, in their order."""
        return self.results([self.submit(function, each) for each in over], lambda _: None)


def _here(
    function: Callable[..., Value], arguments: Sequence[Any], after: Sequence[Task[Any]]
) -> Value:
    for task in after:
        task.result()
    return function(*arguments)


def _counted(task: Task[Value], done: Callable[[int], None], number: int) -> Value:
    value = task.result()
    done(number)
    return value


@contextlib.contextmanager
def working(scheduler: str | None, shared: Sequence[Path]) -> Iterator[Workplace]:
    """Tasks, in the cluster at address `scheduler`, or in this process until more is asked for.

    The cluster must see the folders `shared`, of which the first is the build's, and run this
    very code in workers of one thread: MagtilesError if not, UsageError where there is none at
    the address.
    """
    with contextlib.ExitStack() as opened, concurrent.futures.ThreadPoolExecutor(1) as starter:
        place = Workplace(Tasks(), shared[0], opened, starter)
        if scheduler is not None:
            opened.enter_context(_garbage_collected_here())
            client = opened.enter_context(_connected(scheduler))
            _check_workers(client, shared)
            there: concurrent.futures.Future[distributed.Client] = concurrent.futures.Future()
            there.set_result(client)
            place.tasks.use(there)
        yield place


@dataclass(frozen=True)
class Workplace:
    """Tasks, and what it takes to give them a local cluster."""

    tasks: Tasks
    _folder: Path
    _opened: contextlib.ExitStack
    _starter: concurrent.futures.Executor

    def expand(self) -> None:
        """Have a local cluster, of a process per core, unless there is one; it starts meanwhile."""
        if not self.tasks.in_cluster:
            self._opened.enter_context(_garbage_collected_here())
            cluster = _local_cluster(self._folder / SCRATCH)
            self.tasks.use(self._starter.submit(self._opened.enter_context, cluster))


@contextlib.contextmanager
def _garbage_collected_here() -> Iterator[None]:
    """Garbage is collected by this thread alone, in `Tasks.results`.

    A thread of the cluster would close netCDF files that it finds there, and crash the process
    where this one is inside HDF5, which is not safe in several threads.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextlib.contextmanager
def _local_cluster(scratch: Path) -> Iterator[distributed.Client]:
    """A process per core, as far as memory goes round; a process that dies is replaced.

    What its workers keep for themselves is in the folder `scratch`, for as long as they live.
    """
    import dask
    import distributed

    try:
        with (
            dask.config.set({**CLUSTER_SETTINGS, "temporary-directory": str(scratch.absolute())}),
            _started_cluster() as cluster,
            contextlib.closing(distributed.Client(cluster, set_as_default=False)) as client,
        ):
            yield client
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _started_cluster() -> distributed.LocalCluster:
    """Raises MagtilesError where its workers die while they start, again and again."""
    import distributed
    from dask.system import CPU_COUNT
    from distributed.system import MEMORY_LIMIT

    for _ in range(_STARTS):
        try:
            return distributed.LocalCluster(
                n_workers=max(1, min(CPU_COUNT, MEMORY_LIMIT // _WORKER_BYTES)),
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as caught:  # it replaces only workers that have once been there
            failed = caught
    raise MagtilesError(f"no local cluster can be started ({failed})", remedy=_WORKERS_DIE)


@contextlib.contextmanager
def _connected(scheduler: str) -> Iterator[distributed.Client]:
    import distributed

    try:
        client = distributed.Client(scheduler, timeout=_PATIENCE_S, set_as_default=False)
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except (OSError, TimeoutError, ValueError) as caught:
        raise UsageError(
            f"no scheduler with workers answers ({str(caught) or type(caught).__name__})",
            where=f"--scheduler {scheduler}",
            expected="an address such as tcp://host:8786",
            remedy="start dask scheduler and dask worker --nthreads 1 there",
        ) from caught
    with contextlib.closing(client):
        yield client


def _check_workers(client: distributed.Client, shared: Sequence[Path]) -> None:
    """Raise MagtilesError unless every worker can do our work as we would."""
    for address, worker in client.scheduler_info(n_workers=-1)["workers"].items():
        if worker["nthreads"] != 1:
            raise MagtilesError(
                f"the worker has {worker['nthreads']} threads",
                where=address,
                expected="one: netCDF is not safe in several",
                remedy="start it with --nthreads 1",
            )
    try:
        client.run(importlib.metadata.version, "magtiles")
    except importlib.metadata.PackageNotFoundError as caught:
        raise MagtilesError(
            "a worker has no magtiles", where=client.scheduler.address, remedy="install it there"
        ) from caught
    _compare(
        client.run(_describe_worker),
        _describe_worker(),
        ("this version of magtiles", "these versions of libraries"),
    )
    for folder in shared:
        _check_sight(client, folder.absolute())


def _check_sight(client: distributed.Client, folder: Path) -> None:
    """Raise MagtilesError unless every worker sees what is in a folder."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        token = folder / f".shared.{secrets.token_hex(8)}.tmp"
        token.write_text(token.name, encoding="utf-8")
    try:
        found = client.run(_read_token, token)
    finally:
        token.unlink(missing_ok=True)
    for address, seen in found.items():
        if seen != token.name:
            raise MagtilesError(
                "the worker does not see a folder of this build",
                where=address,
                expected=str(folder),
                remedy="give it the same file system",
            )


def _compare(found: Mapping[str, Sequence[Any]], own: Sequence[Any], names: Sequence[str]) -> None:
    for address, theirs in found.items():
        for name, ours, its in zip(names, own, theirs, strict=True):
            if ours != its:
                raise MagtilesError(
                    f"the worker has not {name}",
                    where=address,
                    expected=str(ours),
                    remedy="give it the same environment",
                )


def _describe_worker() -> tuple[str, dict[str, str]]:
    return receipts.code_digest(), receipts.package_versions()


def _read_token(token: Path) -> str:
    try:
        return token.read_text(encoding="utf-8")
    except OSError:
        return ""


def _alone(function: Callable[..., Value], arguments: Sequence[Any], after: Sequence[Any]) -> Value:
    """Run in a worker, which has its core for itself and no more: `after` only makes it wait."""
    import numba

    numba.set_num_threads(1)
    return function(*arguments)


def _result(future: Any) -> Any:
    import distributed
    from distributed.scheduler import NoWorkerError

    try:
        return future.result()
    except (distributed.KilledWorker, NoWorkerError) as caught:
        raise MagtilesError(
            f"workers died again and again ({caught})",
            remedy=_WORKERS_DIE,
        ) from caught
    except concurrent.futures.CancelledError as caught:
        raise MagtilesError(
            "the work was cancelled", remedy="check that the scheduler still runs"
        ) from caught
