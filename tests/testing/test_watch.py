import importlib
import os
import sys
from pathlib import Path

import pytest

from labseq.roles import Context
from labseq.testing import CameraContract, ContractViolation
from labseq.testing.fakes import RecordingCamera


def test_the_file_that_a_constructor_reads_is_named() -> None:
    def camera(context: Context) -> RecordingCamera:
        Path(os.devnull).read_bytes()
        return RecordingCamera(context)

    with pytest.raises(ContractViolation, match=r"but it did open\(.*\); open\(\) is the place"):
        CameraContract().test_constructor_does_no_io(camera)


def test_an_import_in_a_constructor_is_no_io(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "wave", raising=False)

    def camera(context: Context) -> RecordingCamera:
        importlib.import_module("wave")
        return RecordingCamera(context)

    CameraContract().test_constructor_does_no_io(camera)
