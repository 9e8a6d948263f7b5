"""Validation in other projects' CI: JUnit XML and the pytest plugin."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest

from magtiles.pipeline.main import main

pytest_plugins = ["pytester"]


def damage(release: Path) -> Path:
    tile = next((release / "tiles").glob("*.nc"))
    data = bytearray(tile.read_bytes())
    data[len(data) // 2] ^= 1
    tile.write_bytes(data)
    return release


def test_junit_of_a_good_release(exact_release: Path, tmp_path: Path) -> None:
    out = tmp_path / "checks.xml"
    assert main(["validate", str(exact_release), "--junit", str(out)]) == 0
    (suite,) = ElementTree.parse(out).getroot()
    assert suite.get("failures") == "0"
    names = [case.get("name") for case in suite]
    assert len(names) == int(suite.get("tests", 0))
    assert {"manifest", "digests", "overlaps", "checks.json"} <= set(names)


def test_junit_of_a_damaged_release(release_copy: Path, tmp_path: Path) -> None:
    out = tmp_path / "checks.xml"
    assert main(["validate", str(damage(release_copy)), "--junit", str(out)]) == 1
    (suite,) = ElementTree.parse(out).getroot()
    failures = {case.get("name"): case.find("failure") for case in suite}
    assert "sha256" in failures["digests"].get("message")
    assert int(suite.get("failures")) == sum(f is not None for f in failures.values())


def test_plugin(pytester: pytest.Pytester, exact_release: Path, release_copy: Path) -> None:
    pytester.makepyfile("def test_own(): pass")
    good = pytester.runpytest_subprocess(f"--magtiles-release={exact_release}", "-v")
    outcomes = good.parseoutcomes()
    assert good.ret == 0
    assert outcomes["passed"] > 10
    good.stdout.fnmatch_lines(["*digests*PASSED*"])
    bad = pytester.runpytest_subprocess(f"--magtiles-release={damage(release_copy)}")
    assert bad.ret == 1
    bad.stdout.fnmatch_lines(["*digests*", "*sha256*"])
    assert "Traceback" not in bad.stdout.str()


def test_plugin_changes_nothing_unasked(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("def test_own(): pass")
    assert pytester.runpytest_subprocess().parseoutcomes() == {"passed": 1}


def test_plugin_of_no_release(pytester: pytest.Pytester, tmp_path: Path) -> None:
    result = pytester.runpytest_subprocess(f"--magtiles-release={tmp_path}")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*manifest*"])


def test_plugin_without_the_extra(pytester: pytest.Pytester, exact_release: Path) -> None:
    """Where only the reader is installed the option says what is missing, not where it crashed."""
    pytester.makeconftest(
        "import sys\n"
        "class Missing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'xarray':\n"
        "            raise ModuleNotFoundError('none', name=name)\n"
        "sys.meta_path.insert(0, Missing())\n"
    )
    result = pytester.runpytest_subprocess(f"--magtiles-release={exact_release}")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(['*needs xarray: pip install "magtiles?pipeline?"*'])
    assert "INTERNALERROR" not in result.stdout.str()
