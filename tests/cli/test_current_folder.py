"""The current folder was deleted while a terminal was in it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from labseq.files import packaged_profiles_dir

LEAVE = """
import os, sys
os.rmdir(os.getcwd())
from labseq.cli import main
sys.argv[0] = "labseq"
main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows deletes no folder that a process is in")
@pytest.mark.parametrize(
    "arguments", [["web", "--port", "0"], ["run", "SEQUENCE", "--dry-run=fast"], ["queue", "list"]]
)
def test_a_current_folder_that_was_deleted_is_named(tmp_path: Path, arguments: list[str]) -> None:
    sequence = packaged_profiles_dir().parent / "sequences" / "compact_225.yaml"
    (tmp_path / "gone").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", LEAVE, *(str(sequence) if a == "SEQUENCE" else a for a in arguments)],
        cwd=tmp_path / "gone",
        capture_output=True,
        text=True,
        check=False,
    )
    assert "internal error" not in done.stderr
    assert (done.returncode, "current folder no longer exists" in done.stderr) == (2, True)
