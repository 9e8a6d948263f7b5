"""What validation adds to the reader: signatures, hostile files, and what a manifest only says."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import pytest
from corruptions import SEALED, corrupt, small_release

from magtiles.catalog.releases.digest import canonical_json, manifest_digest, sha256
from magtiles.pipeline.main import main
from magtiles.pipeline.validate import Check, validate_release


@pytest.fixture(scope="module")
def signed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return small_release(tmp_path_factory.mktemp("trust"))


@pytest.fixture
def copy(signed: tuple[Path, Path], tmp_path: Path) -> Path:
    folder = shutil.copytree(signed[0], tmp_path / "1.0.0", copy_function=shutil.copyfile)
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755)
    return folder


def test_no_damage_goes_by_in_silence(signed: tuple[Path, Path], tmp_path: Path) -> None:
    """220 of the 2,000 that tests/truth/corruptions.py makes when it is run as a script."""
    tally = corrupt(*signed, tmp_path, 220, seed=3)
    assert tally.accepted == []
    told = sum(tally.refused.values()) + sum(tally.needs_key.values())
    assert told + sum(tally.without_effect.values()) == 220
    assert sum(tally.refused.values()) > 170
    assert set(tally.needs_key) >= set(SEALED[:1])  # or sealing would not have been tried


def seal(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads((folder / "manifest.json").read_bytes())
    change(document)
    document["manifest_digest"] = manifest_digest(document)
    (folder / "manifest.json").write_bytes(canonical_json(document))


def failures(folder: Path, **options: Any) -> dict[str, Check]:
    return {c.name: c for c in validate_release(folder, **options) if not c.passed}


class Lie(NamedTuple):
    change: Callable[[dict[str, Any]], Any]
    message: str


def in_tile(key: str, value: Any, *path: str) -> Callable[[dict[str, Any]], Any]:
    def change(document: dict[str, Any]) -> None:
        holder = document["files"][0][key]
        for step in path[:-1]:
            holder = holder[step]
        holder[path[-1]] = value

    return change


LIES = [
    Lie(lambda d: d["identity"].update(reference_field="IGRF-9"), "reference_field is 'none'"),
    Lie(lambda d: d["identity"].update(reference_epoch="1999-01-01"), "reference_epoch"),
    Lie(in_tile("flag_fractions", 0.5, "void_filled"), "void_filled is 0.0; expected 0.5"),
    Lie(in_tile("statistics", [0.1, 0.1], "vector_uncertainty", "rms"), "rms of vector_uncert"),
]


@pytest.mark.parametrize("lie", LIES, ids=lambda lie: lie.message)
def test_a_sealed_manifest_must_say_what_the_tiles_do(lie: Lie, copy: Path) -> None:
    seal(copy, lie.change)
    assert lie.message in failures(copy)["descriptions"].where


def test_a_tile_that_could_crash_its_reader_is_not_opened(copy: Path) -> None:
    """A ring of groups: the netCDF library would follow it until the memory is full."""
    path = copy / "tiles/r000c000.nc"
    with h5py.File(path, "r+") as file:
        file.create_group("a")["up"] = file["/"]
    data = path.read_bytes()
    seal(copy, lambda d: d["files"][0].update(size=len(data), sha256=sha256(data)))
    assert list(failures(copy)) == ["self-contained"]


def test_signatures_are_checked_when_a_key_is_given(
    signed: tuple[Path, Path], copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = str(signed[1])
    command = ["validate", str(copy), "--public-key", key]
    assert main([*command, "--require-signature"]) == 0
    assert "magtiles release demo 1.0.0 file:manifest.json" in capsys.readouterr().out
    kept = (copy / "manifest.json.minisig").read_bytes()
    (copy / "manifest.json.minisig").unlink()
    assert main(command) == 0
    assert main([*command, "--require-signature"]) == 1
    (copy / "manifest.json.minisig").write_bytes(kept)
    seal(copy, lambda d: d["inputs"][0].update(licence="none"))
    assert main(["validate", str(copy)]) == 0
    assert main(command) == 1
    assert list(failures(copy, public_key=signed[1])) == ["signature"]


def test_a_requirement_without_a_key_is_bad_use(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["validate", str(copy), "--require-signature"]) == 2
    assert "without --public-key" in capsys.readouterr().err


def test_keys_and_signatures_from_the_command_line(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    secret, public = str(tmp_path / "a.key"), str(tmp_path / "a.pub")
    assert main(["keygen", "--secret", secret, "--public", public]) == 0
    assert main(["keygen", "--secret", secret, "--public", public]) == 2
    assert main(["sign", str(copy), "--key", secret]) == 0
    assert main(["validate", str(copy), "--public-key", public, "--require-signature"]) == 0
    assert main(["sign", str(copy), "--key", public]) == 1
    assert "is no" not in capsys.readouterr().out
