"""Which file of a log holds what, and who reads it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

from magtiles.schemas.errors import SourceError
from magtiles.stages.ingest.log.aseg import read_aseg
from magtiles.stages.ingest.log.delimited import read_csv
from magtiles.stages.ingest.log.hdf5 import read_hdf5
from magtiles.stages.ingest.log.mcap_log import read_mcap
from magtiles.stages.ingest.log.raw import RawLog
from magtiles.stages.ingest.log.sniff import log_format
from magtiles.stages.ingest.log.source import IngestLogParams
from magtiles.stages.ingest.log.table import Table
from magtiles.stages.ingest.log.table_log import table_log
from magtiles.stages.ingest.log.trackline import read_mgd77, read_mgd77t, read_trackline_csv
from magtiles.stages.ingest.log.ulog import read_ulog
from magtiles.stages.ingest.unpack import unpacked

_READERS: dict[str, Callable[[Path, IngestLogParams], RawLog]] = {
    "mcap": read_mcap,
    "ulog": read_ulog,
}
_TABLES: dict[str, Callable[[Path, IngestLogParams, str], Table]] = {
    "csv": read_csv,
    "hdf5": read_hdf5,
    "mgd77": read_mgd77,
    "mgd77t": read_mgd77t,
    "trackline": read_trackline_csv,
}
_DEFINITION = ".dfn"
_BESIDE = (".des", ".met", ".txt", ".pdf", ".h77", ".h77t")
"""Descriptions for people that may be named with the data; nothing is read of them."""


def data_file(found: Sequence[Path]) -> tuple[Path, Path | None]:
    """The file of data, and that of its definitions, if any.

    Raises SourceError where several files could be meant.
    """
    kinds = {path: _plain_suffix(path) for path in found}
    definitions = [path for path, kind in kinds.items() if kind == _DEFINITION]
    data = [p for p, kind in kinds.items() if kind not in (_DEFINITION, *_BESIDE)]
    if len(data) != 1 or len(definitions) > 1:
        raise SourceError(
            f"{len(data)} data files: {', '.join(sorted(p.name for p in data)) or 'none'}, "
            f"{len(definitions)} of definitions",
            where="files",
            expected="one file, with one of definitions where its format has them",
            remedy="ingest each alone",
        )
    return data[0], definitions[0] if definitions else None


def _plain_suffix(path: Path) -> str:
    name = path.with_suffix("") if path.suffix.lower() in (".gz", ".xz") else path
    return name.suffix.lower()


def read_log(path: Path, definition: Path | None, params: IngestLogParams) -> RawLog:
    """The raw log in a file, unpacked first where it is packed.

    Raises what the reader of its format raises.
    """
    with contextlib.ExitStack() as stack:
        plain = stack.enter_context(unpacked(path, params.member))
        beside = plain.with_suffix(_DEFINITION)
        if definition is None and plain != path and beside.is_file():
            definition = beside  # of the same archive
        if definition is not None:
            defined = stack.enter_context(unpacked(definition))
            return table_log(read_aseg(plain, defined, params, str(path)), params)
        kind = log_format(plain)
        if kind in _READERS:
            return _READERS[kind](plain, params)
        return table_log(_TABLES[kind](plain, params, str(path)), params)
