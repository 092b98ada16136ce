"""The policies of a sequence in words."""

from __future__ import annotations

import math

from labseq.config import CheckSettings
from labseq.sequencer.policies import StepPolicy
from labseq.session.assembly import Assembly
from labseq.units import format_quantity

_THEN = {"repeat_shot": "repeats the shot", "skip_point": "skips its point", "stop": "stops the run"}


def policy_texts(assembly: Assembly) -> list[str]:
    """What differs from doing without policies, a line for the run, each step and each check."""
    policy, spec = assembly.policy, assembly.sequence
    texts = [text for text in [_differing(policy.otherwise, StepPolicy())] if text]
    if policy.when_exhausted == "skip_point":
        texts.append("a shot whose attempts are used up skips its point")
    for number, (step, own) in enumerate(zip(spec.shot, policy.steps, strict=True)):
        if text := _differing(own, policy.otherwise):
            texts.append(f"step {number} ({step.name or step.kind}): {text}")
    return texts + [_check(check) for check in spec.policy.checks]


def _differing(own: StepPolicy, otherwise: StepPolicy) -> str:
    parts: list[str] = []
    if own.timeout_s < math.inf:
        parts.append(f"{format_quantity(own.timeout_s, 'time')} at most")
    if own.retries:
        parts.append("tried again once" if own.retries == 1 else f"tried again {own.retries} times")
    if own.on_failure and own.on_failure != otherwise.on_failure:
        parts.append(f"a failure {_THEN[own.on_failure]}")
    if own.over_budget != otherwise.over_budget:
        then = {"record": "is just recorded", "warn": "is a warning"} | _THEN
        parts.append(f"a stage over its budget {then[own.over_budget]}")
    return ", ".join(parts)


def _check(check: CheckSettings) -> str:
    limits = [
        f"{word} {limit:g}"
        for word, limit in (("at least", check.at_least), ("at most", check.at_most))
        if limit is not None
    ]
    of = "each shot" if check.shots == 1 else f"the mean of {check.shots} shots"
    then = {"warn": "a warning"} | _THEN
    return f"{check.value} of {of} {' and '.join(limits)}; else {then[check.then]}"
