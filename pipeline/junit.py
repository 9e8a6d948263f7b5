"""The checks of a release as JUnit XML, which CI systems show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from magtiles.pipeline.validate import Check
from magtiles.stages.release.atomic import atomic_path


def write_junit(checks: Sequence[Check], release: Path, out: Path) -> None:
    """Write one test case for each check of `release` to `out`."""
    failed = sum(not check.passed for check in checks)
    suite = ElementTree.Element(
        "testsuite", name=f"magtiles validate {release}", tests=str(len(checks)),
        failures=str(failed), errors="0", skipped="0",
    )  # fmt: skip
    for check in checks:
        case = ElementTree.SubElement(suite, "testcase", classname=str(release), name=check.name)
        if check.passed:
            ElementTree.SubElement(case, "system-out").text = _printable(said(check))
        else:
            ElementTree.SubElement(case, "failure", message=_printable(said(check)))
    root = ElementTree.Element("testsuites")
    root.append(suite)
    with atomic_path(out) as temporary:
        ElementTree.ElementTree(root).write(temporary, encoding="utf-8", xml_declaration=True)


def said(check: Check) -> str:
    """What a check measured, its bound and its place, in one line."""
    measured = "" if check.measured is None else f"{check.measured:.6g} {check.unit}"
    bound = "" if check.bound is None else f" (bound {check.bound:.6g})"
    return ": ".join(part for part in (measured + bound, check.where) if part)


def _printable(text: str) -> str:
    # XML has no place for control characters, which the names in a foreign file may hold.
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
