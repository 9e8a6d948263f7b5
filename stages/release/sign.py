"""Keys, and signatures of releases, in the formats of minisign (see catalog/releases/signature).

A secret key file holds a comment and base64 of: ``Ed``, the key derivation (two zero bytes: no
password), ``B2``, its salt and limits (48 bytes, unused), the key's id (8), seed (32), public
key (32), and the BLAKE2b-256 of algorithm, id, seed and public key.
"""

from __future__ import annotations

import base64
import hashlib
import os
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magtiles.catalog.releases.folder import read_bytes
from magtiles.catalog.releases.manifest import (
    MANIFEST_NAME,
    MAX_MANIFEST_BYTES,
    SIGNATURE_NAME,
    parse_manifest,
)
from magtiles.catalog.releases.reader import open_release
from magtiles.catalog.releases.signature import (
    KEY_ALGORITHM,
    PREHASHED,
    TRUSTED,
    UNTRUSTED,
    PublicKey,
    check_signature,
    decode,
    ed25519,
    key_name,
    prehash,
)
from magtiles.schemas.errors import FormatError, UsageError
from magtiles.stages.release.atomic import sync

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

_NO_PASSWORD = b"\x00\x00"
_CHECKSUM = b"B2"
_UNUSED_BYTES = 48
_SECRET_BYTES = 6 + _UNUSED_BYTES + 8 + 64 + 32


@dataclass(frozen=True)
class SecretKey:
    """A key that signs, and its id."""

    id: bytes
    key: Ed25519PrivateKey

    @property
    def public(self) -> PublicKey:
        """The key that proves its signatures."""
        return PublicKey(self.id, self.key.public_key().public_bytes_raw())


def generate_keys(secret: Path, public: Path) -> PublicKey:
    """Make a pair of keys, without a password; the secret file is its owner's to read only.

    Raises UsageError where one of the files exists.
    """
    for path in (secret, public):
        if os.path.lexists(path):
            raise UsageError("exists already", where=path, remedy="choose another name")
    made = SecretKey(secrets.token_bytes(8), ed25519().Ed25519PrivateKey.generate())
    _write_new(secret, secret_key_text(made), 0o600)
    _write_new(public, public_key_text(made.public), 0o644)
    return made.public


def sign_release(folder: Path, secret: Path) -> Path:
    """Sign the manifest of a release; the signature lies beside it, in place of one before.

    Raises IntegrityError where the folder is no whole release, FormatError for a bad key.
    """
    key = read_secret_key(secret)
    open_release(folder)
    data = read_bytes(folder / MANIFEST_NAME, limit=MAX_MANIFEST_BYTES)
    manifest = parse_manifest(data, folder / MANIFEST_NAME)
    comment = f"magtiles release {manifest.product} {manifest.version}\tfile:{MANIFEST_NAME}"
    out = folder / SIGNATURE_NAME
    _add_to_published(out, signature_text(data, key, comment))
    check_signature(data, out, key.public, required=True)
    return out


def signature_text(data: bytes, key: SecretKey, trusted_comment: str) -> str:
    """A minisign signature file of `data`; the same for the same key and comment."""
    proof = key.key.sign(prehash(data))
    both = key.key.sign(proof + trusted_comment.encode())
    lines = (
        f"{UNTRUSTED}signature from magtiles secret key {key_name(key.id)}",
        _base64(PREHASHED + key.id + proof),
        f"{TRUSTED}{trusted_comment}",
        _base64(both),
    )
    return "\n".join(lines) + "\n"


def public_key_text(key: PublicKey) -> str:
    """A minisign public key file."""
    raw = _base64(KEY_ALGORITHM + key.id + key.key)
    return f"{UNTRUSTED}minisign public key {key.name}\n{raw}\n"


def secret_key_text(key: SecretKey) -> str:
    """A minisign secret key file without a password."""
    pair = key.key.private_bytes_raw() + key.public.key
    start = KEY_ALGORITHM + _NO_PASSWORD + _CHECKSUM + bytes(_UNUSED_BYTES)
    raw = start + key.id + pair + _checksum(key.id, pair)
    return f"{UNTRUSTED}minisign secret key {key_name(key.id)}\n{_base64(raw)}\n"


def read_secret_key(path: Path) -> SecretKey:
    """The key in a minisign secret key file without a password. Raises FormatError."""
    lines = path.read_text("utf-8", errors="replace").splitlines()
    if len(lines) != 2 or not lines[0].startswith(UNTRUSTED):
        raise _no_key(path, f"has {len(lines)} lines")
    raw = decode(lines[1], f"{path} line 2")
    if len(raw) != _SECRET_BYTES or raw[:2] != KEY_ALGORITHM or raw[4:6] != _CHECKSUM:
        raise _no_key(path, f"holds {len(raw)} bytes of another kind")
    if raw[2:4] != _NO_PASSWORD:
        raise FormatError(
            "is protected by a password",
            where=path,
            expected="a key without one",
            remedy="take it off with: minisign -C -W -s FILE, or make a key with: magtiles keygen",
        )
    body = raw[6 + _UNUSED_BYTES :]
    key_id, pair, checksum = body[:8], body[8:72], body[72:]
    key = SecretKey(key_id, ed25519().Ed25519PrivateKey.from_private_bytes(pair[:32]))
    if checksum != _checksum(key_id, pair) or key.public.key != pair[32:]:
        raise _no_key(path, "is damaged: its checksum is not that of its key")
    return key


def _checksum(key_id: bytes, pair: bytes) -> bytes:
    return hashlib.blake2b(KEY_ALGORITHM + key_id + pair, digest_size=32).digest()


def _base64(raw: bytes) -> str:
    return base64.b64encode(raw).decode("ascii")


def _write_new(path: Path, text: str, mode: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Made with its mode, so that nobody else can read a secret for a moment.
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w") as file:
        file.write(text)
    sync(path)


def _add_to_published(out: Path, text: str) -> None:
    """Put a file into a read-only release; readers see it whole or not at all."""
    folder = out.parent
    # Outside the folder until it is whole, since a reader refuses what it does not know.
    temporary = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}{out.suffix}.tmp")
    mode = folder.stat().st_mode
    try:
        _write_new(temporary, text, 0o444)
        folder.chmod(mode | 0o200)
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
        folder.chmod(mode)
    sync(folder)


def _no_key(path: Path, what: str) -> FormatError:
    return FormatError(
        what,
        where=path,
        expected="a minisign secret key: a comment, and base64",
        remedy="make one with: magtiles keygen",
    )
