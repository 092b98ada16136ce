"""Notices to people who are not in the lab, as set up in ``notify.yaml`` in the data folder.

Each notice is sent by a separate process, so that neither a slow network nor a program that hangs delays a
shot, and so that it is sent even if this process ends meanwhile.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, StringConstraints, field_validator

from labseq.config.document import Document
from labseq.files import data_root, free_bytes
from labseq.messages import visible
from labseq.plain import dumps
from labseq.recording.folders import NOTIFY_FILE
from labseq.settings import Settings
from labseq.units import size_text

NOTIFY_LOG: Final = "notify.log"
"""Notices that could not be sent."""
LOOK_S: Final = 60.0
"""Time between two looks at the free space of the disk, in seconds."""

FREE_GB: Final = 5.0
"""A disk with fewer GB free is nearly full, unless ``notify.yaml`` says otherwise."""

NoticeKind = Literal["failed", "alarm", "disk", "queue"]


class NoticeSettings(Settings):
    """The file ``notify.yaml``."""

    labseq: Literal[1]
    command: tuple[str, ...] = Field(
        default=(), description="a program and its arguments, to which the text of the notice is added"
    )
    webhook: Annotated[str, StringConstraints(pattern=r"^(https?://\S+)?$")] = Field(
        default="", description="an address that receives each notice as JSON by POST"
    )
    on: tuple[NoticeKind, ...] = Field(
        default=("failed", "alarm", "disk", "queue"),
        description="a run has failed, an alarm has begun, the disk is nearly full, the queue has ended",
    )
    free_gb: float = Field(
        default=FREE_GB, gt=0, description="free GB below which 'disk' is sent and the page gives an alarm"
    )

    @field_validator("webhook")
    @classmethod
    def _is_address(cls, webhook: str) -> str:
        urlsplit(webhook).port  # raises ValueError if the host or the port cannot be read  # noqa: B018
        return webhook

    @classmethod
    def read(cls, root: Path) -> Self | None:
        """The settings in a data folder. None without a file.

        Raises:
            ConfigError: The file has an error.
        """
        path = root / NOTIFY_FILE
        return Document.read(path).validate(cls) if path.is_file() else None

    def task(self, kind: str, run: str, text: str) -> dict[str, Any]:
        """The task for :func:`labseq.session.send_notice.send`."""
        notice = {"kind": kind, "run": run, "text": f"labseq: {f'{run}: ' if run else ''}{text}"}
        return {"command": self.command, "webhook": self.webhook, "notice": notice}


class Notices:
    """Implements ``RunObserver``. Sends a notice of each event that the settings ask for.

    Args:
        settings: Receivers and events. None to send nothing.
        root: The data folder.

    Attributes:
        settings: The same.
    """

    def __init__(self, settings: NoticeSettings | None, root: Path) -> None:
        self.settings = settings
        self._root = root
        self._run_dir = Path()
        self._next_look_s = 0.0

    @classmethod
    def read(cls) -> Self:
        """Notices as set up by the file in the data folder. Without a file, nothing is sent.

        Raises:
            ConfigError: The file has an error.
        """
        root = data_root().absolute()
        return cls(NoticeSettings.read(root), root)

    def event(self, name: str, values: Mapping[str, Any]) -> None:
        """Send a notice if the settings ask for this event."""
        if self.settings is None:
            return
        match name:
            case "run_starting":
                self._run_dir = Path(values["run_dir"])
            case "warning" if "alarm" in values:
                self.send("alarm", values["text"])
            case "run_finished" if values["status"] == "failed":
                self.send("failed", values["error"])
            case "shot_finished":
                self._look_at_disk(self.settings.free_gb)
            case _:
                pass

    def _look_at_disk(self, free_gb: float) -> None:
        if time.monotonic() < self._next_look_s:
            return
        self._next_look_s = time.monotonic() + LOOK_S
        free = free_bytes(self._run_dir)
        if free < free_gb * 1e9:
            self._next_look_s = float("inf")  # once in a run
            self.send("disk", f"only {size_text(free)} are free on the disk of {visible(str(self._run_dir))}")

    def send(self, kind: NoticeKind, text: str) -> None:
        """Send a notice, if its kind is wanted."""
        settings = self.settings
        if settings is None or kind not in settings.on:
            return
        deliver(self._root, settings.task(kind, self._run_dir.name, text))


def deliver(root: Path, task: Mapping[str, Any]) -> None:
    """Start the process that sends a notice, without waiting for it."""
    process = subprocess.Popen(
        [sys.executable, "-m", "labseq.session.send_notice"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C ends the run, not the notice of it
    )
    assert process.stdin is not None
    with process.stdin as pipe:
        pipe.write(dumps({**task, "log": str(root / NOTIFY_LOG)}).encode())
    process.returncode = 0  # Python would warn that it was not waited for
