"""Tests that are run by a test."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest


def run_pytest(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code and output of pytest in this process; modules below the current folder are forgotten."""
    capsys.readouterr()
    before, path = {*sys.modules}, [*sys.path]
    code = pytest.main(["-q", "-n0", "-p", "no:cacheprovider", *arguments])
    sys.path[:] = path  # pytest puts the folders of tests there, and their packages would count as installed
    for name in {*sys.modules} - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(Path.cwd())):
            del sys.modules[name]
    return code, capsys.readouterr().out
