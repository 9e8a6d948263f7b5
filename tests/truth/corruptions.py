"""Random damage to a release: none may go by in silence.

Run as a script, ``python tests/truth/corruptions.py [COUNT]`` damages a small signed release
COUNT (2,000) times, one damage at a time, opens it and reads everything, without the public key
and with it, and prints how each kind was met. Status 1 when a damage went by in silence.

A manifest that was edited and sealed again, with a true digest, is another manifest: where it
contradicts no file, only the signature tells.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magtiles.catalog import open_release
from magtiles.catalog.models.igrf import igrf_files
from magtiles.catalog.releases.digest import array_digest, canonical_json, manifest_digest, sha256
from magtiles.schemas.errors import MagtilesError

MANIFEST, SIGNATURE = "manifest.json", "manifest.json.minisig"


def everything(folder: Path, key: Path | None = None) -> dict[str, str]:
    """Digests of all that a release answers: identity, every array and file, some queries."""
    release = open_release(folder, public_key=key, require_signature=key is not None)
    manifest = release.manifest
    told = {k: v for k, v in manifest.document.items() if k not in ("files", "manifest_digest")}
    answers = {"told": sha256(canonical_json(told))}
    for file in manifest.files:
        answers[file.path] = sha256(release.file(file.path))
    for tile in release.tiles():
        record = tile.record
        said = [record.array_digest, record.bounds, record.statistics, record.flag_fractions]
        answers[f"tile {record.row}, {record.column}"] = array_digest(tile.variables)
        answers[f"said of {record.row}, {record.column}"] = sha256(canonical_json(said))
    if manifest.temporal is not None:
        model = release.temporal
        answers["temporal"] = array_digest({k: np.asarray(v) for k, v in model.variables.items()})
    lattice = manifest.lattice
    latitude = np.linspace(lattice.south, lattice.north, 7)
    longitude = np.linspace(lattice.west, lattice.east, 7)
    values = release.anomaly.total(latitude, longitude, manifest.heights_m[-1])
    answers["query"] = sha256(np.ascontiguousarray(values).tobytes())
    return answers


@dataclass
class Vandal:
    """Damages the copy of a release in `folder`; `whole` holds the bytes of its files."""

    folder: Path
    whole: dict[str, bytes]
    rng: np.random.Generator

    def pick(self) -> str:
        """Any file of the release."""
        return str(self.rng.choice(sorted(self.whole)))

    def other(self, path: str) -> str:
        return str(self.rng.choice([p for p in sorted(self.whole) if p != path]))

    def spot(self, data: bytes) -> int:
        return int(self.rng.integers(len(data)))

    def flip_bit(self) -> None:
        path = self.pick()
        data = bytearray(self.whole[path])
        data[self.spot(data)] ^= 1 << int(self.rng.integers(8))
        self.write(path, data)

    def garble_block(self) -> None:
        path = self.pick()
        data = bytearray(self.whole[path])
        start = self.spot(data)
        block = data[start : start + int(self.rng.integers(1, 4097))]
        data[start : start + len(block)] = self.rng.bytes(len(block))
        self.write(path, data)

    def truncate(self) -> None:
        path = self.pick()
        self.write(path, self.whole[path][: self.spot(self.whole[path])])

    def lengthen(self) -> None:
        path = self.pick()
        self.write(path, self.whole[path] + self.rng.bytes(int(self.rng.integers(1, 100))))

    def swap(self) -> None:
        one = self.pick()
        other = self.other(one)
        self.write(one, self.whole[other])
        self.write(other, self.whole[one])

    def overwrite(self) -> None:
        path = self.pick()
        self.write(path, self.whole[self.other(path)])

    def remove(self) -> None:
        (self.folder / self.pick()).unlink()

    def add(self) -> None:
        path = self.folder / str(
            self.rng.choice(["tiles/r000c009.nc", "x.py", "preview/x.png", "x"])
        )
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(self.whole[self.pick()])

    def edit_manifest(self) -> None:
        """One value of the manifest, its digest left as it was."""
        document = json.loads(self.whole[MANIFEST])
        self.edit(document)
        self.write(MANIFEST, canonical_json(document))

    def edit_and_seal(self) -> None:
        """One value of the manifest, and its digest made true again."""
        document = json.loads(self.whole[MANIFEST])
        self.edit(document)
        document["manifest_digest"] = manifest_digest(document)
        self.write(MANIFEST, canonical_json(document))

    def reassign_and_seal(self) -> None:
        """A file's record given an entry of another's or taken out, and a true digest."""
        document = json.loads(self.whole[MANIFEST])
        files = document["files"]
        record = files[int(self.rng.integers(len(files)))]
        key = str(self.rng.choice(["sha256", "size", "path", "role", "array_digest"]))
        other = files[int(self.rng.integers(len(files)))]
        if key not in record or record[key] == other.get(key):
            files.remove(record)
        elif key in other:
            record[key] = other[key]
        else:
            record["sha256"] = sha256(self.rng.bytes(8))
        document["manifest_digest"] = manifest_digest(document)
        self.write(MANIFEST, canonical_json(document))

    def edit(self, document: Any) -> None:
        """Change one leaf, anywhere."""
        holder, key = self.leaf(document)
        old = holder[key]
        if isinstance(old, str):
            holder[key] = old[:-1] + ("0" if not old.endswith("0") else "1")
        elif isinstance(old, (int, float)) and not isinstance(old, bool):
            holder[key] = old + 1
        else:
            holder[key] = "0"

    def leaf(self, document: Any) -> tuple[Any, Any]:
        holder, key = document, self.key(document)
        while isinstance(holder[key], (dict, list)) and holder[key]:
            holder = holder[key]
            key = self.key(holder)
        return holder, key

    def key(self, holder: Any) -> Any:
        keys = sorted(holder) if isinstance(holder, dict) else range(len(holder))
        return list(keys)[int(self.rng.integers(len(keys)))]

    def write(self, path: str, data: bytes | bytearray) -> None:
        (self.folder / path).write_bytes(data)


KINDS: tuple[Callable[[Vandal], None], ...] = (
    Vandal.flip_bit, Vandal.garble_block, Vandal.truncate, Vandal.lengthen, Vandal.swap,
    Vandal.overwrite, Vandal.remove, Vandal.add, Vandal.edit_manifest, Vandal.edit_and_seal,
    Vandal.reassign_and_seal,
)  # fmt: skip
SEALED = ("edit_and_seal", "reassign_and_seal")


@dataclass
class Tally:
    """How damages were met, by kind.

    Attributes
    ----------
    refused : by the reader without a key.
    without_effect : the bytes were the same, but for the comment that a signature leaves free.
    needs_key : what the reader took without a key and refused with it: manifests with a true
        digest, and damaged signatures, which nobody looks at without the key.
    accepted : taken with the key, or without it although neither of those.
    """

    refused: Counter[str]
    without_effect: Counter[str]
    needs_key: Counter[str]
    accepted: list[str]


def corrupt(release: Path, key: Path, work: Path, count: int, seed: int = 1) -> Tally:
    """Damage a copy of a signed release in `work` `count` times, one at a time, kinds in turn."""
    copy, whole = work / "copy", contents(release)
    tally = Tally(Counter(), Counter(), Counter(), [])
    vandal = Vandal(copy, whole, np.random.default_rng(seed))
    restore(copy, whole)
    assert everything(copy) == everything(copy, key)
    for i in range(count):
        kind = KINDS[i % len(KINDS)].__name__
        KINDS[i % len(KINDS)](vandal)
        damaged = contents(copy)
        if meant(damaged) == meant(whole):  # such as a file overwritten by one like it
            tally.without_effect[kind] += 1
            continue
        if not is_read(copy):
            tally.refused[kind] += 1
        elif kind in SEALED or {**damaged, SIGNATURE: whole[SIGNATURE]} == whole:
            tally.needs_key[kind] += 1
        else:
            tally.accepted.append(f"{i} {kind}, without the key")
        if is_read(copy, key):
            tally.accepted.append(f"{i} {kind}, with the key")
        restore(copy, whole)
    return tally


def meant(files: dict[str, bytes]) -> dict[str, bytes]:
    """The files but for the free text of the signature's first line."""
    start, _, rest = files.get(SIGNATURE, b"").partition(b"\n")
    free = b"untrusted comment: "
    return {**files, SIGNATURE: rest if start.startswith(free) else start + b"\n" + rest}


def is_read(folder: Path, key: Path | None = None) -> bool:
    """Whether a release is opened and read whole without an error."""
    try:
        everything(folder, key)
    except MagtilesError:
        return False
    return True


def contents(folder: Path) -> dict[str, bytes]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()
    }


def restore(copy: Path, whole: dict[str, bytes]) -> None:
    shutil.rmtree(copy, ignore_errors=True)
    for path, data in whole.items():
        (copy / path).parent.mkdir(parents=True, exist_ok=True)
        (copy / path).write_bytes(data)


def small_release(store: Path) -> tuple[Path, Path]:
    """Four tiles of two levels, a temporal model, a core field, a picture; signed. And the key."""
    from synthetic_release import World
    from temporal import temporal_dataset

    from magtiles.catalog.releases.lattice import Lattice
    from magtiles.stages.release.sign import generate_keys, sign_release
    from magtiles.stages.release.temporal_file import write_temporal

    store.mkdir(parents=True, exist_ok=True)
    write_temporal(temporal_dataset(), store / "temporal.nc")
    (store / "map.png").write_bytes(b"\x89PNG a picture")
    extra = {"temporal.nc": store / "temporal.nc", "preview/map.png": store / "map.png"}
    extra["core_field.shc"] = igrf_files()[14]
    lattice = Lattice(44.0, 10.0, 0.009, 0.0125, rows=8, columns=8, tile_rows=4, tile_columns=4)
    world = World(lattice=lattice, heights=(0.0, 1000.0))
    release = world.publish(store, extra_files=extra).path
    generate_keys(store / "a.key", store / "a.pub")
    sign_release(release, store / "a.key")
    return release, store / "a.pub"


@contextlib.contextmanager
def workplace() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(folder)


def main() -> int:
    with workplace() as work:
        release, key = small_release(work / "store")
        tally = corrupt(release, key, work, int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
    print("kind               refused  needs the key  no effect")
    for kind in (k.__name__ for k in KINDS):
        counts = (tally.refused[kind], tally.needs_key[kind], tally.without_effect[kind])
        print(f"{kind:18} {counts[0]:7} {counts[1]:14} {counts[2]:10}")
    print(f"{len(tally.accepted)} accepted without a word; with the key every one was refused"
          if not tally.accepted else "\n".join(tally.accepted))  # fmt: skip
    return 1 if tally.accepted else 0


if __name__ == "__main__":
    sys.exit(main())
