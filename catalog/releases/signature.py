"""Detached signatures in the format of minisign: Ed25519 over the BLAKE2b-512 of a file.

A public key file holds a comment and base64 of ``Ed``, the key's id (8 bytes) and the key (32).
A signature file holds a comment, base64 of ``ED``, the id and the signature (64), a trusted
comment, and base64 of a second signature, over the first and the trusted comment
(https://jedisct1.github.io/minisign, "Signature format").
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magtiles.catalog.releases.folder import read_bytes
from magtiles.schemas.errors import FormatError, IntegrityError, UsageError

if TYPE_CHECKING:
    from types import ModuleType

SIGNATURE_SUFFIX = ".minisig"
KEY_ALGORITHM = b"Ed"
PREHASHED = b"ED"
UNTRUSTED = "untrusted comment: "
TRUSTED = "trusted comment: "

_MAX_BYTES = 16 << 10
_ID_BYTES, _KEY_BYTES, _SIGNATURE_BYTES = 8, 32, 64
_INSTALL = "pip install cryptography"


@dataclass(frozen=True)
class PublicKey:
    """A public key and its id, from `read_public_key`."""

    id: bytes
    key: bytes

    @property
    def name(self) -> str:
        """The id as minisign prints it."""
        return key_name(self.id)


@dataclass(frozen=True)
class Signature:
    """What a signature file says; nothing of it is to be believed before `verify`."""

    key_id: bytes
    signature: bytes
    trusted_comment: str
    global_signature: bytes


def key_name(key_id: bytes) -> str:
    """A key's id as minisign prints it: 16 hexadecimal digits of a little-endian number."""
    return f"{int.from_bytes(key_id, 'little'):016X}"


def prehash(data: bytes) -> bytes:
    """What is signed of a file: its BLAKE2b-512."""
    return hashlib.blake2b(data).digest()


def ed25519() -> ModuleType:
    """The module of Ed25519. Raises UsageError, naming the install command, where it is missing."""
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519 as module
    except ModuleNotFoundError:
        raise UsageError(
            "signatures need the package 'cryptography', which is not installed", remedy=_INSTALL
        ) from None
    return module


def read_public_key(path: Path) -> PublicKey:
    """The key in a minisign public key file. Raises FormatError."""
    lines = _lines(path)
    if len(lines) != 2 or not lines[0].startswith(UNTRUSTED):
        raise _no_key(path, f"has {len(lines)} lines")
    raw = decode(lines[1], f"{path} line 2")
    if len(raw) != 2 + _ID_BYTES + _KEY_BYTES or raw[:2] != KEY_ALGORITHM:
        raise _no_key(path, f"holds {len(raw)} bytes that begin with {raw[:2]!r}")
    return PublicKey(raw[2:10], raw[10:])


def check_signature(
    data: bytes, signature_file: Path, key: PublicKey, *, required: bool
) -> Signature | None:
    """The signature of `data`, proven to be made by `key`; None where there is no such file.

    Raises IntegrityError where it is wrong or no signature, or missing and `required`.
    """
    if not os.path.lexists(signature_file):
        if required:
            raise IntegrityError(
                "is missing", where=signature_file, expected=f"a signature by key {key.name}",
                remedy="fetch it, or do not require one",
            )  # fmt: skip
        return None
    try:
        signature = read_signature(signature_file)
    except FormatError as problem:
        raise IntegrityError(
            problem.what, where=problem.where, expected=problem.expected, remedy=problem.remedy
        ) from None
    verify(data, signature, key, where=signature_file.with_suffix(""))
    return signature


def read_signature(path: Path) -> Signature:
    """A minisign signature file, taken apart. Raises FormatError."""
    lines = _lines(path)
    if len(lines) != 4 or not (lines[0].startswith(UNTRUSTED) and lines[2].startswith(TRUSTED)):
        raise FormatError(
            f"has {len(lines)} lines, or others than expected",
            where=path,
            expected="a minisign signature: comment, signature, trusted comment, signature",
            remedy="fetch it again",
        )
    raw = decode(lines[1], f"{path} line 2")
    if len(raw) != 2 + _ID_BYTES + _SIGNATURE_BYTES or raw[:2] != PREHASHED:
        raise FormatError(
            f"holds {len(raw)} bytes that begin with {raw[:2]!r}",
            where=f"{path} line 2",
            expected="74 bytes that begin with b'ED', a signature of the prehashed kind",
            remedy="sign again without minisign's option -l",
        )
    return Signature(
        raw[2:10], raw[10:], lines[2].removeprefix(TRUSTED), decode(lines[3], f"{path} line 4")
    )


def verify(data: bytes, signature: Signature, key: PublicKey, *, where: object) -> None:
    """Raise IntegrityError unless `key` made the signature of `data` and its trusted comment."""
    if signature.key_id != key.id:
        raise IntegrityError(
            f"is signed by key {key_name(signature.key_id)}",
            where=where,
            expected=f"key {key.name}",
            remedy="give the publisher's key, or do not trust the release",
        )
    signed = signature.signature + signature.trusted_comment.encode()
    for message, proof, what in (
        (prehash(data), signature.signature, "its content"),
        (signed, signature.global_signature, "the trusted comment of its signature"),
    ):
        if not _is_signed(message, proof, key):
            raise IntegrityError(
                f"{what} is not what key {key.name} signed",
                where=where,
                remedy="fetch the release again; do not trust this one",
            )


def _is_signed(message: bytes, proof: bytes, key: PublicKey) -> bool:
    module = ed25519()
    from cryptography.exceptions import InvalidSignature

    try:
        module.Ed25519PublicKey.from_public_bytes(key.key).verify(proof, message)
    except (InvalidSignature, ValueError):
        return False
    return True


def decode(text: str, where: str) -> bytes:
    """Bytes of strict base64. Raises FormatError."""
    try:
        return base64.b64decode(text.encode("ascii"), validate=True)
    except (binascii.Error, UnicodeEncodeError) as caught:
        raise FormatError(f"is not base64: {caught}", where=where) from None


def _lines(path: Path) -> list[str]:
    try:
        text = read_bytes(path, limit=_MAX_BYTES).decode("utf-8")
    except UnicodeDecodeError:
        raise FormatError("is not text", where=path, expected="a minisign file") from None
    return text.removesuffix("\n").replace("\r\n", "\n").split("\n")


def _no_key(path: Path, what: str) -> FormatError:
    return FormatError(
        what,
        where=path,
        expected="a minisign public key: a comment, and base64 that begins with RW",
        remedy="make one with: magtiles keygen",
    )
