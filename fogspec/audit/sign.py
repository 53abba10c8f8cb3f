"""Sign statements in DSSE envelopes (https://github.com/secure-systems-lab/dsse) with a key in a PEM file.

securesystemslib implements the cryptography: `pip install 'fogspec[attest]'`.
"""

import json
from typing import Any, NamedTuple

from fogspec.audit import attest
from fogspec.audit.verify import Check
from fogspec.base.errors import InvalidInput, UsageError
from fogspec.base.files import read_file
from fogspec.compile.bundle import ManifestBundle

PAYLOAD = "application/vnd.in-toto+json"
INSTALL = "pip install 'fogspec[attest]'"


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
        envelope.sign(library.signer.CryptoSigner(private))
    except library.wrong as wrong:
        raise InvalidInput(f"{key}: is not a private key without a password that can sign: {wrong}") from None
    return json.dumps(envelope.to_dict(), indent=2, sort_keys=True) + "\n"


def check_signed(opened: ManifestBundle, path: str, key: str) -> Check:
    """Check that the envelope at `path` is signed with the key and attests the manifest in its current state.

    Raise InvalidInput for a file that cannot be read or is not a public key.
    """
    library, content = _library(), _read(key)
    try:
        public = library.signer.SSlibKey.from_crypto(library.keys.load_pem_public_key(content))
    except library.wrong as wrong:
        raise InvalidInput(f"{key}: is not a public key: {wrong}") from None
    try:
        envelope = library.dsse.Envelope.from_dict(json.loads(_read(path)))
        envelope.verify([public], 1)
        data: Any = json.loads(envelope.payload)
    except library.unsound as wrong:
        return Check("attestation", path, (f"not signed with {key}: {wrong}",))
    if envelope.payload_type != PAYLOAD:
        return Check("attestation", path, (f"it holds {envelope.payload_type}, not {PAYLOAD}",))
    link = attest.check(opened, data)
    return Check(link.name, f"{path}, signed with {key}", link.breaks)


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
