"""The content of an answer to a control system, in each form of the protocol."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import numpy as np

from labseq.plugin import ImageRecord, Occupancy, ShotRecord, TargetPattern
from labseq.plugin.messages import visible

VERSION: Final = 3
"""Version of the protocol."""
SHORT_LINE: Final = 200
"""Longest first line of a control system, and longest answer of the short form, in bytes."""
LONGEST_REASON: Final = 1000
_ENCODER: Final = json.JSONEncoder(allow_nan=False)


class Form(Enum):
    """Form of the answers."""

    SHORT = "short"
    """Lines of version 2, for a control system that names no version."""
    TEXT = "text"
    JSON = "json"


@dataclass(frozen=True, slots=True)
class Asked:
    """The options that a control system requests in its `hello`.

    Attributes:
        form: Form of the answers.
        each_image: Whether the control system wants an answer for each image.
        listens: Whether it also wants answers for shots that it did not start.
    """

    form: Form = Form.SHORT
    each_image: bool = False
    listens: bool = False


CHOICES_OF_HELLO: Final = {
    "version": (str(VERSION),),
    "form": ("text", "json"),
    "images": ("last", "each"),
    "shots": ("own", "all"),
}
"""Options of a `hello` -> their values, the default first."""


def asked_for(words: str) -> Asked:
    """Read the options after `hello` and the token.

    Raises:
        ValueError: Another version, or an unknown word.
    """
    asked: dict[str, str] = {}
    for word in words.split():
        key, _, value = word.partition("=")
        if key not in CHOICES_OF_HELLO or key in asked:
            what = f"'{one_line(word)[:40]}' in hello"
            keys = "form=text, form=json, images=each or shots=all"
            raise ValueError(f"{what}; expected version={VERSION} and {keys}")
        asked[key] = value
    if not asked:
        return Asked()
    if asked.get("version") != str(VERSION):
        came = one_line(asked.get("version", "missing"))[:10]
        raise ValueError(f"version is {came}; this labseq speaks version={VERSION}")
    for key, value in asked.items():
        if value not in CHOICES_OF_HELLO[key]:
            expected = " or ".join(CHOICES_OF_HELLO[key])
            raise ValueError(f"{key} is {one_line(value)[:10]}; expected {expected}")
    form = Form(asked.get("form", "text"))
    return Asked(form, asked.get("images") == "each", asked.get("shots") == "all")


@dataclass(frozen=True, slots=True)
class Times:
    """Times of a `go` and its shot on the session's clock, in seconds.

    Attributes:
        go_s: Time when `go` came.
        taken_s: Time when a step took it.
        done_s: Time when its shot was over.
    """

    go_s: float
    taken_s: float
    done_s: float


def facts_of(about: Mapping[str, Any], times: Times) -> dict[str, Any]:
    """The facts of a shot for its answer, ready for JSON. Times are in seconds after `go`.

    Args:
        about: Facts as in ``labseq.plugin.LeaderLink.report``.
        times: Times of the `go`. Only images, steps and stages that began after it was taken are included.
    """
    facts = {key: about[key] for key in ("shot", "success", "filling") if key in about}
    facts |= {"taken_s": _time(times.taken_s - times.go_s), "done_s": _time(times.done_s - times.go_s)}
    record: ShotRecord | None = about.get("record")
    if record is not None:
        since_s, target = about["start_s"] - times.go_s, about["target"]
        first_s = times.taken_s - about["start_s"]
        images = [image for image in record.images if image.t_start_s >= first_s]
        facts["images"] = [image_facts(image, target, since_s) for image in images]
        if images:
            facts["shape"] = list(images[-1].occupancy.shape)
            facts["atoms"], facts["defects"] = (facts["images"][-1][key] for key in ("atoms", "defects"))
        if record.n_missing_atoms:
            facts["missing"] = record.n_missing_atoms
        facts["steps"] = [
            {"name": step.name, "step": step.step, "start_s": _time(since_s + step.t_start_s)}
            | {"duration_s": _time(step.achieved_s)}
            for step in record.steps
            if step.t_start_s >= first_s
        ]
        facts["stages"] = [
            {"name": stage.stage, "step": stage.step, "cycle": stage.cycle}
            | {"start_s": _time(since_s + stage.t_start_s), "duration_s": _time(stage.duration_s)}
            for stage in record.timing
            if stage.t_start_s >= first_s
        ]
    facts |= {key: about[key] for key in ("refused", "file", "run", "reason") if key in about}
    return facts


def image_facts(image: ImageRecord, target: TargetPattern, since_s: float) -> dict[str, Any]:
    """The facts of an image.

    Args:
        since_s: Time from `go` to the start of the shot, in seconds.
    """
    return {
        "name": image.name,
        "step": image.step,
        "cycle": image.cycle,
        "judged": image.cycle < 0 and not target.is_none,
        "start_s": _time(since_s + image.t_start_s),
        "exposure_s": image.exposure_s,
        "atoms": int(image.occupancy.sum()),
        "defects": None if target.is_none else target.n_defects(image.occupancy),
        "occupancy": bits(image.occupancy),
    }


def bits(occupancy: Occupancy) -> str:
    """An occupancy as hexadecimal digits, with a bit for each site, row by row, 1 for an atom.

    The first site is the highest bit of the first digit. Rows follow one another without a gap, and zeros
    fill the last byte.

    Example:
        >>> import numpy as np
        >>> bits(np.array([[1, 0, 0], [1, 1, 1], [0, 0, 1]], bool))
        '9c80'
    """
    return np.packbits(occupancy).tobytes().hex()


def line(form: Form, word: str, facts: Mapping[str, Any]) -> str:
    """A line to send, with its first word and its facts.

    In text, facts follow as "key=value" in order. "run" and "reason" come last and may contain spaces.
    """
    if form is Form.JSON:
        return _ENCODER.encode({"answer": word, **facts})
    if form is Form.TEXT:
        facts = _flat(facts)
    else:
        facts = {key: facts[key] for key in ("shot", "success", "filling", "reason") if key in facts}
    text = " ".join([word, *(f"{key}={_shown(value)}" for key, value in facts.items())])
    return text if form is Form.TEXT else text[:SHORT_LINE]


def _flat(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The facts of a line of text. It has the first and the last image, and which images were judged."""
    flat = {key: value for key, value in facts.items() if not isinstance(value, list) and value is not None}
    last = {key: flat.pop(key) for key in ("occupancy", "file", "run", "reason") if key in flat}
    if images := facts.get("images"):
        flat["judged"] = ",".join(str(int(image["judged"])) for image in images)
        flat |= {"before": images[0]["occupancy"], "after": images[-1]["occupancy"]}
    return flat | last


def _shown(value: bool | int | float | str) -> str:
    if isinstance(value, bool | int):
        return str(int(value))
    return f"{value:.4g}" if isinstance(value, float) else one_line(value)[:LONGEST_REASON]


def one_line(text: str) -> str:
    """A text without line feeds and other invisible characters."""
    return " ".join(visible(text).split())


def _time(value_s: float) -> float:
    return round(value_s, 6)
