"""Signatures: a published example of minisign, and every way in which one can be wrong."""

from __future__ import annotations

import base64
import builtins
import shutil
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from magtiles.catalog import open_release
from magtiles.catalog.releases.signature import (
    PublicKey,
    Signature,
    read_public_key,
    read_signature,
    verify,
)
from magtiles.schemas.errors import FormatError, IntegrityError, MagtilesError, UsageError
from magtiles.stages.release.sign import (
    SecretKey,
    generate_keys,
    public_key_text,
    read_secret_key,
    secret_key_text,
    sign_release,
    signature_text,
)

# Made by minisign 0.9: its author's key, and a prehashed signature of the four bytes "test".
EXAMPLE_KEY = """untrusted comment: minisign public key E7620F1842B4E81F
RWQf6LRCGA9i53mlYecO4IzT51TGPpvWucNSCh1CBM0QTaLn73Y7GFO3
"""
EXAMPLE = """untrusted comment: signature from minisign secret key
RUQf6LRCGA9i559r3g7V1qNyJDApGip8MfqcadIgT9CuhV3EMhHoN1mGTkUidF/z7SrlQgXdy8ofjb7bNJJylDOocrCo8KLzZwo=
trusted comment: timestamp:1633700835\tfile:test\tprehashed
wLMDjy9FLAuxZ3q4NlEvkgtyhrr0gtTu6KC4KBJdITbbOeAi1zBIYo0v4iTgt8jJpIidRJnp94ABQkJAgAooBQ==
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "file"
    path.write_text(text)
    return path


def parsed(folder: Path, text: str = EXAMPLE) -> Signature:
    return read_signature(written(folder, text))


def test_a_signature_that_minisign_made_is_true(tmp_path: Path) -> None:
    key = read_public_key(written(tmp_path, EXAMPLE_KEY))
    assert key.name == "E7620F1842B4E81F"
    signature = parsed(tmp_path)
    assert signature.trusted_comment == "timestamp:1633700835\tfile:test\tprehashed"
    verify(b"test", signature, key, where="test")
    with pytest.raises(IntegrityError, match="test: its content is not what key E7620F1842B4E81F"):
        verify(b"Test", signature, key, where="test")


def test_no_bit_of_a_signature_is_free(tmp_path: Path) -> None:
    """Each of 8 * (8 + 64 + 64) bits, and each character of the trusted comment."""
    key = read_public_key(written(tmp_path, EXAMPLE_KEY))
    true = parsed(tmp_path)
    for field in ("key_id", "signature", "global_signature"):
        value = getattr(true, field)
        for bit in range(8 * len(value)):
            flipped = bytearray(value)
            flipped[bit // 8] ^= 1 << bit % 8
            false = Signature(**{**vars(true), field: bytes(flipped)})
            with pytest.raises(IntegrityError):
                verify(b"test", false, key, where="test")
    for i in range(len(true.trusted_comment)):
        comment = true.trusted_comment[:i] + "x" + true.trusted_comment[i + 1 :]
        with pytest.raises(IntegrityError, match="the trusted comment"):
            verify(b"test", Signature(**{**vars(true), "trusted_comment": comment}), key, where="t")


KEY = SecretKey(bytes(range(8)), Ed25519PrivateKey.from_private_bytes(bytes(range(32))))
# RFC 8032 leaves no choice in a signature, so these follow from the formats byte by byte.
KEY_PAIR = bytes(range(32)) + bytes.fromhex(
    "03a107bff3ce10be1d70dd18e74bc09967e4d6309ba50d5f1ddc8664125531b8"
)


def test_files_of_keys_are_laid_out_as_minisign_does(tmp_path: Path) -> None:
    comment, body = public_key_text(KEY.public).splitlines()
    assert comment == "untrusted comment: minisign public key 0706050403020100"
    assert body.startswith("RW")
    assert base64.b64decode(body) == b"Ed" + KEY.id + KEY_PAIR[32:]
    raw = base64.b64decode(secret_key_text(KEY).splitlines()[1])
    assert raw[:6] == b"Ed\x00\x00B2"
    assert len(raw) == 158
    assert raw[54:62] + raw[62:126] == KEY.id + KEY_PAIR
    again = read_secret_key(written(tmp_path, secret_key_text(KEY)))
    assert again.public == KEY.public
    assert signature_text(b"a", again, "b") == signature_text(b"a", KEY, "b")


def test_a_generated_secret_is_for_its_owner_only(tmp_path: Path) -> None:
    secret, public = tmp_path / "k" / "a.key", tmp_path / "a.pub"
    made = generate_keys(secret, public)
    assert stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert read_public_key(public) == made == read_secret_key(secret).public
    with pytest.raises(UsageError, match=r"a\.key: exists already"):
        generate_keys(secret, tmp_path / "b.pub")
    assert not (tmp_path / "b.pub").exists()


class Bad(NamedTuple):
    text: str
    message: str


BAD_SIGNATURES = [
    Bad("", "has 1 lines"),
    Bad(EXAMPLE.replace("trusted comment: t", "comment: t"), "or others than expected"),
    Bad(EXAMPLE + "more\n", "has 5 lines"),
    Bad(EXAMPLE.replace("RUQf", "RWQf"), "begin with b'Ed'"),
    Bad(EXAMPLE.replace("RUQf6", "RUQ!6"), "line 2: is not base64"),
    Bad(EXAMPLE.replace("AooBQ==", "AooBQ"), "line 4: is not base64"),
    Bad("\0" * 20_000, "is 20000 bytes"),
]


@pytest.mark.parametrize("case", BAD_SIGNATURES, ids=lambda c: c.message)
def test_what_is_no_signature_is_refused(case: Bad, tmp_path: Path) -> None:
    with pytest.raises((FormatError, IntegrityError), match=case.message):
        parsed(tmp_path, case.text)


BAD_SECRETS = [
    Bad(EXAMPLE_KEY, "holds 42 bytes of another kind"),
    Bad("untrusted comment: x\n", "has 1 lines"),
    Bad(secret_key_text(KEY)[:-8] + "AAAAAA=\n", "its checksum"),
]


@pytest.mark.parametrize("case", BAD_SECRETS, ids=lambda c: c.message)
def test_what_is_no_secret_key_is_refused(case: Bad, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=case.message):
        read_secret_key(written(tmp_path, case.text))


def test_a_key_with_a_password_is_refused_with_the_way_out(tmp_path: Path) -> None:
    raw = bytearray(base64.b64decode(secret_key_text(KEY).splitlines()[1]))
    raw[2:4] = b"Sc"
    text = f"untrusted comment: x\n{base64.b64encode(raw).decode()}\n"
    with pytest.raises(FormatError, match=r"is protected by a password.*minisign -C"):
        read_secret_key(written(tmp_path, text))


@pytest.fixture(scope="module")
def signed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A signed copy of the release, read-only as published, and the public key."""
    home = tmp_path_factory.mktemp("signed")
    target = shutil.copytree(folder, home / "1.0.0")
    generate_keys(home / "a.key", home / "a.pub")
    before = target.stat().st_mode
    out = sign_release(target, home / "a.key")
    assert out == target / "manifest.json.minisig"
    assert target.stat().st_mode == before
    assert sorted(p.name for p in home.iterdir()) == ["1.0.0", "a.key", "a.pub"]
    return target, home / "a.pub"


def test_a_signed_release_opens_with_and_without_the_key(signed: tuple[Path, Path]) -> None:
    folder, public = signed
    open_release(folder)
    open_release(folder, public_key=public, require_signature=True)
    sign_release(folder, public.with_suffix(".key"))
    assert open_release(folder, public_key=str(public)).manifest.product == "demo"


class Forgery(NamedTuple):
    change: Callable[[Path], Any]
    message: str
    always: bool = True


def other_key(folder: Path) -> None:
    secret = folder.parent / "b.key"
    generate_keys(secret, folder.parent / "b.pub")
    sign_release(folder, secret)


FORGERIES = [
    Forgery(lambda f: edit(f / "manifest.json", b"{", b" {"), "its content is not what key"),
    Forgery(
        lambda f: edit(f / "manifest.json.minisig", b"magtiles rel", b"magtilesrel"), "comment"
    ),
    Forgery(lambda f: (f / "manifest.json.minisig").write_bytes(b""), "has 1 lines"),
    Forgery(other_key, "is signed by key"),
    Forgery(lambda f: (f / "manifest.json.minisig").unlink(), "is missing", always=False),
]


def edit(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))


@pytest.mark.parametrize("case", FORGERIES, ids=lambda c: c.message)
def test_a_forgery_is_refused(
    case: Forgery, signed: tuple[Path, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source, public = signed
    copy = shutil.copytree(source, tmp_path / "1.0.0", copy_function=shutil.copyfile)
    copy.chmod(0o755)
    case.change(copy)
    with pytest.raises(IntegrityError, match=case.message):
        open_release(copy, public_key=public, require_signature=True)
    if case.always:
        with pytest.raises(IntegrityError, match=case.message):
            open_release(copy, public_key=public)
    else:
        open_release(copy, public_key=public)
        assert "is not signed" in caplog.text


def test_a_requirement_needs_a_key_and_a_key_needs_cryptography(
    signed: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, public = signed
    with pytest.raises(UsageError, match="no public key given"):
        open_release(folder, require_signature=True)
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.startswith("cryptography"):
            raise ModuleNotFoundError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    open_release(folder)
    with pytest.raises(MagtilesError, match="pip install cryptography"):
        open_release(folder, public_key=public)


def test_a_public_key_that_is_none_is_refused(signed: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="begin with b'ED'"):
        open_release(signed[0], public_key=written(tmp_path, "\n".join(EXAMPLE.split("\n")[:2])))
    assert isinstance(read_public_key(signed[1]), PublicKey)
