"""The certificates by which the computers of a dask cluster recognise each other."""

from __future__ import annotations

import os
from datetime import timedelta
from pathlib import Path
from typing import Any, Final

from labseq.cluster import CA_FILE, CLIENT_FILE
from labseq.errors import ConfigError, Problem
from labseq.files import explained, write_file
from labseq.messages import install_hint, visible
from labseq.plain import now

DAYS: Final = 730
"""How many days the certificates are valid."""


def make_certificates(folder: Path) -> list[Path]:
    """Make an authority, and a certificate with its key for scheduler, workers and clients.

    The key of the authority is not stored, so a further certificate means making all of them again. Existing
    files are not replaced.

    Args:
        folder: Where they are written. Created if it does not exist, and closed to other users.

    Returns:
        The files: ``ca.pem``, and for each role a file with key and certificate.

    Raises:
        ConfigError: One of the files exists, or the extra is not installed.
        RecordingError: The folder cannot be written to.
    """
    try:
        import cryptography  # noqa: F401  # pyright: ignore[reportUnusedImport]
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ec
    except ModuleNotFoundError as error:
        what = "certificates need the Python package 'cryptography', which is not installed"
        raise ConfigError(Problem(what, hint=install_hint("campaign"))) from error
    roles = {"scheduler.pem": "scheduler", "worker.pem": "worker", CLIENT_FILE: "client"}
    paths = [folder / name for name in (CA_FILE, *roles)]
    if taken := [path for path in paths if path.exists()]:
        what = "this file already exists, so nothing was written"
        raise ConfigError(Problem(what, visible(str(taken[0])), expected="a folder without certificates"))
    with explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
    encoding, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    authority = ec.generate_private_key(ec.SECP256R1())
    root = _certificate("labseq campaign", authority, None, None)
    _write(folder / CA_FILE, root.public_bytes(encoding))
    for file, name in roles.items():
        key = ec.generate_private_key(ec.SECP256R1())
        secret = key.private_bytes(encoding, serialization.PrivateFormat.PKCS8, plain)
        _write(folder / file, secret + _certificate(name, key, authority, root).public_bytes(encoding))
    return paths


def _write(path: Path, data: bytes) -> None:
    """Write a file that only its owner can read."""
    mask = os.umask(0o077)
    try:
        write_file(path, data)
    finally:
        os.umask(mask)


def _certificate(name: str, key: Any, signer: Any, root: Any) -> Any:
    """A certificate. Without a signer, it is the certificate of the authority itself."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    today = now()
    is_authority = signer is None
    usage = dict.fromkeys(
        ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement"), False
    )
    flags = {"encipher_only": False, "decipher_only": False, "crl_sign": is_authority}
    signs = x509.KeyUsage(digital_signature=True, key_cert_sign=is_authority, **usage, **flags)
    signing_key = key if is_authority else signer
    authority = x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key())
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if is_authority else root.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(today - timedelta(days=1))  # the clocks of computers differ
        .not_valid_after(today + timedelta(days=DAYS))
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
        .add_extension(signs, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(authority, critical=False)
    )
    return builder.sign(signing_key, hashes.SHA256())
