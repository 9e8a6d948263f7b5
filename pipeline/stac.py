"""A release as a STAC collection with an item for each tile (STAC 1.1, stacspec.org).

Extensions: file (size and sha256 as a multihash), projection and datacube (levels, variables).
"""

from __future__ import annotations

import datetime
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import pystac
from pystac.errors import STACValidationError
from pystac.extensions.datacube import DatacubeExtension, Dimension, Variable
from pystac.extensions.file import FileExtension
from pystac.extensions.projection import ProjectionExtension
from pystac.stac_object import STACObjectType
from pystac.validation.stac_validator import JsonSchemaSTACValidator

from magtiles.catalog import Release, open_release
from magtiles.catalog.releases.digest import sha256
from magtiles.catalog.releases.folder import read_bytes
from magtiles.catalog.releases.manifest import (
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    SIGNATURE_NAME,
    FileRecord,
    Manifest,
    TileRecord,
)
from magtiles.catalog.releases.tile_table import NODES, TILE_VARIABLES
from magtiles.schemas.errors import ContractError, UsageError

_SHA2_256 = "1220"
"""Multihash code of SHA-256, and its length of 32 bytes."""

_MEDIA_TYPES = {
    ".nc": "application/netcdf",
    ".json": pystac.MediaType.JSON,
    ".png": pystac.MediaType.PNG,
    ".shc": pystac.MediaType.TEXT,
}
_ROLES = {"preview": "overview", "temporal": "data", "tile": "data", "road": "data"}


def export_stac(folder: Path, out: Path, *, base_url: str | None = None) -> tuple[Path, int]:
    """Write the collection of a release to the new folder `out`.

    Parameters
    ----------
    base_url : where the release's folder is published; default: links relative to `out`.

    Returns
    -------
    The file of the collection, and how many items it has. All are valid against the schemas of
    STAC's core that pystac holds; those of its extensions would have to be fetched.

    Raises
    ------
    IntegrityError : the folder is no whole release.
    UsageError : `out` exists.
    ContractError : what is made is no valid STAC.
    """
    release = open_release(folder)
    if os.path.lexists(out):
        raise UsageError("exists already", where=out, remedy="remove it, or choose another folder")
    collection = stac_collection(release, _Links(folder, out, base_url))
    staging = out.with_name(f".{out.name}.{secrets.token_hex(4)}.tmp")
    collection.normalize_hrefs(str(out.absolute()))
    try:
        _check(collection)
        collection.save(pystac.CatalogType.SELF_CONTAINED, str(staging.absolute()))
        staging.rename(out)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return out / "collection.json", len(release.manifest.tiles)


class _Links:
    """Where an object's assets are: files of the release, under a URL or beside `out`."""

    def __init__(self, folder: Path, out: Path, base_url: str | None) -> None:
        self._folder, self._out, self._base = folder.absolute(), out.absolute(), base_url

    def to(self, path: str, home: str = "") -> str:
        """The link to `path` from an object in the folder `home` of the collection."""
        if self._base is not None:
            return f"{self._base.rstrip('/')}/{path}"
        return Path(os.path.relpath(self._folder / path, self._out / home)).as_posix()


def stac_collection(release: Release, links: _Links) -> pystac.Collection:
    """The collection, its items in order of their places. Nothing is read but the manifest."""
    manifest = release.manifest
    lattice, identity = manifest.lattice, manifest.identity
    bbox, _ = footprint(lattice.south, lattice.north, lattice.west, lattice.east)
    moment = _moment(manifest)
    collection = pystac.Collection(
        id=f"{manifest.product}-{manifest.version}",
        title=f"{manifest.product} {manifest.version}",
        description=f"Magnetic anomaly tiles: {identity['anomaly_definition']}, reference "
        f"{identity['reference_field']}. Sources: "
        + "; ".join(f"{i.id} ({i.licence})" for i in manifest.inputs),
        extent=pystac.Extent(
            pystac.SpatialExtent([bbox]), pystac.TemporalExtent([[moment, moment]])
        ),
        license="other",  # STAC asks for an SPDX name; each source states its own terms
        extra_fields={
            "version": manifest.version,
            "magtiles:manifest_digest": manifest.manifest_digest,
            "magtiles:inputs": [vars(i) for i in manifest.inputs],
        },
        summaries=pystac.Summaries(
            {
                "magtiles:heights_m": list(manifest.heights_m),
                "magtiles:height_reference": [manifest.height_reference],
                "magtiles:reference_field": [identity["reference_field"]],
            }
        ),
    )
    for record in (*_unlisted(release), *manifest.files):
        if not isinstance(record, TileRecord):
            _add_asset(collection, record.path, record, links.to(record.path))
    for place in sorted(manifest.tiles):
        collection.add_item(_item(manifest, manifest.tiles[place], moment, links))
    return collection


def _unlisted(release: Release) -> Iterator[FileRecord]:
    for name in (MANIFEST_NAME, SIGNATURE_NAME):
        if (release.path / name).is_file():
            data = read_bytes(release.path / name, limit=MAX_MANIFEST_BYTES)
            yield FileRecord(name, len(data), sha256(data), "metadata", None)


def _item(
    manifest: Manifest, tile: TileRecord, moment: datetime.datetime, links: _Links
) -> pystac.Item:
    lattice = manifest.lattice
    bbox, geometry = footprint(*tile.bounds["latitude"], *tile.bounds["longitude"])
    name = PurePosixPath(tile.path).stem
    properties: dict[str, Any] = {
        "magtiles:heights_m": list(manifest.heights_m),
        "magtiles:height_reference": manifest.height_reference,
        "magtiles:array_digest": tile.array_digest,
        "magtiles:flag_fractions": dict(tile.flag_fractions),
    }
    if manifest.created is not None:
        properties["created"] = manifest.created
    item = pystac.Item(name, geometry, bbox, moment, properties)
    ProjectionExtension.ext(item, add_if_missing=True).apply(code="EPSG:4326")
    asset = _add_asset(item, "data", tile, links.to(tile.path, name))
    latitude, longitude = lattice.tile_axes(tile.row, tile.column)
    steps = lattice.latitude_spacing, lattice.longitude_spacing
    ProjectionExtension.ext(asset).apply(
        code="EPSG:4326",  # else the asset's own would be null, which goes before the item's
        shape=[latitude.size, longitude.size],
        # Of cells around the nodes, rows from the south, halo and all, as the file has them.
        transform=[
            steps[1], 0.0, float(longitude[0]) - steps[1] / 2,
            0.0, steps[0], float(latitude[0]) - steps[0] / 2,
        ],
    )  # fmt: skip
    cube = DatacubeExtension.ext(item, add_if_missing=True)
    cube.apply(_dimensions(manifest, tile), _variables(tile))
    return item


def _dimensions(manifest: Manifest, tile: TileRecord) -> dict[str, Dimension]:
    heights, lattice = list(manifest.heights_m), manifest.lattice
    described: dict[str, dict[str, Any]] = {
        "height": {
            "axis": "z",
            "values": heights,
            "extent": [heights[0], heights[-1]],
            "unit": "m",
            "description": f"height above the {manifest.height_reference.replace('_', ' ')}",
        }
    }
    steps = lattice.latitude_spacing, lattice.longitude_spacing
    for name, axis, nodes, step in zip(
        NODES, "yx", lattice.tile_axes(tile.row, tile.column), steps, strict=True
    ):
        extent = [float(nodes[0]), float(nodes[-1])]
        described[name] = {"axis": axis, "extent": extent, "step": step, "reference_system": 4326}
    return {
        name: Dimension.from_dict({"type": "spatial", **entry}) for name, entry in described.items()
    }


def _variables(tile: TileRecord) -> dict[str, Variable]:
    names = [n for n in TILE_VARIABLES if n in tile.statistics or n == "quality_flag"]
    return {
        name: Variable(
            {
                "type": "data",
                "dimensions": list(TILE_VARIABLES[name].dims),
                "unit": TILE_VARIABLES[name].units or "1",
            }
        )
        for name in names
    }


def _add_asset(
    owner: pystac.Item | pystac.Collection, key: str, record: FileRecord, href: str
) -> pystac.Asset:
    asset = pystac.Asset(
        href,
        media_type=_MEDIA_TYPES.get(PurePosixPath(record.path).suffix),
        roles=[_ROLES.get(record.role, "metadata")],
    )
    owner.add_asset(key, asset)
    stated = FileExtension.ext(asset, add_if_missing=True)
    stated.apply(checksum=_SHA2_256 + record.sha256, size=record.size)
    return asset


def footprint(
    south: float, north: float, west: float, east: float
) -> tuple[list[float], dict[str, Any]]:
    """Bounding box and GeoJSON geometry of an area, degrees; `east` counts on from `west`.

    An area across the date line has a box whose west is greater than its east, and two polygons
    (RFC 7946, sections 3.1.9 and 5.2).
    """
    if east - west > 360.0 - 1e-9:
        west, east = -180.0, 180.0
    start = (west + 180.0) % 360.0 - 180.0
    end = start + (east - west)
    if end <= 180.0:
        return [start, south, end, north], {
            "type": "Polygon",
            "coordinates": [_ring(south, north, start, end)],
        }
    halves = (start, 180.0), (-180.0, end - 360.0)
    return [start, south, end - 360.0, north], {
        "type": "MultiPolygon",
        "coordinates": [[_ring(south, north, *half)] for half in halves],
    }


def _ring(south: float, north: float, west: float, east: float) -> list[list[float]]:
    return [[west, south], [east, south], [east, north], [west, north], [west, south]]


def _moment(manifest: Manifest) -> datetime.datetime:
    """The date that the anomaly holds for, else that of the release."""
    for text in (manifest.identity["reference_epoch"], manifest.created):
        try:
            moment = datetime.datetime.fromisoformat(str(text))
        except ValueError:
            continue
        return moment if moment.tzinfo else moment.replace(tzinfo=datetime.UTC)
    raise ContractError(
        f"reference_epoch is {manifest.identity['reference_epoch']!r}, and there is no other date",
        where=f"{MANIFEST_NAME} identity",
        expected="an ISO date",
    )


def _check(collection: pystac.Collection) -> None:
    """Raise ContractError unless the collection and every item keep STAC's core schemas."""
    validator = JsonSchemaSTACValidator()
    version = pystac.get_stac_version()
    kinds = {pystac.Collection: STACObjectType.COLLECTION, pystac.Item: STACObjectType.ITEM}
    for found in (collection, *collection.get_items()):
        try:
            validator.validate_core(found.to_dict(), kinds[type(found)], version, found.id)
        except STACValidationError as problem:
            raise ContractError(
                f"is no valid STAC: {problem}", where=f"{kinds[type(found)]} {found.id}"
            ) from None
