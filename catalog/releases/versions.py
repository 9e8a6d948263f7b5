"""Semantic versions of releases: which bump a change is due."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from magtiles.catalog.releases.lattice import Lattice
from magtiles.catalog.releases.manifest import (
    VERSION,
    FileRecord,
    Manifest,
    RoadRecord,
    TemporalRecord,
    TileRecord,
)
from magtiles.schemas.errors import VersionError

Version = tuple[int, int, int]

BUMPS = ("major", "minor", "patch")

_NOT_CONTENT = ("checks", "provenance", "preview")
"""Roles that describe or depict a build; a rebuild may word them anew without a new version."""

_NODE_TOLERANCE = 1e-6
"""Cells by which two lattices may differ and still share their nodes."""


@dataclass(frozen=True)
class Change:
    """What differs between two releases: the bump it is due (None: nothing), and why."""

    bump: str | None
    reason: str


def parse_version(text: str) -> Version:
    """``major.minor.patch`` as numbers. Raises VersionError."""
    if not re.fullmatch(VERSION, text):
        raise VersionError(f"'{text}' is no version", expected="major.minor.patch, such as 1.0.0")
    major, minor, patch = (int(part) for part in text.split("."))
    return major, minor, patch


def format_version(version: Version) -> str:
    """Numbers as ``major.minor.patch``."""
    return ".".join(str(part) for part in version)


def bumped(version: Version, bump: str) -> Version:
    """The next version after `version` that is a `bump`."""
    major, minor, patch = version
    return {
        "major": (major + 1, 0, 0),
        "minor": (major, minor + 1, 0),
        "patch": (major, minor, patch + 1),
    }[bump]


def required_bump(old: Manifest, new: Manifest) -> Change:
    """The smallest bump that tells a user what changed from `old` to `new`.

    Major when the datum, a unit, the reference field, the definition, the grid or the meaning
    of height changes; minor when any value or the coverage does; patch when only the
    description does, such as a licence, or attributes of a tile whose arrays are the same.
    """
    for bump, reasons in (
        ("major", _new_meaning(old, new)),
        ("minor", _new_values(old, new)),
        ("patch", _new_description(old, new)),
    ):
        for reason in reasons:
            return Change(bump, reason)
    return Change(None, "nothing changed")


def _new_meaning(old: Manifest, new: Manifest) -> Iterable[str]:
    for key in sorted(set(old.identity) | set(new.identity)):
        before, after = old.identity.get(key), new.identity.get(key)
        if before != after:
            yield f"identity {key} changed from {before!r} to {after!r}"
    if old.height_reference != new.height_reference:
        yield f"height_reference changed from {old.height_reference} to {new.height_reference}"
    if old.has_reference_surface != new.has_reference_surface:
        yield "reference_surface_height came or went, and with it the meaning of height"
    if not _same_nodes(old.lattice, new.lattice):
        yield f"the grid changed from {_spell(old.lattice)} to {_spell(new.lattice)}"


def _spell(lattice: Lattice) -> str:
    spacing = f"{lattice.latitude_spacing:.9g} x {lattice.longitude_spacing:.9g} degrees"
    corner = f"latitude {lattice.south:.9g}, longitude {lattice.west:.9g}"
    return f"{lattice.rows} x {lattice.columns} cells of {spacing} from {corner}"


def _same_nodes(a: Lattice, b: Lattice) -> bool:
    """Whether two lattices have the same spacing and their nodes coincide."""
    for spacing, other, start, begin in (
        (a.latitude_spacing, b.latitude_spacing, a.south, b.south),
        (a.longitude_spacing, b.longitude_spacing, a.west, b.west),
    ):
        cells = (start - begin) / spacing
        count = max(a.rows, a.columns, b.rows, b.columns)
        if abs(spacing - other) / spacing * count > _NODE_TOLERANCE:
            return False
        if abs(cells - round(cells)) > _NODE_TOLERANCE:
            return False
    return True


def _new_values(old: Manifest, new: Manifest) -> Iterable[str]:
    if old.heights_m != new.heights_m:
        yield f"heights_m changed from {list(old.heights_m)} to {list(new.heights_m)}"
    if old.lattice != new.lattice:
        yield f"the coverage changed from {_spell(old.lattice)} to {_spell(new.lattice)}"
    for place in sorted(set(old.tiles) & set(new.tiles)):
        if old.tiles[place].array_digest != new.tiles[place].array_digest:
            yield f"arrays changed in {new.tiles[place].path}"
    digests = _temporal_digest(old), _temporal_digest(new)
    if digests[0] != digests[1]:
        yield f"the temporal model {'came or went' if None in digests else 'changed'}"
    for name in sorted(set(old.roads) | set(new.roads)):
        if name not in old.roads or name not in new.roads:
            yield f"road {name} came or went"
        elif old.roads[name].array_digest != new.roads[name].array_digest:
            yield f"arrays changed in {new.roads[name].path}"
    before, after = _content(old, "core_field"), _content(new, "core_field")
    if before != after:
        yield "the core field's coefficients changed"


def _new_description(old: Manifest, new: Manifest) -> Iterable[str]:
    before = {f.path: f for f in old.files if f.role not in _NOT_CONTENT}
    after = {f.path: f for f in new.files if f.role not in _NOT_CONTENT}
    for path in sorted(set(before) | set(after)):
        if path not in before or path not in after:
            yield f"{path} came or went"
        elif before[path].sha256 != after[path].sha256:
            arrays = isinstance(after[path], (TileRecord, TemporalRecord, RoadRecord))
            same = ", its arrays did not" if arrays else ""
            yield f"{path} changed{same}"
    if old.inputs != new.inputs:
        yield "the inputs' records changed"


def _temporal_digest(manifest: Manifest) -> str | None:
    return None if manifest.temporal is None else manifest.temporal.array_digest


def _content(manifest: Manifest, role: str) -> list[tuple[str, str]]:
    files: list[FileRecord] = [f for f in manifest.files if f.role == role]
    return sorted((f.path, f.sha256) for f in files)


def check_successor(existing: Iterable[Manifest], new: Manifest) -> None:
    """Raise VersionError unless the version of `new` says enough of what it changes.

    It is compared with the highest lower version among `existing`.
    """
    version = parse_version(new.version)
    known = {parse_version(m.version): m for m in existing}
    lower = [v for v in known if v < version]
    if not lower:
        return
    before = max(lower)
    change = required_bump(known[before], new)
    if change.bump is not None and version < bumped(before, change.bump):
        raise _bump_is_due(new, change, f"than {format_version(before)}", max(known))


def check_same(existing: Manifest, new: Manifest, highest: Version) -> None:
    """Raise VersionError unless `new` has the content of `existing`, the same version."""
    change = required_bump(existing, new)
    if change.bump is not None:
        raise _bump_is_due(new, change, "under the same version", highest)


def _bump_is_due(new: Manifest, change: Change, than: Any, highest: Version) -> VersionError:
    due = format_version(bumped(highest, str(change.bump)))
    return VersionError(
        f"other content {than}: {change.reason}",
        where=f"{new.product} {new.version}",
        expected=f"a {str(change.bump).upper()} bump",
        remedy=f'set version = "{due}"',
    )
