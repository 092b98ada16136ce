"""The policies of a sequence: what the sequencer is told of them, and the checks between two shots."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from labseq.config import CheckSettings, Collected, Document, SequenceSpec, StepPolicySettings, StepSpec
from labseq.errors import CheckFailedError
from labseq.recording import value_in
from labseq.roles import Repeatable, Step
from labseq.sequencer.policies import RunPolicy, StepPolicy


def make_policy(
    document: Document, sequence: SequenceSpec, steps: Sequence[tuple[str, Step]], found: Collected
) -> RunPolicy:
    """What holds for a run and its steps.

    Args:
        document: The sequence's file.
        sequence: What it says.
        steps: The steps that could be made.
        found: Where the problems go.
    """
    own = sequence.policy
    otherwise = StepPolicy(on_failure=own.on_failure, over_budget=own.over_budget)
    policies = [StepPolicy()] * len(sequence.shot)
    for number, spec in enumerate(sequence.shot):
        with found:
            policies[number] = _step_policy(document, spec, otherwise)
    is_whole = len(steps) == len(sequence.shot)
    for number, (spec, policy) in enumerate(zip(sequence.shot, policies, strict=True)):
        if is_whole and policy.retries and not _is_repeatable(steps[number][1]):
            what = f"'{spec.kind}' cannot be tried again in the same shot: atoms may have moved"
            hint = "write 'on_failure: repeat_shot'"
            found.add(document.error((*spec.policy_loc, "retries"), what, "0", hint, key=True))
    for number, check in enumerate(own.checks):
        if check.then == "skip_point" and sequence.scan is None:
            what = "there is no scan whose points could be skipped"
            found.add(document.error(("policy", "checks", number, "then"), what, "'warn' or 'stop'"))
    return RunPolicy(sequence.attempts, own.used_up, otherwise, tuple(policies))


def with_policies(
    document: Document, sequence: SequenceSpec, dumps: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """The settings of the steps for the record, with the policies that they have of their own."""
    return [
        {
            **dumped,
            "policy": document.validate(StepPolicySettings, spec.policy_loc).model_dump(
                mode="json", exclude_unset=True
            ),
        }
        if _has(document, spec)
        else dict(dumped)
        for spec, dumped in zip(sequence.shot, dumps, strict=True)
    ]


def _has(document: Document, spec: StepSpec) -> bool:
    return document.root.at(spec.policy_loc) is not None


def _step_policy(document: Document, spec: StepSpec, otherwise: StepPolicy) -> StepPolicy:
    if not _has(document, spec):
        return otherwise
    own = document.validate(StepPolicySettings, spec.policy_loc, called=f"the policy of '{spec.kind}'")
    policy = replace(otherwise, retries=own.retries)
    if own.timeout is not None:
        policy = replace(policy, timeout_s=own.timeout)
    if own.on_failure is not None:
        policy = replace(policy, on_failure=own.on_failure)
    return policy if own.over_budget is None else replace(policy, over_budget=own.over_budget)


def _is_repeatable(step: Step) -> bool:
    return isinstance(step, Repeatable) and step.repeatable


class Checks:
    """Looks at values of the last shots between two shots.

    Args:
        checks: What the sequence asks for.
        rows: The index's lines of the shots that were taken before, in order.
        warn: Told what is let pass with a warning.
    """

    def __init__(
        self,
        checks: Sequence[CheckSettings],
        rows: Iterable[Mapping[str, Any]],
        warn: Callable[[str], None],
    ) -> None:
        self._checks = [(check, deque[float](maxlen=check.shots)) for check in checks]
        self._warn = warn
        for row in rows:
            self._look(row)  # what came of it was done then

    def after(self, row: Mapping[str, Any]) -> str:
        """Look at a shot that was taken.

        Args:
            row: Its line in the index.

        Returns:
            Why the rest of its point shall be skipped, or "".

        Raises:
            CheckFailedError: A value is beyond the limits of a check that stops the run.
        """
        skipped = ""
        for check, told in self._look(row):
            if check.then == "stop":
                raise CheckFailedError(told, check.value)
            if check.then == "skip_point":
                skipped = skipped or told
            else:
                self._warn(f"shot {row['shot'] + 1}: {told}")
        return skipped

    def _look(self, row: Mapping[str, Any]) -> list[tuple[CheckSettings, str]]:
        """The checks that a shot breaks, and what is wrong."""
        broken: list[tuple[CheckSettings, str]] = []
        for check, values in self._checks:
            values.append(value_in(row, check.value))
            if told := _beyond(check, values):
                broken.append((check, told))
                values.clear()  # said once, and then again after as many shots
        return broken


def _beyond(check: CheckSettings, values: deque[float]) -> str:
    """What is wrong with the last values, or ""; shots without the value do not count."""
    known = [value for value in values if not np.isnan(value)]
    if len(values) < check.shots or not known:
        return ""
    mean = float(np.mean(known))
    of = "" if check.shots == 1 else f" on the mean of the last {check.shots} shots"
    if check.at_least is not None and mean < check.at_least:
        return f"{check.value} is {mean:.6g}{of}; it should be at least {check.at_least:g}"
    if check.at_most is not None and mean > check.at_most:
        return f"{check.value} is {mean:.6g}{of}; it should be at most {check.at_most:g}"
    return ""
