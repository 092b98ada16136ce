"""What tests need that may be missing: a skip on a user's machine, a failure in CI."""

from __future__ import annotations

import os
from collections.abc import Callable

import pytest


def need_library(load: Callable[[], object]) -> None:
    """Skip, with the error as the reason, if something cannot be loaded.

    Fails if LABSEQ_REQUIRE_ALL is set: there everything must be installed.

    Args:
        load: Loads it, or raises what says how to install it.
    """
    try:
        load()
        return
    except Exception as error:  # noqa: BLE001 - whatever it is, it says what is missing
        reason = str(error)
    if os.environ.get("LABSEQ_REQUIRE_ALL"):
        pytest.fail(f"LABSEQ_REQUIRE_ALL is set, but {reason}", pytrace=False)
    pytest.skip(reason)
