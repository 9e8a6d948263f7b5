"""Say what a release, an artifact or a log holds.

Of a release its identity, coverage, levels, accuracy, flags, files and inputs; of a stage's
artifact its contract, attributes and variables with their ranges; of a log (MCAP or PX4 ULog) its
topics with schemas, rates, span and first values.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtiles.pipeline.output import print_json, print_table

if TYPE_CHECKING:
    from magtiles.catalog.releases.lattice import Lattice
    from magtiles.catalog.releases.manifest import Manifest
    from magtiles.catalog.releases.reader import Release

HELP = "say what a release, an artifact or a log holds"
NEEDS_PIPELINE = False

_UNCERTAINTIES = {
    "magnetic_anomaly_uncertainty": "nT",
    "vector_uncertainty": "nT",
    "tensor_uncertainty": "nT/km",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``magtiles info``."""
    parser.add_argument(
        "release", type=Path, metavar="RELEASE", help="folder of a release, or a file"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print what the manifest says, once every file is found to be what it lists; or the file."""
    if arguments.release.is_file():
        from magtiles.pipeline import artifact_info, log_info

        if artifact_info.run(arguments.release, as_json=arguments.json):
            return 0
        return log_info.run(arguments.release, as_json=arguments.json)
    from magtiles.catalog import open_release

    release = open_release(arguments.release)
    for file in release.manifest.files:
        release.file(file.path)
    described = describe(release.manifest) | {
        "temporal": describe_temporal(release),
        "roads": describe_roads(release),
    }
    if arguments.json:
        print_json(described)
    else:
        _print_described(described)
        _print_next(release.manifest, arguments.release)
    return 0


def describe(manifest: Manifest) -> dict[str, Any]:
    """A manifest as plain values: shares over all core nodes, sizes in bytes."""
    lattice = manifest.lattice
    return {
        "product": manifest.product,
        "version": manifest.version,
        "created": manifest.created,
        "identity": dict(manifest.identity),
        "coverage": {
            "latitude": [lattice.south, lattice.north],
            "longitude": _longitudes(lattice),
        },
        "spacing_deg": [lattice.latitude_spacing, lattice.longitude_spacing],
        "nodes": [lattice.rows + 1, lattice.columns + 1],
        "tiles": len(manifest.tiles),
        "heights_m": list(manifest.heights_m),
        "height_reference": manifest.height_reference,
        "uncertainty": {name: _range_by_level(manifest, name) for name in _UNCERTAINTIES},
        "flag_fractions": _flag_fractions(manifest),
        "sizes": _sizes(manifest),
        "inputs": [{"id": i.id, "licence": i.licence, "role": i.role} for i in manifest.inputs],
        "manifest_digest": manifest.manifest_digest,
    }


def _longitudes(lattice: Lattice) -> list[float]:
    if lattice.east - lattice.west > 360.0 - 1e-9:
        return [-180.0, 180.0]
    return [_wrapped(lattice.west), _wrapped(lattice.east)]


def describe_temporal(release: Release) -> dict[str, Any] | None:
    """Observatories, months and number of segments of a temporal model; None without one."""
    if release.manifest.temporal is None:
        return None
    model = release.temporal
    segments = model.variables.get("segment_start")
    return {
        "observatories": [vars(observatory) for observatory in model.observatories],
        "months": model.months.astype(str).tolist(),
        "segments": 0 if segments is None else int(segments.size),
        "array_digest": release.manifest.temporal.array_digest,
    }


def describe_roads(release: Release) -> list[dict[str, Any]]:
    """The road maps of a release; none without."""
    if not release.manifest.roads:
        return []
    return [
        {
            "name": road.name,
            "length_m": road.length_m,
            "spacing_m": road.spacing_m,
            "passes": int(road.variables["pass_name"].size),
            "vehicles": list(road.vehicles),
            "calibrated": road.calibrated,
            "features": len(road.features),
            "matchability": road.matchability,
            "array_digest": release.manifest.roads[road.name].array_digest,
        }
        for road in release.roads.values()
    ]


def _wrapped(longitude: float) -> float:
    return (longitude + 180.0) % 360.0 - 180.0


def _range_by_level(manifest: Manifest, name: str) -> list[list[float]]:
    """Smallest and largest value of a variable at every level."""
    tiles = [tile.statistics[name] for tile in manifest.tiles.values()]
    return [
        [min(t["minimum"][level] for t in tiles), max(t["maximum"][level] for t in tiles)]
        for level in range(len(manifest.heights_m))
    ]


def _flag_fractions(manifest: Manifest) -> dict[str, float]:
    """Share of core nodes with each flag: tiles weigh by the nodes that they own."""
    total = 0
    flagged: dict[str, float] = {}
    for (row, column), tile in manifest.tiles.items():
        rows, columns = manifest.lattice.core(row, column)
        total += rows * columns
        for name, share in tile.flag_fractions.items():
            flagged[name] = flagged.get(name, 0.0) + share * rows * columns
    return {name: nodes / total for name, nodes in flagged.items()}


def _sizes(manifest: Manifest) -> dict[str, int]:
    sizes: dict[str, int] = {}
    for file in manifest.files:
        sizes[file.role] = sizes.get(file.role, 0) + file.size
    return {**dict(sorted(sizes.items())), "total": sum(sizes.values())}


def _print_described(about: dict[str, Any]) -> None:
    south, north = about["coverage"]["latitude"]
    west, east = about["coverage"]["longitude"]
    rows, columns = about["nodes"]
    identity = about["identity"]
    lines = {
        "release": f"{about['product']} {about['version']}",
        "created": about["created"] or "not stated (SOURCE_DATE_EPOCH was not set)",
        "anomaly": identity["anomaly_definition"],
        "reference": f"{identity['reference_field']} at {identity['reference_epoch']}",
        "coverage": f"latitude {south:.6g} to {north:.6g}, longitude {west:.6g} to {east:.6g}",
        "spacing": "{:.6g} x {:.6g} degrees".format(*about["spacing_deg"]),
        "nodes": f"{rows} x {columns} in {about['tiles']} tiles",
        "height above": about["height_reference"].replace("_", " "),
        "size": f"{about['sizes']['total'] / 1e6:.1f} MB",
        "manifest": about["manifest_digest"],
    }
    for key, value in lines.items():
        print(f"{key:<14}{value}")
    print()
    _print_levels(about)
    print()
    if about["temporal"] is not None:
        _print_temporal(about["temporal"])
        print()
    if about["roads"]:
        _print_roads(about["roads"])
        print()
    shares = [(f"{share:.2%}", name) for name, share in about["flag_fractions"].items()]
    print_table(("nodes", "flag"), shares)
    print()
    inputs = [(i["id"], i["role"], i["licence"]) for i in about["inputs"]]
    print_table(("input", "role", "licence"), inputs)


def _print_levels(about: dict[str, Any]) -> None:
    rows = []
    for level, height in enumerate(about["heights_m"]):
        ranges = [about["uncertainty"][name][level] for name in _UNCERTAINTIES]
        rows.append((f"{height:g}", *(f"{low:.3g} to {high:.3g}" for low, high in ranges)))
    titles = [
        f"{name.removesuffix('_uncertainty').replace('_', ' ')} 1 sigma, {unit}"
        for name, unit in _UNCERTAINTIES.items()
    ]
    print_table(("level m", *titles), rows)


def _print_temporal(temporal: dict[str, Any]) -> None:
    rows = [
        (o["code"], *(f"{o[k]:.2f}" for k in ("latitude", "longitude", "dip_latitude")))
        for o in temporal["observatories"]
    ]
    print_table(("observatory", "latitude", "longitude", "dip latitude"), rows)
    months = temporal["months"]
    span = f"{months[0]} to {months[-1]}" if months else "none"
    print(f"quiet-day curves: {span} ({len(months)}); FOGM segments: {temporal['segments']}")


def _print_roads(roads: list[dict[str, Any]]) -> None:
    rows = [
        (
            r["name"],
            f"{r['length_m']:.0f} every {r['spacing_m']:g}",
            str(r["passes"]),
            ", ".join(r["vehicles"]),
            "yes" if r["calibrated"] else "no",
            "-" if r["matchability"] is None else f"{r['matchability']:.2f}",
        )
        for r in roads
    ]
    print_table(("road", "length m", "passes", "vehicles", "calibrated", "matchability"), rows)


def _print_next(manifest: Manifest, folder: Path) -> None:
    best = min(
        manifest.tiles.values(), key=lambda tile: tile.flag_fractions.get("beyond_coverage", 0.0)
    )
    latitude = sum(best.bounds["latitude"]) / 2.0
    longitude = _wrapped(sum(best.bounds["longitude"]) / 2.0)
    option = "" if manifest.takes_ellipsoidal_height else " --height-above-reference"
    print("\nnext:")
    print(f"  magtiles validate {folder}")
    print(f"  magtiles plot {folder} --out map.png")
    print(
        f"  magtiles query {folder} --lat {latitude:.5f} --lon {longitude:.5f}"
        f" --height {manifest.heights_m[-1]:g}{option}"
    )
