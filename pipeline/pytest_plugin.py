"""A pytest plugin: ``pytest --magtiles-release PATH`` makes a test of each check of a release.

Nothing but the option is added to a run without it, and nothing heavy is imported.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from magtiles.pipeline.validate import Check


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option."""
    parser.getgroup("magtiles").addoption(
        "--magtiles-release",
        action="append",
        default=[],
        metavar="PATH",
        help="validate the release in this folder too, one test for each check (repeatable)",
    )


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(session: pytest.Session, items: list[pytest.Item]) -> None:
    """Append the checks of each release that was named, whatever else was selected."""
    for folder in session.config.getoption("--magtiles-release"):
        collector = ReleaseChecks.from_parent(session, name=str(folder))
        items.extend(collector.collect())


class ReleaseChecks(pytest.Collector):
    """All checks of the release whose folder is the collector's name."""

    def collect(self) -> Iterator[pytest.Item]:
        """Validate the release; what cannot be read is a check that fails."""
        try:
            from magtiles.pipeline.validate import validate_release
        except ModuleNotFoundError as missing:
            raise pytest.UsageError(
                f'--magtiles-release needs {missing.name}: pip install "magtiles[pipeline]"'
            ) from None

        for check in validate_release(Path(self.name)):
            yield CheckItem.from_parent(self, name=check.name, check=check)


class CheckItem(pytest.Item):
    """One check, already made."""

    def __init__(self, *, check: Check, **rest: object) -> None:
        super().__init__(**rest)  # type: ignore[arg-type]
        self.check = check

    def runtest(self) -> None:
        """Fail where the check did."""
        if not self.check.passed:
            raise CheckFailed

    def repr_failure(
        self, excinfo: pytest.ExceptionInfo[BaseException], style: object = None
    ) -> str:
        """What was measured, not a traceback."""
        from magtiles.pipeline.junit import said

        return said(self.check)

    def reportinfo(self) -> tuple[Path, None, str]:
        """The release and the check."""
        return Path(self.parent.name if self.parent else ""), None, f"{self.name}"


class CheckFailed(Exception):
    """A check of a release failed."""
