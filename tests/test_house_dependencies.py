"""The lock: whole, hashed, in step with pyproject.toml, and under permissive licences only."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
EXTRA = [Requirement(r) for r in PROJECT["project"]["optional-dependencies"]["pipeline"]]
WANTED = [
    *(Requirement(r) for r in PROJECT["project"]["dependencies"]),
    *EXTRA,
    *(Requirement(r) for r in PROJECT["dependency-groups"]["dev"]),
    *(Requirement(r) for r in PROJECT["build-system"]["requires"]),
]

_ENTRY = re.compile(
    r"^(?P<requirement>[A-Za-z0-9][^\\\n]*?) \\\n(?P<hashes>(?: +--hash=.*\n)+)", re.M
)
LOCK = (ROOT / "requirements" / "dev.lock").read_text(encoding="utf-8")
LOCKED = {
    canonicalize_name(Requirement(m["requirement"]).name): (Requirement(m["requirement"]), m)
    for m in _ENTRY.finditer(LOCK)
}

# SPDX names, then what packages without an SPDX expression write instead.
PERMISSIVE = {
    "0BSD", "Apache-2.0", "Apache-2.0 WITH LLVM-exception", "BSD-2-Clause", "BSD-3-Clause",
    "CC0-1.0", "ISC", "MIT", "MIT-0", "MIT-CMU", "PSF-2.0", "Zlib",
    "Apache 2.0", "BSD", "New BSD", "BSD 3-Clause License", "3-Clause BSD License", "MIT License",
    "OSI Approved :: Apache Software License", "OSI Approved :: BSD License",
    "OSI Approved :: MIT License", "OSI Approved :: Python Software Foundation License",
}  # fmt: skip
ALLOWED_UNMODIFIED = {"MPL-2.0", "OSI Approved :: Mozilla Public License 2.0 (MPL 2.0)"}


def refused(expression: str) -> list[str]:
    """The terms of a licence expression that we may not depend on; one of each OR suffices."""
    allowed = PERMISSIVE | ALLOWED_UNMODIFIED
    return [
        term
        for term in expression.split(" AND ")
        if not any(choice.strip() in allowed for choice in term.split(" OR "))
    ]


def stated_licences(package: metadata.PackageMetadata) -> list[str]:
    """What a package says of its licence: an SPDX expression, else classifiers and a short name."""
    if expression := package.get("License-Expression"):
        return [expression]
    stated = [
        classifier.removeprefix("License :: ")
        for classifier in package.get_all("Classifier", [])
        if classifier.startswith("License :: ")
    ]
    text = (package.get("License") or "").strip()
    # Some put the whole text there: its first line is a name only where nothing else is said.
    name, _, rest = text.partition("\n")
    return [*stated, name] if name and not (rest and stated) else stated


INSTALLED_HERE = [
    name
    for name, (requirement, _) in LOCKED.items()
    if requirement.marker is None or requirement.marker.evaluate()
]


@pytest.mark.parametrize("name", INSTALLED_HERE)
def test_every_locked_package_is_under_a_permissive_licence(name: str) -> None:
    stated = stated_licences(metadata.metadata(name))
    assert stated, f"{name} states no licence"
    assert [term for licence in stated for term in refused(licence)] == []


@pytest.mark.parametrize(
    ("expression", "bad"),
    [
        ("MIT", []),
        ("BSD-3-Clause AND 0BSD AND MIT", []),
        ("GPL-3.0-or-later OR Apache-2.0", []),
        ("MIT AND LGPL-2.1-only", ["LGPL-2.1-only"]),
        ("GPL-2.0-only", ["GPL-2.0-only"]),
        ("AGPL-3.0-or-later AND MPL-2.0", ["AGPL-3.0-or-later"]),
        ("OSI Approved :: GNU GPLv3", ["OSI Approved :: GNU GPLv3"]),
        ("(MIT OR GPL-2.0-only) AND MIT", ["(MIT OR GPL-2.0-only)"]),  # for a person to judge
    ],
)
def test_the_check_of_licences_tells_right_from_wrong(expression: str, bad: list[str]) -> None:
    assert refused(expression) == bad


@pytest.mark.parametrize("wanted", WANTED, ids=str)
def test_the_lock_meets_the_project(wanted: Requirement) -> None:
    pinned, _ = LOCKED[canonicalize_name(wanted.name)]
    (pin,) = pinned.specifier
    assert pin.operator == "=="
    assert wanted.specifier.contains(pin.version), "run make lock"


def test_everything_in_the_lock_is_hashed() -> None:
    # Every line that is not a comment or a hash opens an entry that the pattern has read.
    entries = [line for line in LOCK.splitlines() if line and line[0] not in " #"]
    assert len(entries) == len(LOCKED) > 50
    for _, match in LOCKED.values():
        assert all(
            re.search(r"--hash=sha256:[0-9a-f]{64}\b", h) for h in match["hashes"].splitlines()
        )


def test_the_command_line_asks_for_the_whole_extra() -> None:
    from magtiles.pipeline import main

    named_otherwise = {"protobuf": "google.protobuf"}
    imported = {named_otherwise.get(r.name, r.name) for r in EXTRA}
    assert set(main._EXTRA) == imported
