"""The simulated library, whose functions have SpinAPI's names and arguments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from labseq_pulseblaster.settings import PulseBlasterSettings

from labseq.plugin import Context, Emergency
from labseq_pulseblaster_sim.board import Board, Refused


class SimulatedLibrary:
    """The simulator that replaces the installed SpinAPI.

    Attributes:
        board: The simulated board, for tests.
    """

    def __init__(self, settings: PulseBlasterSettings, context: Context) -> None:
        self.board = Board(settings, context)

    def load(self, name: str) -> Any:
        """The library."""
        del name
        return Spinapi(self.board)

    def emergency(self, board_number: int, clock_mhz: float, flags: int) -> Emergency | None:
        """None, since a simulated board ends with the process."""
        del board_number, clock_mhz, flags


class Spinapi:
    """SpinCore's functions. They return a negative number if they refuse."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._error = "No Error"

    def pb_get_error(self) -> bytes:
        """Why the last call was refused."""
        return self._error.encode()

    def pb_get_version(self) -> bytes:
        """Version of the library."""
        return b"simulated"

    def pb_get_firmware_id(self) -> int:
        """Number of the device and of its revision."""
        return self._run(lambda: self._board.firmware)

    def pb_count_boards(self) -> int:
        """Number of boards."""
        return self._run(lambda: self._board.n_boards)

    def pb_select_board(self, number: int) -> int:
        """Select the board of the next calls."""
        return self._run(lambda: self._board.select(number))

    def pb_init(self) -> int:
        """Open the board."""
        return self._run(self._board.open)

    def pb_close(self) -> int:
        """Close the board, which continues its program."""
        return self._run(self._board.close)

    def pb_core_clock(self, clock_mhz: float) -> None:
        """Tell the library the board's clock."""
        self._board.told_mhz = clock_mhz

    def pb_start_programming(self, device: int) -> int:
        """Begin to write a program."""
        return self._run(lambda: self._board.start_programming(device))

    def pb_inst_pbonly(self, flags: int, code: int, data: int, length_ns: float) -> int:
        """Write an instruction, and return its address."""
        return self._run(lambda: self._board.add(flags, code, data, length_ns))

    def pb_stop_programming(self) -> int:
        """End writing."""
        return self._run(self._board.stop_programming)

    def pb_start(self) -> int:
        """Start the program."""
        return self._run(self._board.start)

    def pb_stop(self) -> int:
        """Stop the program. The next start begins at its first instruction."""
        return self._run(self._board.reset)

    def pb_reset(self) -> int:
        """Stop the program. The next start begins at its first instruction."""
        return self._run(self._board.reset)

    def pb_read_status(self) -> int:
        """The status bits stopped, reset, running, waiting."""
        return self._run(self._board.status)

    def _run(self, call: Callable[[], int | None]) -> int:
        try:
            result = call() or 0
        except Refused as refused:
            self._error = str(refused)
            return -1
        self._error = "No Error"
        return result
