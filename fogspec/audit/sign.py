"""Sign statements in DSSE envelopes (https://github.com/secure-systems-lab/dsse) with a key in a PEM file.

RSA signatures are PKCS#1 v1.5 over SHA-256, as cosign and `openssl dgst -verify` expect them. securesystemslib
implements the cryptography: `pip install 'fogspec[attest]'`.
"""

import contextlib
import json
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

from fogspec.audit import attest
from fogspec.audit.verify import Check
from fogspec.base.errors import InvalidInput, Refused, UsageError
from fogspec.base.files import read_file
from fogspec.base.text import shell_command
from fogspec.compile.bundle import ManifestBundle

PAYLOAD = "application/vnd.in-toto+json"
INSTALL = "pip install 'fogspec[attest]'"
ATTESTATION = "attestation.json"  # beside the manifest, where it is committed with it
RSA = "rsa-pkcs1v15-sha256"
FORMER_RSA = "rsassa-pss-sha256"  # what fogspec 0.1 signed with


class _Library(NamedTuple):
    """Modules of the `attest` extra.

    `wrong` are their exceptions for unusable keys, `unsound` those for malformed or unsigned envelopes.
    """

    dsse: Any
    signer: Any
    keys: Any
    wrong: tuple[type[Exception], ...]
    unsound: tuple[type[Exception], ...]


def sign(text: str, key: str) -> str:
    """Return the statement in a signed envelope, as JSON. Raise InvalidInput for a file that is not a private key."""
    library, content = _library(), _read(key)
    try:
        private = library.keys.load_pem_private_key(content, None)
        envelope = library.dsse.Envelope(text.encode(), PAYLOAD, {})
        envelope.sign(library.signer.CryptoSigner(private, _public(library, private.public_key())))
    except library.wrong as wrong:
        raise InvalidInput(f"{key}: is not a private key without a password that can sign: {wrong}") from None
    return json.dumps(envelope.to_dict(), indent=2, sort_keys=True) + "\n"


def check_signed(opened: ManifestBundle, path: str, key: str) -> Check:
    """Check that the envelope at `path` is signed with the key and attests the manifest in its current state.

    Raise InvalidInput for a file that cannot be read or is not a public key.
    """
    library, content = _library(), _read(key)
    try:
        loaded = library.keys.load_pem_public_key(content)
        public = [_public(library, loaded), _public(library, loaded, FORMER_RSA)]
    except library.wrong as wrong:
        raise InvalidInput(f"{key}: is not a public key: {wrong}") from None
    try:
        envelope = library.dsse.Envelope.from_dict(json.loads(_read(path)))
        _verify(library, envelope, public)
        data: Any = json.loads(envelope.payload)
    except library.unsound as wrong:
        return Check("attestation", path, (f"not signed with {key}: {wrong}",))
    if envelope.payload_type != PAYLOAD:
        return Check("attestation", path, (f"it holds {envelope.payload_type}, not {PAYLOAD}",))
    link = attest.check(opened, data)
    return Check(link.name, f"{path}, signed with {key}", link.breaks)


def require_signed(opened: ManifestBundle, path: str | None, key: str) -> None:
    """Raise Refused without a statement of exactly the files of this manifest that is signed with the key.

    `path` is its file, by default beside the manifest. Files that machines are sent must be pinned by a lock: through it the
    statement covers them. Raise InvalidInput for a file that is not a public key.
    """
    layout = opened.layout
    beside = layout.compiled / ATTESTATION
    at = str(beside) if path is None else path
    attest_it = shell_command("fogspec", "attest", layout.manifest, "--key", "PRIVATE.pem", "--out", at)
    if opened.inputs.sent and opened.inputs.pins is None:
        raise Refused(
            f"{layout.manifest}: files beside the spec are sent to machines, and no lock pins them: no statement covers them",
            f"{shell_command('fogspec', 'lock', layout.spec)}; compile, review, then {attest_it}",
        )
    if not (layout.files.exists(beside) if path is None else os.path.lexists(at)):
        raise Refused(f"{layout.manifest}: is not attested: there is no {at}", attest_it)
    found = check_signed(opened, at, key)
    if found.breaks:
        raise Refused(f"{layout.manifest}: is not attested: {found.breaks[0]}", *found.breaks[1:], attest_it)


def _public(library: _Library, key: Any, rsa: str = RSA) -> Any:
    """Return a public key as securesystemslib has it; an RSA key for one scheme of signatures."""
    found = library.signer.SSlibKey.from_crypto(key)
    return library.signer.SSlibKey.from_crypto(key, scheme=rsa) if found.keytype == "rsa" else found


def _verify(library: _Library, envelope: Any, keys: Sequence[Any]) -> None:
    """Raise the library's error if none of the keys, which are one key for several schemes, signed the envelope."""
    for key in keys[:-1]:
        with contextlib.suppress(*library.unsound):
            envelope.verify([key], 1)
            return
    envelope.verify(keys[-1:], 1)


def _library() -> _Library:
    try:
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives import serialization
        from securesystemslib import dsse, exceptions, signer
    except ImportError:
        raise UsageError("signing needs securesystemslib", INSTALL) from None
    wrong = (ValueError, TypeError, UnsupportedAlgorithm, exceptions.UnsupportedLibraryError)
    unsound = (*wrong, KeyError, AttributeError, exceptions.VerificationError)
    return _Library(dsse, signer, serialization, wrong, unsound)


def _read(path: str) -> bytes:
    try:
        return read_file(path)
    except OSError as problem:
        raise InvalidInput(f"{path}: cannot be read: {problem.strerror}") from None
