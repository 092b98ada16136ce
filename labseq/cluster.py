"""Workers of a dask cluster, for which the extra `labseq[campaign]` is needed.

Each worker process prepares itself when it gets its first task, and again after it was restarted. Between
machines everything is encrypted, and only machines with a certificate of the cluster take part, because dask
workers carry out any code they are sent.
"""

from __future__ import annotations

import logging
import pickle
import queue
import re
import threading
import time
import uuid
import warnings
from pathlib import Path
from typing import Any, Final, cast

from labseq import __version__
from labseq.errors import ConfigError, LabseqError, Problem
from labseq.messages import clean, error_text, format_error, install_hint
from labseq.processes import is_loopback
from labseq.workers import Do, Make

CA_FILE: Final = "ca.pem"
CLIENT_FILE: Final = "client.pem"

_ADDRESS: Final = re.compile(r"(tls|tcp)://(\[[0-9a-fA-F:.]+\]|[^\s/:\[\]]+):(\d{1,5})")
_ANSWER_S: Final = 10.0
"""Time for the scheduler to answer, in seconds."""
_JOIN_S: Final = 30.0
"""Time for a worker to join a cluster that has none, in seconds."""
_COUNT_S: Final = 2.0
"""Interval at which the workers are counted, in seconds."""


class ClusterWorkers:
    """The workers of a dask cluster. See :class:`labseq.workers.Workers`.

    Args:
        address: Address of its scheduler, as "tls://lab-pc:8786", or "tcp://127.0.0.1:8786" on this computer.
        keys: Folder of the certificates, as `labseq campaign keys` writes it. Only for tls.
        task_name: Name of a task in messages, for example "run".

    Raises:
        ConfigError: The address is not allowed, a certificate is missing, the scheduler does not answer, no
            worker joins, or the extra is not installed.
    """

    def __init__(self, address: str, keys: Path | None, task_name: str) -> None:
        check_address(address)
        self._client = connect(address, keys)
        self._address, self._task_name = address, task_name
        self._run = uuid.uuid4().hex
        self._pack = b""
        self._arguments: dict[int, Any] = {}
        self._futures: dict[int, Any] = {}
        self._done = queue.SimpleQueue[tuple[int, Any]]()
        self._n, self._counted_s, self._seen_s = 0, -_COUNT_S, time.monotonic()
        try:
            self._client.wait_for_workers(1, timeout=_JOIN_S)
        except Exception as error:
            self.close()
            raise _problem(address, f"no worker has joined the cluster within {_JOIN_S:g} s") from error

    @property
    def n_workers(self) -> int:
        """Number of workers now. At least 1, because others may join.

        Raises:
            LabseqError: The scheduler does not answer, or there has been no worker for some time.
        """
        now_s = time.monotonic()
        if now_s - self._counted_s >= _COUNT_S:
            self._counted_s = now_s
            try:
                self._n = len(self._client.nthreads())
            except Exception as error:
                raise LabseqError(f"the scheduler {self._address} is gone: {error_text(error)}") from error
            if self._n:
                self._seen_s = now_s
            elif now_s - self._seen_s > _JOIN_S:
                raise LabseqError(f"the cluster of {self._address} has had no worker for {_JOIN_S:g} s")
        return max(1, self._n)

    def prepare(self, make: Make, recipe: Any) -> None:
        """Keep the recipe for workers that have not been prepared."""
        self._pack = pickle.dumps((make, recipe))

    def submit(self, task: int, argument: Any) -> None:
        """Hand out a task. Earlier tasks come first."""
        self._arguments[task] = argument
        self._send(task, None)

    def _send(self, task: int, pack: bytes | None) -> None:
        arguments = (self._run, __version__, self._arguments[task], pack)
        future = self._client.submit(_carry_out, *arguments, pure=False, priority=-task)
        self._futures[task] = future

        def note(finished_future: Any) -> None:
            self._done.put((task, finished_future))

        future.add_done_callback(note)

    def finished(self, timeout_s: float) -> list[tuple[int, Any]]:
        """See :class:`labseq.workers.Workers`."""
        try:
            task, future = self._done.get(timeout=timeout_s)
        except queue.Empty:
            _ = self.n_workers  # raises if nothing can come any more
            return []
        if self._futures.get(task) is not future:
            return []
        if future.status == "error":
            raise self._error(task, future.exception())
        try:
            answer = future.result(timeout=_ANSWER_S)
        except Exception:  # noqa: BLE001 - its worker or the scheduler is gone, so the task is sent again
            self._send(task, self._pack)
            return []
        if answer is None:
            self._send(task, self._pack)
            return []
        del self._futures[task], self._arguments[task]
        return [(task, answer)]

    def _error(self, task: int, error: BaseException) -> LabseqError:
        if isinstance(error, LabseqError):
            return error
        if type(error).__name__ == "KilledWorker":
            cause = f"{self._task_name} {task} has ended several workers of the cluster"
            return LabseqError(f"{cause}; see their logs, the memory may be used up")
        return LabseqError(f"a worker of the cluster failed, perhaps without labseq: {format_error(error)}")

    def close(self) -> None:
        """Give up all tasks, and leave the cluster."""
        for act in (
            lambda: self._client.cancel(list(self._futures.values()), force=True),
            self._client.close,
        ):
            try:
                act()
            except Exception as error:  # noqa: BLE001 - the scheduler may be gone
                logging.getLogger(__name__).debug("%s", error)


def check_workers(n_workers: int | None, scheduler: str | None) -> None:
    """Check that the work goes to processes here or to a cluster, not both, and check the address.

    Raises:
        ConfigError: It is refused.
    """
    if n_workers is not None and n_workers < 1:
        raise ConfigError(Problem(f"workers is {n_workers}", expected="1 or more"))
    if scheduler is not None:
        check_address(scheduler)
        if n_workers is not None:
            conflict = "the work goes to processes here or to a cluster"
            raise ConfigError(Problem(conflict, expected="either --workers or --scheduler"))


def check_address(address: str) -> None:
    """Refuse text that is not an address, and unencrypted connections to other computers.

    Raises:
        ConfigError: The address is refused.
    """
    match = _ADDRESS.fullmatch(address)
    if match is None:
        raise _problem(address, "this is not the address of a scheduler", "tls://HOST:PORT")
    if match[1] == "tcp" and not is_loopback(match[2].strip("[]")):
        danger = "without encryption, anybody on the network could run code on the workers"
        raise _problem(address, danger, "tls://HOST:PORT", "'labseq campaign keys' makes the certificates")


def _problem(address: str, message: str, expected: str = "", hint: str = "") -> ConfigError:
    return ConfigError(Problem(message, f"--scheduler {clean(address)}", expected=expected, hint=hint))


def connect(address: str, keys: Path | None) -> Any:
    """A client of the scheduler.

    Raises:
        ConfigError: The scheduler does not answer, a certificate is missing, or the extra is not installed.
    """
    try:
        from distributed import Client, Security
    except ModuleNotFoundError as error:
        message = f"the Python package '{error.name}' is not installed"
        raise _problem(address, message, hint=install_hint("campaign")) from error
    security = None
    if address.startswith("tls:"):
        folder = _folder_of(address, keys)
        client, ca = str(folder / CLIENT_FILE), str(folder / CA_FILE)
        security = Security(
            tls_ca_file=ca, tls_client_cert=client, tls_client_key=client, require_encryption=True
        )
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are reported once, by labseq
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about versions of packages that labseq does not use there
            # results come from the workers, by way of the scheduler only where that is not possible
            return Client(
                address,
                security=security,
                timeout=_ANSWER_S,
                set_as_default=False,
                direct_to_workers=True,
            )
    except Exception as error:
        hint = "is it running, with the certificates of the same folder?" if security else "is it running?"
        raise _problem(address, f"no scheduler answers: {error_text(error)}", hint=hint) from error


def _folder_of(address: str, keys: Path | None) -> Path:
    """The folder of the certificates of this computer."""
    hint = "'labseq campaign keys FOLDER' makes them; name their folder with --keys or LABSEQ_CAMPAIGN_KEYS"
    if keys is None:
        raise _problem(address, "a tls address needs certificates", hint=hint)
    for name in (CA_FILE, CLIENT_FILE):
        if not (keys / name).is_file():
            raise _problem(address, f"there is no {name} in {clean(str(keys))}", hint=hint)
    return keys


_lock: Final = threading.Lock()
_prepared: Final[dict[str, Do]] = {}


def _carry_out(run: str, version: str, argument: Any, pack: bytes | None) -> Any:
    """Carry out a task on a worker.

    A worker carries out one task at a time, even if it has several threads.

    Returns:
        The result, or None if the worker is not prepared and was not given the recipe.

    Raises:
        ConfigError: It has another version of labseq.
    """
    if version != __version__:
        raise ConfigError(f"a worker has labseq {__version__}; expected {version}, as on this computer")
    with _lock:
        if run not in _prepared:
            if pack is None:
                return None
            make, recipe = cast("tuple[Make, Any]", pickle.loads(pack))  # noqa: S301 - from the client
            while len(_prepared) >= 4:  # a worker stays prepared for 4 runs
                del _prepared[next(iter(_prepared))]
            _prepared[run] = make(recipe)
        return _prepared[run](argument)
