"""Reading a model, whatever its format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from magtiles.catalog.models.cof import is_cof, read_cof, read_emm
from magtiles.catalog.models.geographiclib import read_geographiclib
from magtiles.catalog.models.model import FieldModel
from magtiles.catalog.models.rows import significant_lines
from magtiles.catalog.models.shc import is_shc, read_shc
from magtiles.schemas.errors import FormatError

_FORMATS = "SHC, COF of WMM, WMMHR or EMM, or .wmm of GeographicLib"

_LARGEST = 256 * 1024 * 1024
"""Bytes; the largest model published has 20 million."""


def read_model(path: Path | str) -> FieldModel:
    """The model in a file, told by its content, or in a folder that holds an EMM set.

    Formats are SHC, COF of WMM, WMMHR or EMM, and GeographicLib's .wmm with its .wmm.cof.

    Raises FormatError naming file and line (or byte), and OSError for a file that cannot be
    read.
    """
    path = Path(path)
    if path.is_dir():
        return read_emm(list(path.iterdir()), path)
    if path.stat().st_size > _LARGEST:
        raise FormatError("is larger than any model", where=path, expected=_FORMATS)
    data = path.read_bytes()
    if b"\0" in data and path.suffix == ".cof" and path.with_suffix("").is_file():
        path = path.with_suffix("")
        data = path.read_bytes()
    if b"\0" in data:
        raise FormatError("is no text", where=path, expected=_FORMATS)
    text = data.decode("utf-8-sig", errors="replace")
    if text.startswith("WMMF-"):
        return read_geographiclib(path, significant_lines(str(path), text))
    return parse_model(text, str(path))


def read_model_files(files: Sequence[Path]) -> FieldModel:
    """The model in the files of a set: one file, .wmm with its .wmm.cof, or an EMM set.

    Raises as `read_model`.
    """
    alone = files if len(files) == 1 else [f for f in files if f.suffix == ".wmm"]
    return read_model(alone[0]) if alone else read_emm(files, files[0].parent)


def parse_model(text: str, file: str) -> FieldModel:
    """The model in the text of an SHC or COF file; `file` names it in messages.

    Raises FormatError naming file and line.
    """
    lines = significant_lines(file, text)
    if not lines:
        raise FormatError("is empty", where=file, expected=_FORMATS, remedy="fetch it again")
    if is_shc(lines):
        return read_shc(lines)
    if is_cof(lines):
        return read_cof(lines)
    page = "<html" in text.lower() or "<!doctype" in text.lower()
    raise FormatError(
        "is an HTML page" if page else "is no model of a known format",
        where=lines[0].where,
        expected=_FORMATS,
        remedy="fetch the file itself"
        if page
        else "secular variation alone is no model: give the folder of the set",
    )
