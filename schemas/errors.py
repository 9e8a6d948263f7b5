"""The one tree of errors that magtiles raises on purpose.

Every message says what was wrong, where, what was expected and what to do:

>>> print(FormatError("the file is empty", where="survey.tif", remedy="fetch it again"))
survey.tif: the file is empty; fetch it again
"""

from __future__ import annotations


class MagtilesError(Exception):
    """Base of every error raised by magtiles.

    Parameters
    ----------
    what : what was wrong, without a full stop.
    where : the place: file, line or byte, table and key, variable, index.
    expected : what would have been right.
    remedy : what the user can do about it.
    """

    def __init__(
        self,
        what: str,
        *,
        where: object = None,
        expected: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.what = what
        self.where = None if where is None else str(where)
        self.expected = expected
        self.remedy = remedy
        super().__init__(what)

    def __str__(self) -> str:
        text = self.what if self.where is None else f"{self.where}: {self.what}"
        if self.expected is not None:
            text += f"; expected {self.expected}"
        if self.remedy is not None:
            text += f"; {self.remedy}"
        return text

    def __reduce__(self) -> tuple[object, ...]:
        # Exceptions with keyword-only arguments do not survive a process pool without this.
        return (_rebuild, (type(self), self.what, self.where, self.expected, self.remedy))


def _rebuild(
    kind: type[MagtilesError],
    what: str,
    where: str | None,
    expected: str | None,
    remedy: str | None,
) -> MagtilesError:
    return kind(what, where=where, expected=expected, remedy=remedy)


class ContractError(MagtilesError):
    """A dataset does not keep the contract it claims."""


class SourceError(MagtilesError):
    """A source or product TOML lacks, misspells or contradicts something."""


class MissingInputError(SourceError):
    """A file that a source or product TOML names is not there."""


class FormatError(MagtilesError):
    """A file is not what its name or header says: truncated, empty, another format."""


class ParameterError(MagtilesError):
    """A stage parameter is unknown, missing or outside its range."""


class CoverageError(MagtilesError):
    """What was asked for lies outside the data: a region, a level below the survey."""


class IntegrityError(MagtilesError):
    """A release is not what its manifest says: changed, missing or foreign bytes."""


class VersionError(MagtilesError):
    """A version would be republished with other content, or its bump is too small."""


class QueryError(MagtilesError):
    """A query cannot be answered: shapes, latitude, height, or what the release lacks."""


class UsageError(MagtilesError):
    """The command line was used wrongly (exit status 2)."""
