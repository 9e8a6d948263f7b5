"""Builds that are killed, run out of room, are refused it, or meet: whole releases or none."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import killed_builds
import pytest

from magtiles.pipeline.build import build_product
from magtiles.schemas.errors import MagtilesError, SourceError
from magtiles.stages.release.lock import locked

MAGTILES = [
    sys.executable,
    "-c",
    "import sys; from magtiles.pipeline.main import main; sys.exit(main())",
]
UNSHARE = ("unshare", "--mount", "--map-root-user", "--user")


@pytest.fixture(scope="module")
def product(tmp_path_factory) -> Path:
    return killed_builds.write_product(tmp_path_factory.mktemp("in"), in_blocks=False)


@pytest.fixture(scope="module")
def built(product, tmp_path_factory) -> Path:
    """The folder of a store and of a work folder after a build."""
    folder = tmp_path_factory.mktemp("built")
    build_product(product, store=folder / "store", work=folder / "work")
    return folder


def test_builds_disturbed_at_random_moments():
    """Some of what the program does with many: a full disk, and a build whose workers lose it."""
    program = [sys.executable, killed_builds.__file__, "2", "--how", "disk", "build"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    told = done.stdout.splitlines()[-1]
    assert told == "nothing half published, nothing left over: {'disk': 1, 'build': 1}"


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def test_a_second_build_of_a_product_waits_for_the_first(product, built, tmp_path):
    store, work = tmp_path / "store", built / "work"
    before = files(work)
    command = [*MAGTILES, "build", str(product), "--store", str(store), "--work", str(work)]
    with locked(work / "small", ".build.lock", doing="building"):
        second = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert second.stderr is not None
        told = second.stderr.readline()
        assert told.endswith(f"another process is building in {work / 'small'}: waiting for it\n")
        assert not store.exists()
    out, rest = second.communicate()
    assert (second.returncode, rest) == (0, "")
    assert out.startswith(f"{store / 'small' / '1.0.0'}: published\n")
    assert files(work) == before
    assert sorted(p.name for p in (store / "small").iterdir()) == ["1.0.0", "latest.json"]


def mounted(
    script: str, arguments: Sequence[str], folder: Path
) -> subprocess.CompletedProcess[str]:
    """Run a script of a shell that mounts file systems; skips where that is not allowed."""
    if shutil.which("unshare") is None:
        pytest.skip("no unshare")
    allowed = [*UNSHARE, "mount", "-t", "tmpfs", "tmpfs", str(folder)]
    if subprocess.run(allowed, capture_output=True, check=False).returncode != 0:
        pytest.skip("mounting is not allowed")
    command = [*UNSHARE, "sh", "-ec", script, "sh", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_a_read_only_store_is_told_before_the_work(product, tmp_path):
    (tmp_path / "store").mkdir()
    script = 'mount -t tmpfs -o ro tmpfs store; "$@" --store store --work work'
    done = mounted(script, [*MAGTILES, "build", str(product)], tmp_path)
    assert done.returncode == 1
    assert done.stderr == (
        "magtiles: error: store/small: cannot be written to; expected a folder, or a place to make "
        "one; choose another, or change its permissions\n"
    )
    assert files(tmp_path) == {"store"}


def test_a_full_store_publishes_nothing(product, built, tmp_path):
    (tmp_path / "store").mkdir()
    script = (
        "mount -t tmpfs -o size=500k tmpfs store; "
        'status=0; "$@" --store store || status=$?; find store; exit $status'
    )
    work = ["--work", str(built / "work")]
    done = mounted(script, [*MAGTILES, "build", str(product), *work], tmp_path)
    assert done.returncode == 1
    assert done.stderr == (
        "magtiles: error: store/small/1.0.0: cannot be written (No space left on device); check "
        "free space, the limit of file sizes (ulimit -f) and permissions\n"
    )
    assert done.stdout.split() == ["store", "store/small"]


def test_a_file_in_the_place_of_a_folder(product, tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "small").touch()
    with pytest.raises(MagtilesError, match=r"store/small: .*store/small is no folder"):
        build_product(product, store=tmp_path / "store", work=tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_an_input_that_disappears_makes_its_release_stale(product, built, tmp_path):
    copied = Path(shutil.copytree(product.parent, tmp_path / "in"))
    description = (copied / "small-survey.toml").rename(tmp_path / "away.toml")
    with pytest.raises(SourceError, match=r"small-survey\.toml.* built from it, stays as it is"):
        build_product(copied / "small.toml", store=built / "store", work=built / "work")
    description.rename(copied / "small-survey.toml")
    (copied / "small-survey.tif.gz").unlink()
    stale = r"small-survey\.toml: 1 of the 1 data files of 'small-survey' is missing: no file .*"
    with pytest.raises(SourceError, match=stale + "1.0.0, built from it, stays as it is and may"):
        build_product(copied / "small.toml", store=built / "store", work=built / "work")
    with pytest.raises(SourceError, match=stale + "put it there, or name the folder"):
        build_product(copied / "small.toml", store=tmp_path / "store", work=built / "work")
    assert not (tmp_path / "store").exists()


SOURCE = '[source]\nid = "more"\nfiles = ["gone.dat"]\nlicence = "none"\nkind = '
MORE = {
    "surface": ('"surface-grid"', 'surface = "more.toml"'),
    "observatory": (
        '"observatory-series"',
        '[temporal]\nobservatories = ["more.toml"]\nmonths = ["2020-01"]',
    ),
    "log": ('"track"', '[[roads]]\nname = "road"\nlogs = {car = ["more.toml"]}'),
}


@pytest.mark.parametrize(("kind", "asked"), MORE.values(), ids=MORE)
def test_files_of_every_kind_of_source_are_missed_before_the_work(product, tmp_path, kind, asked):
    copied = Path(shutil.copytree(product.parent, tmp_path / "in"))
    (copied / "more.toml").write_text(f"{SOURCE}{kind}\n")
    for file in (copied / "small.toml", copied / "small-survey.toml"):
        text = file.read_text()
        file.write_text(text.replace('"ellipsoid"', '"terrain"') if "surface" in kind else text)
    (copied / "small.toml").write_text(f"{(copied / 'small.toml').read_text()}{asked}\n")
    with pytest.raises(SourceError, match=r"more\.toml: .* of 'more' is missing: no file .*gone"):
        build_product(copied / "small.toml", store=tmp_path / "store", work=tmp_path / "work")
    assert files(tmp_path) == {"in", *(f"in/{name}" for name in files(copied))}


def test_nothing_is_written_when_nothing_changed(product, built):
    def state() -> dict[str, tuple[int, int]]:
        stats = {str(p): p.stat() for p in built.rglob("*") if p.is_file()}
        return {name: (stat.st_ino, stat.st_mtime_ns) for name, stat in stats.items()}

    before = state()
    assert not build_product(product, store=built / "store", work=built / "work").changed
    assert state() == before
