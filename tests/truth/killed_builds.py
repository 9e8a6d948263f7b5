"""Builds that are killed, or run out of room, at random moments, and what they leave behind.

``python tests/truth/killed_builds.py 50`` disturbs 50 builds of a small map, some of them with a
local cluster. After each it looks at the store, waits for orphans, builds once more, and compares
what is then there with what an undisturbed build leaves. ``--how`` names the disturbances.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import gzip
import hashlib
import importlib
import os
import random
import resource
import shutil
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import psutil

from magtiles.pipeline.main import main
from magtiles.pipeline.sample import DEMO, synthesize, write_survey
from magtiles.pipeline.validate import validate_release

SPEC = replace(DEMO, name="small", width_m=60e3, length_m=50e3, dipoles=30, levels_m=(2500.0,))
KILLED = -signal.SIGKILL

_PATIENCE_S = 60.0
"""How long orphans may take to notice, on a machine that does much else."""
_IMPORTED = ("magtiles.pipeline.build", "matplotlib.backends.backend_agg", "distributed")
"""Once by the program, rather than by each of its builds."""
_FREE = resource.RLIM_INFINITY


def write_product(folder: Path, *, in_blocks: bool) -> Path:
    """A product of two levels and several tiles; in blocks, which asks for a cluster, or whole.

    Its survey is packed.
    """
    survey, source, product = write_survey(folder, synthesize(SPEC))
    packed = survey.with_name(f"{survey.name}.gz")
    packed.write_bytes(gzip.compress(survey.read_bytes(), mtime=0))
    survey.unlink()
    source.write_text(source.read_text().replace(survey.name, packed.name))
    blocks = "block_nodes = 128\n" if in_blocks else ""
    product.write_text(f"{product.read_text()}tile_deg = 0.25\n{blocks}")
    return product


@dataclass(frozen=True)
class Place:
    """Where builds of a product happen, and nothing else does: the user's folder and /tmp too."""

    within: Path
    in_cluster: bool

    @functools.cached_property
    def product(self) -> Path:
        """The product."""
        return write_product(self.within / "in", in_blocks=self.in_cluster)

    @property
    def folder(self) -> Path:
        """Where everything is that builds write."""
        return self.within / "out"

    @property
    def store(self) -> Path:
        """The folder of all releases."""
        return self.folder / "store"

    @property
    def said(self) -> str:
        """What the last build printed."""
        return (self.within / "log").read_text()

    def files(self) -> set[str]:
        """Everything that is there."""
        return {str(path.relative_to(self.folder)) for path in self.folder.rglob("*")}

    def releases(self) -> dict[str, str]:
        """The digest of every published file."""
        return {
            str(path.relative_to(self.store)): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in sorted(self.store.rglob("*"))
            if path.is_file() and not path.relative_to(self.store).parts[1].startswith(".")
        }

    def start(self, largest_file: int = _FREE) -> int:
        """Begin a build in a process and session of its own; gives its number."""
        store, work = str(self.store), str(self.folder / "work")
        named = ["build", str(self.product), "--store", store, "--work", work]
        process = os.fork()
        if process == 0:
            status = 70
            try:
                self._enter(largest_file)
                status = main(named)
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(status)
        return process

    def _enter(self, largest_file: int) -> None:
        os.setsid()
        for name in ("home", "tmp"):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        os.chdir(self.folder / "home")
        os.environ["TMPDIR"], tempfile.tempdir = str(self.folder / "tmp"), None
        log = os.open(self.within / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

    def build(self) -> None:
        """Build without being disturbed."""
        status = waited(self.start())
        assert status == 0, f"a build failed with {status}:\n{self.said}"


def waited(process: int) -> int:
    """The exit status of a process, minus the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def of_session(leader: int) -> list[psutil.Process]:
    """The living processes of a session."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            zombie = process.status() == psutil.STATUS_ZOMBIE
            if os.getsid(process.pid) == leader and not zombie:
                found.append(process)
    return found


def workers(leader: int) -> list[psutil.Process]:
    """The workers of a build's cluster."""
    found = []
    for process in of_session(leader):
        with contextlib.suppress(psutil.Error):
            if "spawn_main" in " ".join(process.cmdline()):
                found.append(process)
    return found


def ended(process: int) -> bool:
    """Whether a child has ended; it stays to be waited for."""
    flags = os.WEXITED | os.WNOHANG | os.WNOWAIT
    return os.waitid(os.P_PID, process, flags) is not None


def kill_all(process: int, _: random.Random) -> None:
    """As when the machine loses power: build and workers at once."""
    os.killpg(process, signal.SIGKILL)


def kill_build(process: int, _: random.Random) -> None:
    """The build alone: its workers must notice."""
    os.kill(process, signal.SIGKILL)


def kill_worker(process: int, chance: random.Random) -> None:
    """A worker, as when memory runs out: the build must not mind."""
    while not ended(process):
        if there := workers(process):
            with contextlib.suppress(psutil.Error):
                chance.choice(there).kill()
            return
        time.sleep(0.02)


def let_be(_: int, __: random.Random) -> None:
    """Nothing: what it was started with disturbs it."""


@dataclass(frozen=True)
class Disturbance:
    """How a build is disturbed, with which exit statuses it may then end, and which build it is.

    `largest_file` is the exponent of two of the largest file, from and to.
    """

    disturb: Callable[[int, random.Random], None]
    statuses: tuple[int, ...]
    in_cluster: bool
    largest_file: tuple[float, float] | None = None


HOW = {
    "alone": Disturbance(kill_all, (KILLED, 0), in_cluster=False),
    "all": Disturbance(kill_all, (KILLED, 0), in_cluster=True),
    "build": Disturbance(kill_build, (KILLED, 0), in_cluster=True),
    "worker": Disturbance(kill_worker, (0,), in_cluster=True),
    "disk": Disturbance(let_be, (1,), in_cluster=False, largest_file=(9.0, 19.9)),
}


@dataclass(frozen=True)
class Undisturbed:
    """What a build leaves that nothing disturbs, and how long it takes."""

    files: set[str]
    releases: dict[str, str]
    seconds: float

    @classmethod
    def of(cls, place: Place) -> Undisturbed:
        """Build, and look."""
        clear(place.folder)
        begun = time.monotonic()
        place.build()
        seconds = time.monotonic() - begun
        (release,) = (path.parent for path in place.store.rglob("manifest.json"))
        assert all(check.passed for check in validate_release(release))
        for name in ("home", "tmp"):
            assert not list((place.folder / name).iterdir()), f"{name} is not empty"
        return cls(place.files(), place.releases(), seconds)


def check_disturbed(how: str, place: Place, expected: Undisturbed, status: int) -> str:
    """Raise AssertionError for what must not be after a disturbance; says how far the build was."""
    assert status in HOW[how].statuses, f"ended with {status}:\n{place.said}"
    if status == 1:
        check_told(place)
    published = place.releases()
    whole = {k: v for k, v in expected.releases.items() if not k.endswith("latest.json")}
    if published:
        assert published == expected.releases or published == whole, "half a release is published"
    return "published" if published else f"{sum('receipt' in f for f in place.files())} receipts"


def check_told(place: Place) -> None:
    """Raise AssertionError unless the build said which file it could not write, and what to do."""
    (line,) = place.said.splitlines()
    assert line.startswith(f"magtiles: error: {place.folder}"), line
    assert "cannot be written" in line, line
    assert "internal" not in line, line
    assert "space" in line, line


def check_orphans(leader: int) -> None:
    """Raise AssertionError where processes of a build that is no more go on."""
    given_up = time.monotonic() + _PATIENCE_S
    while left := of_session(leader):
        assert time.monotonic() < given_up, f"still at work: {left}"
        time.sleep(0.05)


def check_next(place: Place, expected: Undisturbed) -> None:
    """Raise AssertionError unless the next build ends as if nothing had been."""
    place.build()
    assert place.releases() == expected.releases, "other bytes"
    left = place.files()
    assert left == expected.files, f"stray {left - expected.files}, no {expected.files - left}"


@dataclass(frozen=True)
class Moment:
    """A build that was disturbed: how, after which part of a build's time, how far it was."""

    how: str
    when: float
    state: str


def disturbed(folder: Path, how: Sequence[str], count: int, seed: int) -> Iterator[Moment]:
    """Disturb `count` builds, at moments spread over the time that one takes.

    Raises AssertionError for the first that leaves what it should not.
    """
    chance = random.Random(seed)
    expected = {}
    for number in range(count):
        kind, part = how[number % len(how)], (number + chance.random()) / count
        wanted = HOW[kind]
        place = Place(folder / ("cluster" if wanted.in_cluster else "alone"), wanted.in_cluster)
        if place not in expected:
            expected[place] = Undisturbed.of(place)
        clear(place.folder)
        process = place.start(largest_file(wanted, part))
        time.sleep(0.0 if wanted.largest_file else part * expected[place].seconds)
        if not ended(process):
            wanted.disturb(process, chance)
        state = check_disturbed(kind, place, expected[place], waited(process))
        check_orphans(process)
        check_next(place, expected[place])
        clear(place.folder)  # what is read-only would stop who removes it later
        yield Moment(kind, part, state)


def largest_file(how: Disturbance, part: float) -> int:
    """How large files may grow: the least at first, enough for an error, then evenly by factors."""
    if how.largest_file is None:
        return _FREE
    least, most = how.largest_file
    return int(2 ** (least + part * (most - least)))


def clear(folder: Path) -> None:
    """Remove a folder, with the releases in it that are read-only."""
    for inner, _, _ in os.walk(folder):
        Path(inner).chmod(0o755)
    shutil.rmtree(folder, ignore_errors=True)


def run() -> None:
    """The program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--how", nargs="+", default=list(HOW), choices=list(HOW))
    parser.add_argument("--seed", type=int, default=20261122)
    parser.add_argument("--folder", type=Path, help="kept, to look at (default: a temporary one)")
    asked = parser.parse_args()
    for module in _IMPORTED:
        importlib.import_module(module)
    with contextlib.ExitStack() as opened:
        folder: Path = asked.folder or Path(opened.enter_context(tempfile.TemporaryDirectory()))
        states: Counter[str] = Counter()
        for moment in disturbed(folder, asked.how, asked.count, asked.seed):
            print(f"{moment.how:8s} at {moment.when:.3f}: {moment.state}", flush=True)
            states[moment.how] += 1
    print(f"nothing half published, nothing left over: {dict(states)}")


if __name__ == "__main__":
    run()
