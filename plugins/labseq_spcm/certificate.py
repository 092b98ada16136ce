"""The certificate of the mode ``stream``, a successful first contact with this card on this computer.

The mode assumes that samples may be changed after they were handed over, that the card's reports are not
late, and that the bus is fast enough. Only the card can prove this.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from labseq.plugin import ConfigError
from labseq.plugin.first_contact import check_belongs, contact_path, data_root, read_contact
from labseq_spcm.library import SIMULATED
from labseq_spcm.settings import SpcmSettings


def permitted(settings: SpcmSettings) -> tuple[SpcmSettings, str]:
    """The settings, with the default mode if the card may not ``stream``, and why it may not."""
    reason = missing_certificate(settings) if settings.mode == "stream" else ""
    if not reason:
        return settings, ""
    mode = SpcmSettings.model_fields["mode"].default
    return settings.model_copy(update={"mode": mode}), reason


def missing_certificate(settings: SpcmSettings) -> str:
    """Why the card may not stream with these settings, "" if it may or is simulated."""
    if settings.card.startswith(SIMULATED):
        return ""
    if not settings.serial:
        return "`serial` does not say which card it is"
    path = certificate_path(settings)
    if not path.exists():
        return f"there is none for the card {settings.serial}"
    try:
        content = read_contact(path)
        check_belongs(content, {}, path)
    except ConfigError as error:
        return f"the certificate of the card {settings.serial} cannot be used: {error.problems[0].what}"
    verdict = content["verdict"]
    if not verdict["stream"]:
        return f"its first contact says: {verdict['reason']}"
    for key, value in verdict["settings"].items():
        if value != (present := getattr(settings, key)):
            measured, present = (
                f"{n / 1e6:.9g} MHz" if key == "sample_rate" else n for n in (value, present)
            )
            return f"its first contact was with {key} {measured}, but the profile has {present}"
    return ""


def check_certificate(settings: SpcmSettings, card: Mapping[str, str]) -> None:
    """Check that the certificate is for the open card and its present software.

    Args:
        settings: Settings of the driver.
        card: See :func:`labseq_spcm.set_up.identity`.

    Raises:
        ConfigError: It is for another card, driver or firmware.
    """
    if not settings.card.startswith(SIMULATED):
        path = certificate_path(settings)
        check_belongs(read_contact(path), card, path)


def certificate_path(settings: SpcmSettings) -> Path:
    """The file of the card's first contact."""
    return contact_path(data_root(), str(settings.serial))
