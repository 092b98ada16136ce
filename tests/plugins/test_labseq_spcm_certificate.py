"""The mode ``stream`` needs the certificate of a first contact; without it the default mode plays."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from labseq_spcm import certificate
from labseq_spcm.mobile_tweezers import SpcmMobileTweezers
from labseq_spcm.settings import SpcmSettings

from labseq.drivers.first_contact import contact_path, this_computer, write_contact
from labseq.plugin import ConfigError, Context

SERIAL = 12345
CARD = {"serial": str(SERIAL), "model": "M4i.6631-x8", "driver": "7.9.22000", "firmware": "1"}
PARKED = {"row_frequency": 82.2e6, "column_frequency": 117.9e6}
RATE = {"sample_rate": 250e6, "notify_size": 1 << 16, "card_buffer": 1 << 17}

Certify = Callable[..., Path]


@pytest.fixture
def certify(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Certify:
    """Writes the file of a first contact into the data folder; simulated cards need one, too."""
    monkeypatch.setenv("LABSEQ_DATA", str(tmp_path))
    monkeypatch.setattr(certificate, "SIMULATED", "none of them")

    def write(stream: bool = True, **changes: Any) -> Path:
        path = contact_path(tmp_path, str(SERIAL))
        path.parent.mkdir(exist_ok=True)
        verdict = {"stream": stream, "reason": "" if stream else "the card copies samples", "settings": RATE}
        content = {"schema": 1, "card": CARD, "computer": this_computer(), "measured": {}, "verdict": verdict}
        write_contact(path, content | changes)
        return path

    return write


def with_serial(**settings: Any) -> SpcmSettings:
    given = {"card": "/dev/spcm0", "serial": SERIAL, "mode": "stream", **RATE, **settings}
    return SpcmSettings.model_validate(given)


def test_with_it_the_card_streams(driver: Any, certify: Certify) -> None:
    certify()
    with driver("stream", serial=SERIAL) as lab:
        assert not any("certificate" in text for text in lab.tweezers.warnings())
        lab.play(lab.program(1))
        assert lab.tweezers.describe()["mode"] == "stream"
    assert with_serial().overhead_per_cycle_s == 3e-3


def other_computer(certify: Certify) -> None:
    certify(computer={"node": "elsewhere", "machine_id": "0"})


def edited(certify: Certify) -> None:
    path = certify(stream=False)
    content = json.loads(path.read_text("utf-8"))
    content["verdict"]["stream"] = True
    path.write_text(json.dumps(content), "utf-8")


@pytest.mark.parametrize(
    ("prepare", "settings", "text"),
    [
        (
            lambda _: None,
            {},
            "there is none for the card 12345; `mode: sequence` is used instead",
        ),
        (
            lambda certify: certify(),
            {"serial": 0},
            "`serial` does not say which card it is; `mode: sequence`",
        ),
        (lambda certify: certify(stream=False), {}, "says: the card copies samples; `mode: sequence`"),
        (
            lambda certify: certify(),
            {"sample_rate": 280e6},
            "sample_rate 250 MHz, but the profile has 280 MHz",
        ),
        (other_computer, {}, "measured on another computer, 'elsewhere'"),
        (edited, {}, "its digest does not match"),
    ],
)
def test_without_it_check_says_so_in_a_line_and_the_default_mode_plays(
    driver: Any, certify: Certify, prepare: Any, settings: dict[str, Any], text: str
) -> None:
    prepare(certify)
    asked = with_serial(keep_warm=PARKED, **settings)
    (warning,) = SpcmMobileTweezers(asked, Context("awg")).warnings()
    assert re.search(text, warning)
    assert "\n" not in warning
    assert asked.overhead_per_cycle_s == 6e-3, "plans reckon with it"
    with driver("stream", **{"serial": SERIAL, **settings}) as lab:
        lab.play(lab.program(1))
        described = lab.tweezers.describe()
        assert described["mode"] == "sequence"
        assert described["not_streamed_because"] in warning


@pytest.mark.parametrize("key", ["driver", "firmware", "model"])
def test_one_of_other_software_or_another_card_is_refused_when_the_card_is_opened(
    driver: Any, certify: Certify, key: str
) -> None:
    certify(card=CARD | {key: "another"})
    with (
        pytest.raises(
            ConfigError, match=rf"measured with {key} another, but the device has .* first-contact"
        ),
        driver("stream", serial=SERIAL),
    ):
        pass
