"""The certificate of the mode ``stream``: a first contact with this card on this computer that went well.

What the mode assumes of the card only the card can prove: that samples may be changed after they were handed
over, that its reports are not late, that the bus is fast enough.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from labseq.plugin import ConfigError
from labseq.plugin.first_contact import check_belongs, contact_path, data_root, read_contact
from labseq_spcm.library import SIMULATED
from labseq_spcm.settings import SpcmSettings


def permitted(settings: SpcmSettings) -> tuple[SpcmSettings, str]:
    """The settings with the default mode in place of ``stream``, if the card may not; and why."""
    reason = missing_certificate(settings) if settings.mode == "stream" else ""
    if not reason:
        return settings, ""
    mode = SpcmSettings.model_fields["mode"].default
    return settings.model_copy(update={"mode": mode}), reason


def missing_certificate(settings: SpcmSettings) -> str:
    """Why the card may not stream with these settings; "" if it may, or if it exists in software only."""
    if settings.card.startswith(SIMULATED):
        return ""
    if not settings.serial:
        return "`serial` does not say which card it is"
    path = certificate_path(settings)
    if not path.exists():
        return f"there is none of the card {settings.serial}"
    try:
        content = read_contact(path)
        check_belongs(content, {}, path)
    except ConfigError as error:
        return f"of the card {settings.serial} it cannot be used: {error.problems[0].what}"
    verdict = content["verdict"]
    if not verdict["stream"]:
        return f"its first contact says: {verdict['reason']}"
    for key, value in verdict["settings"].items():
        if value != (present := getattr(settings, key)):
            measured, present = (
                f"{n / 1e6:.9g} MHz" if key == "sample_rate" else n for n in (value, present)
            )
            return f"its first contact was with {key} {measured}; the profile has {present}"
    return ""


def check_certificate(settings: SpcmSettings, card: Mapping[str, str]) -> None:
    """Check that the certificate is of the card that is open, and of its present software.

    Args:
        settings: Those of the driver.
        card: See :func:`labseq_spcm.set_up.identity`.

    Raises:
        ConfigError: It is of another card, driver or firmware.
    """
    if not settings.card.startswith(SIMULATED):
        path = certificate_path(settings)
        check_belongs(read_contact(path), card, path)


def certificate_path(settings: SpcmSettings) -> Path:
    """The file of the card's first contact."""
    return contact_path(data_root(), str(settings.serial))
