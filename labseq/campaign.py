"""Parameter campaigns: one run for each point of a grid of values; and the certificates of clusters."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from labseq.errors import ConfigError, Problem
from labseq.files import explained, write_file
from labseq.messages import install_hint, visible
from labseq.plain import now

if TYPE_CHECKING:
    from labseq.session.options import Options


DAYS: Final = 730
"""How long the certificates are valid."""

campaign = typer.Typer(
    name="campaign",
    help="Clusters, and runs over many values.",
    short_help="Runs over many values; certificates of a cluster.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@campaign.command("keys", short_help="Make the certificates of a cluster.")
def make_certificates(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A folder without certificates.", show_default=False)
    ],
) -> None:
    """Make the certificates with which scheduler, workers and clients of a dask cluster know one another.

    Anyone who has one of the files can have the cluster run any code: copy them only to its machines.
    """
    from labseq.console.output import say
    from labseq.console.text import quoted

    ca, scheduler, worker, _ = map(quoted, make_keys(folder))
    say(
        f"The certificates are in {quoted(folder)}, valid for {DAYS} days. Copy the folder to each machine.",
        f"  dask scheduler --protocol tls --tls-ca-file {ca} --tls-cert {scheduler} --tls-key {scheduler}",
        "  dask worker tls://SCHEDULER:8786 --nthreads 1 --nworkers 4 "
        f"--tls-ca-file {ca} --tls-cert {worker} --tls-key {worker}",
        f"  labseq run SEQUENCE --scheduler tls://SCHEDULER:8786 --keys {quoted(folder)}",
    )


def run_file(
    run_session: Callable[..., None], file: Path, folder: Path, netcdf: Path | None, workers: Options
) -> None:
    """Run a campaign file; print a table; check first that the combined file can be written."""
    from labseq.console.output import check_writable, say
    from labseq.console.text import columns, plural
    from labseq.recording.tables import check_installed
    from labseq.session.campaign import Campaign, run_campaign

    if netcdf is not None:
        check_installed("xarray", "h5netcdf")
        check_writable(netcdf)
    wanted = Campaign.read(file)
    runs = run_campaign(partial(run_session, as_json=False), wanted, folder.expanduser(), workers)
    rows: list[tuple[Any, ...]] = [(*wanted.axes, "shots", "filling", "run")]
    for point, run in zip(wanted.points(), runs, strict=True):
        values = [wanted.axes[address][i] for address, i in zip(wanted.axes, point, strict=True)]
        known = [one for shot in run.shots if not math.isnan(one := shot.filling_fraction)]
        filling = f"{100 * sum(known) / len(known):.2f} %" if known else "-"
        rows.append((*values, str(len(run.shots)), filling, f"{run.path.parent.name}/{run.path.name}"))
    say("", *columns(rows), f"{plural(len(runs), 'run')} in {folder}")


def make_keys(folder: Path) -> list[Path]:
    """Make an authority, and a certificate with its key for scheduler, workers and clients.

    The key of the authority is kept nowhere: for another certificate, all are made again. Existing files are
    not replaced.

    Args:
        folder: Where they are written; created if it does not exist, and closed to other users.

    Returns:
        The files: ``ca.pem``, and for each role one with key and certificate.

    Raises:
        ConfigError: One of the files exists, or the extra is not installed.
        RecordingError: The folder cannot be written to.
    """
    from labseq.cluster import CA_FILE, CLIENT_FILE

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
        what = "this file already exists; nothing was written"
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
    """A certificate; that of the authority itself if it has no signer."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes

    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    today = now()
    is_authority = signer is None
    usage = dict.fromkeys(
        ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement"), False
    )
    only = {"encipher_only": False, "decipher_only": False, "crl_sign": is_authority}
    signs = x509.KeyUsage(digital_signature=True, key_cert_sign=is_authority, **usage, **only)
    signing_key = key if is_authority else signer
    authority = x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key())
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if is_authority else root.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(today - timedelta(days=1))
        .not_valid_after(today + timedelta(days=DAYS))
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
        .add_extension(signs, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(authority, critical=False)
    )
    return builder.sign(signing_key, hashes.SHA256())
