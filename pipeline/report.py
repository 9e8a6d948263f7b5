"""One page about a release: maps, spectra, uncertainty, checks and provenance, in one HTML file.

The page needs no network and runs no script; the same release gives the same bytes.
"""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtiles.catalog import Release, open_release
from magtiles.pipeline.commands.info import describe
from magtiles.pipeline.report_figures import spectra_figure, uncertainty_figure
from magtiles.pipeline.validate import Check, validate_release
from magtiles.schemas.errors import MagtilesError
from magtiles.stages.release.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 68rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { margin-bottom: 0; } h2 { margin-top: 2.5rem; border-bottom: 1px solid #bbb; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 14px; }
td, th { padding: .2rem .8rem .2rem 0; text-align: left; vertical-align: top; }
th { border-bottom: 1px solid #bbb; font-weight: 600; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
.failed { color: #b00020; font-weight: 700; } .digest { font: 12px monospace; }
img { max-width: 100%; margin: .5rem 0; } figcaption { color: #555; font-size: 13px; }
figure { margin: 1rem 0; } details { margin: .3rem 0; } pre { font-size: 12px; overflow-x: auto; }
"""


def write_report(folder: Path, out: Path) -> bool:
    """Write the page about the release in `folder` to `out`; says whether all checks passed.

    Raises IntegrityError when the release cannot be opened at all.
    """
    checks = validate_release(folder)
    release = open_release(folder)
    page = "\n".join(_page(release, checks))
    with atomic_path(out) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return all(check.passed for check in checks)


def _page(release: Release, checks: Sequence[Check]) -> Iterable[str]:
    manifest = release.manifest
    about = describe(manifest)
    title = f"{manifest.product} {manifest.version}"
    yield "<!DOCTYPE html>"
    yield f'<html lang="en"><head><meta charset="utf-8"><title>{_e(title)}</title>'
    yield f"<style>{_STYLE}</style></head><body>"
    failed = sum(not check.passed for check in checks)
    verdict = (
        f"{failed} of {len(checks)} checks FAILED" if failed else f"{len(checks)} checks passed"
    )
    yield f"<h1>{_e(title)}</h1>"
    yield f'<p class="{"failed" if failed else ""}">{verdict}</p>'
    yield from _facts(about)
    yield from _pictures(release)
    yield "<h2>Spectra</h2>"
    yield _or_problem(
        lambda: _figure(
            spectra_figure(release), "Radial mean of the total-field anomaly's power, by level."
        )
    )
    yield "<h2>Uncertainty</h2>"
    yield _or_problem(
        lambda: _figure(
            uncertainty_figure(release), "Share of covered nodes below each 1 sigma, by level."
        )
    )
    yield from _flags(about)
    yield from _checks(checks)
    yield from _provenance(release, about)
    yield "</body></html>"


def _facts(about: dict[str, Any]) -> Iterable[str]:
    identity = about["identity"]
    south, north = about["coverage"]["latitude"]
    west, east = about["coverage"]["longitude"]
    facts = {
        "anomaly": identity["anomaly_definition"],
        "reference field": f"{identity['reference_field']} at {identity['reference_epoch']}",
        "datum": identity["datum"],
        "coverage": f"latitude {south:.6g} to {north:.6g}, longitude {west:.6g} to {east:.6g}",
        "spacing": "{:.6g} x {:.6g} degrees".format(*about["spacing_deg"]),
        "levels": ", ".join(f"{h:g}" for h in about["heights_m"])
        + f" m above {about['height_reference'].replace('_', ' ')}",
        "tiles": f"{about['tiles']}, {about['sizes']['total'] / 1e6:.1f} MB in all",
        "created": about["created"] or "not stated",
    }
    yield _table((), [(name, str(value)) for name, value in facts.items()])


def _pictures(release: Release) -> Iterable[str]:
    maps = [f.path for f in release.manifest.files if f.role == "preview"]
    if maps:
        yield "<h2>Maps and records</h2>"
    for path in sorted(maps, key=_by_number):
        yield _or_problem(partial(_preview, release, path))


def _preview(release: Release, path: str) -> str:
    return _image(release.file(path), _caption(Path(path).stem))


def _caption(stem: str) -> str:
    """What a picture of a level, an observatory or a road shows, by its name."""
    if stem.startswith("temporal-"):
        code, _, kind = stem.removeprefix("temporal-").partition("-")
        words = kind.replace("sigma-tau", "sigma and tau").replace("-", " ")
        return f"Observatory {code}: {words}"
    if stem.startswith("road-"):
        road, _, kind = stem.removeprefix("road-").rpartition("-")
        return f"Road {road}: {kind}"
    return f"Level {stem.removesuffix('m')} m: total-field anomaly, its uncertainty and flags"


def _or_problem(make: Callable[[], str]) -> str:
    """What `make` gives, or what is wrong with the file it needs: the page is for that too."""
    try:
        return make()
    except MagtilesError as problem:
        return f'<p class="failed">{_e(str(problem))}</p>'


def _by_number(path: str) -> tuple[bool, float, str]:
    """Levels first, by height; then the rest by name."""
    try:
        return False, float(Path(path).stem.removesuffix("m")), path
    except ValueError:
        return True, 0.0, path


def _flags(about: dict[str, Any]) -> Iterable[str]:
    rows = [
        (name.replace("_", " "), f"{share:.2%}") for name, share in about["flag_fractions"].items()
    ]
    yield _table(("flag", "share of nodes"), rows)


def _checks(checks: Sequence[Check]) -> Iterable[str]:
    yield "<h2>Checks</h2>"
    rows = [
        (
            "ok" if check.passed else '<span class="failed">FAILED</span>',
            _e(check.name),
            "" if check.measured is None else f"{check.measured:.4g}",
            "" if check.bound is None else f"{check.bound:.4g}",
            _e(check.unit),
            _e(check.where),
        )
        for check in checks
    ]
    yield _table(("", "check", "measured", "bound", "unit", "where"), rows, escaped=True)


def _provenance(release: Release, about: dict[str, Any]) -> Iterable[str]:
    yield "<h2>Provenance</h2>"
    inputs = [(one.id, one.role, one.licence, one.sha256) for one in release.manifest.inputs]
    yield _table(("input", "role", "licence", "sha256"), inputs)
    if any(file.path == "provenance.json" for file in release.manifest.files):
        predicate = json.loads(release.file("provenance.json"))["predicate"]
        for step in predicate["runDetails"]["byproducts"]:
            said = step.get("annotations", {})
            summary = f"{step['name']}: stage {said.get('stage', '?')}"
            detail = json.dumps({k: v for k, v in said.items() if k != "stage"}, indent=1)
            yield f"<details><summary>{_e(summary)}</summary><pre>{_e(detail)}</pre></details>"
    yield f'<p class="digest">manifest {_e(about["manifest_digest"])}</p>'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], *, escaped: bool = False) -> str:
    write = str if escaped else _e
    lines = ["<table>"]
    if header:
        lines.append("<tr>" + "".join(f"<th>{_e(cell)}</th>" for cell in header) + "</tr>")
    for row in rows:
        cells = (f"<td{_kind(cell)}>{write(cell)}</td>" for cell in row)
        lines.append("<tr>" + "".join(cells) + "</tr>")
    return "\n".join([*lines, "</table>"])


def _kind(cell: str) -> str:
    return (
        ' class="number"'
        if cell[:1].isdigit() and cell[-1:] in "0123456789%" and len(cell) < 12
        else ""
    )


def _figure(figure: Figure, caption: str) -> str:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=120, metadata={"Software": None})
    return _image(data.getvalue(), caption)


def _image(png: bytes, caption: str) -> str:
    text = base64.b64encode(png).decode("ascii")
    return (
        f'<figure><img alt="{_e(caption)}" src="data:image/png;base64,{text}">'
        f"<figcaption>{_e(caption)}</figcaption></figure>"
    )


def _e(text: str) -> str:
    return html.escape(text)
