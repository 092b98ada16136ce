"""Static tweezers on a software-defined radio."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from labseq_soapy_stream.messages import REF_LOCKED, Facts, Setup, unlocked

from labseq.plugin import (
    Context,
    DeviceError,
    Emergency,
    LimitError,
    StaticTweezers,
    TransientError,
    TweezersFacts,
)
from labseq.plugin.tweezers import Amplitudes, calibrated_amplitudes, check_ramp
from labseq_soapy.access import choose_radio, end_stale_process, marker_of
from labseq_soapy.link import Link
from labseq_soapy.settings import SoapySettings
from labseq_soapy.tones import ArrayTones

SHORTEST_RELEASE_S: Final = 1e-6
"""Shortest release. An AOD cannot switch light faster, since sound crosses a beam of 4 mm in 6 us."""
LATENCY_S: Final = 30e-3
"""Time from the call of a ramp or release to its start at the connectors, due to the radio's buffer.

Measured 26 to 34 ms with the simulated radio, which buffers 20 ms. A real radio tells it once open.
"""
MINUTE_S: Final = 60.0
DISTURBANCES: Final = {
    "underflows": "ran out of samples",
    "sequence_errors": "missed packets",
    "late_packets": "missed packets",
}
"""Error that the radio reports -> its description."""
APART: Final = "its start was late or not timed, so rows and columns may be some microseconds apart"
NO_REAL_TIME: Final = (
    "the streaming process has no real-time priority ({}), so on a busy computer the radio may run out of "
    "samples; under Linux add '@GROUP - rtprio 99' with your group to /etc/security/limits.conf, log in again"
)


class SoapyStaticTweezers(StaticTweezers):
    """Plays a loop of tones for each AOD on two outputs of a radio.

    A separate process streams samples to the radio. It ramps the light down if labseq is killed or hangs.
    The depth of a tweezer is proportional to the product of the powers
    of its two tones, so both amplitudes scale with the fourth root of the depth.

    Calls that need the light raise ``DeviceError`` if the stream is dead, and once ``TransientError`` if the
    radio ran out of samples, or missed packets, while the array was on.

    Args:
        settings: The radio, and how it is used.
        context: Name, grid, clock, simulation, calibrated amplitudes.

    Attributes:
        radio: Access of the streaming process to the radio.

    Raises:
        LimitError: The tones span more than 80 % of the sample rate, or no loop holds them all.
    """

    def __init__(self, settings: SoapySettings, context: Context) -> None:
        self._name = context.name or "static_tweezers"
        self._settings = settings
        self._clock = context.clock
        self._tones = ArrayTones(self._name, settings, context.grid.shape)
        self._calibrated = calibrated_amplitudes(context)
        self._amplitudes: Amplitudes | None = None
        self._depth: float | None = 0.0  # None after an interrupted ramp
        self._seen: Mapping[str, int] = {}  # errors while the array was on
        self._recent: deque[tuple[float, int]] = deque()  # when the radio reported how many errors
        self._link: Link | None = None
        self._facts: Facts | None = None
        self._is_loaded = False
        self.radio = choose_radio(settings, context)

    @property
    def facts(self) -> TweezersFacts:
        """Ramps and releases are timed by the radio's sample clock."""
        return TweezersFacts(1 / self._settings.sample_rate, SHORTEST_RELEASE_S, LATENCY_S)

    def open(self) -> None:
        """Open the radio and stream silence. No effect if it is open.

        Raises:
            DeviceError: No library, no such radio, another program uses it, or it refuses a setting.
            LimitError: The calibrated amplitudes are too much.
        """
        if self._link is not None:
            return
        try:
            self._link = self._connect()
            self._facts = self._link.wait_open()
            self._tones.tune(self._facts)
            self.radio.started(self._tones.tones_hz)
        except BaseException:
            with suppress(DeviceError):  # the first error is reported
                self._disconnect()
            raise

    def close(self) -> None:
        """Ramp down and close the radio. Legal in any state.

        Raises:
            DeviceError: Its transmitters may still be on.
        """
        self._disconnect()

    def load(self, amplitudes: Amplitudes | None) -> None:
        """Set the tone amplitudes of the rows (n_rows,) and columns (n_cols,), None for the calibrated ones.

        While the array is on they are faded in.

        Raises:
            LimitError: Wrong number of tones, negative or not finite, or too much together.
        """
        self._checked()
        self._load(amplitudes)

    def start(self) -> None:
        """Ramp the array to its nominal depth. No effect if it is there."""
        self._checked()
        if not self._is_loaded:
            self._load(self._amplitudes)
        if self._depth != 1.0:
            self._ramp(1.0, self._settings.switch)

    def ramp(self, depth: float, duration_s: float) -> None:
        """Change the depth linearly, and return when the ramp has ended at the connectors.

        Raises:
            LimitError: A depth or duration that the array cannot have.
        """
        self._checked()
        check_ramp(self._name, depth, duration_s, self._settings.max_depth)
        if not self._is_loaded:
            self._load(self._amplitudes)
        self._ramp(depth, duration_s)

    def release(self, duration_s: float) -> float:
        """Play silence, then the tones again, and return when they are at the connectors.

        The streaming process does both for one command. A ramp that comes meanwhile starts from the dark.

        Raises:
            LimitError: A duration that is too short, or not finite.
        """
        self._checked()
        if not SHORTEST_RELEASE_S <= duration_s < math.inf:
            limit = f"{SHORTEST_RELEASE_S:g} s or more"
            raise LimitError(f"{self._name}: duration of the release", f"{duration_s:g} s", limit)
        link, rate_hz = self._opened(), self._settings.sample_rate
        n_samples = round(duration_s * rate_hz)
        depth, self._depth = self._depth, None
        link.release(n_samples)
        self._depth = depth
        if self._clock.virtual:
            self._clock.sleep(duration_s)
        self.radio.released()
        return n_samples / rate_hz

    def safe_state(self) -> None:
        """Ramp the array down. If the stream is dead, switch the radio's transmitters off.

        Raises:
            DeviceError: The process hung and was killed, and the transmitters were switched off or may still
                be on.
        """
        link = self._link
        if link is None or self._depth == 0.0:
            return
        try:
            self._ramp(0.0, self._settings.switch)
        except DeviceError:
            if link.hangs:
                self._disconnect()
                raise
            link.switch_off()
            self._depth = 0.0

    @property
    def idle_output(self) -> str:
        """The array, if it stays on."""
        return "the array stays on after the run" if self._settings.after_run == "on" else ""

    def leave_on(self) -> bool:
        """Have the streaming process go on without labseq, at the present depth, if ``after_run`` is on."""
        link = self._link
        if (
            self._settings.after_run == "off"
            or link is None
            or not self._depth
            or not self.radio.outlives_run
        ):
            return False
        self._checked()
        link.leave()
        self._link = None
        self._disconnect()
        return True

    def emergency(self) -> Emergency | None:
        """A script that ends the streaming process, which closes the radio. None if it is not open."""
        if self._link is None:
            return None
        return Emergency(Path(__file__).with_name("emergency.py"), self._link.emergency_arguments())

    def check_interlocks(self) -> None:
        """Check that the stream is alive, at the start of each shot and before each pick-up."""
        self._checked()

    def self_test(self) -> None:
        """Check that the stream runs, the radio is locked, and the calibrated amplitudes are possible.

        The light stays off.
        """
        self._checked()
        self._check_locks()
        try:
            self._tones.samples(self._calibrated)
        except LimitError as error:
            raise DeviceError(self._name, f"it cannot play the calibrated amplitudes: {error}") from error

    def _check_locks(self) -> None:
        locks, source = {} if self._facts is None else self._facts.locks, self._settings.clock_source
        if not (found := unlocked(locks, source)):
            return
        hint = "can it tune to `local_oscillator`?"
        if REF_LOCKED in found:
            hint = f"is the reference of `clock_source: {source}` connected, and of the right frequency?"
        raise DeviceError(self._name, f"the radio is not locked ({', '.join(found)}); {hint}")

    def versions(self) -> Mapping[str, tuple[str, str]]:
        """Versions that SoapySDR and the radio's module report. No real radio was tried."""
        radio = {} if self._facts is None else self._facts.radio
        found = {name: (value, "") for name, value in radio.items() if "version" in name}
        return found | ({"SoapySDR": (radio["SoapySDR"], "0.8.1-3")} if "SoapySDR" in radio else {})

    def describe(self) -> Mapping[str, Any]:
        """Settings, depth, amplitudes, and once opened also the radio, the loop and underflows."""
        given = self._amplitudes
        amplitudes = (
            "calibrated" if given is None else {"row": given[0].tolist(), "column": given[1].tolist()}
        )
        settings = {**self._settings.model_dump(mode="json"), "local_oscillator": self._tones.oscillator_hz}
        common = {"model": "SoapySDR", **settings, "depth": self._depth, "amplitudes": amplitudes}
        if self._facts is None or self._link is None:
            return common
        return {
            **common,
            **asdict(self._facts),
            "model": f"SoapySDR {self._facts.radio['hardware']}",
            "serial_number": self._facts.radio.get("serial", ""),
            "loop_samples": self._tones.loops[0].n_samples,
            "crest_factor": list(self._tones.crest_factor),
            "notes": self._notes(self._facts),
            **self.poll(),
        }

    def poll(self) -> Mapping[str, int]:
        """How often the radio has reported each error since it was opened, recorded with each shot."""
        counts = {} if self._link is None else self._link.status["all"]
        return {key: counts.get(key, 0) for key in DISTURBANCES}

    def _notes(self, facts: Facts) -> list[str]:
        notes = [] if facts.starts_together else [APART]
        return notes + ([NO_REAL_TIME.format(facts.no_real_time)] if facts.no_real_time else [])

    def _connect(self) -> Link:
        settings = self._settings
        marker = marker_of(settings.device)
        end_stale_process(self._name, marker, self._clock)
        device, program, folder = self.radio.connect()
        setup = Setup(
            device=device,
            stream=settings.stream,
            channels=(settings.row_channel, settings.column_channel),
            rate_hz=settings.sample_rate,
            oscillator_hz=self._tones.oscillator_hz,
            lo_offset_hz=settings.lo_offset,
            bandwidth_hz=settings.bandwidth,
            gain_db=(settings.row_gain, settings.column_gain),
            antenna=settings.antenna,
            clock_source=settings.clock_source,
            ramp_s=settings.switch,
            max_wait_s=settings.patience,
            marker=str(marker),
        )
        options = [] if settings.is_simulated else ["--real-time"]
        return Link(self._name, self._clock, setup, folder / f"{marker.stem}.log", program, options)

    def _load(self, amplitudes: Amplitudes | None) -> None:
        loop = self._tones.samples(self._calibrated if amplitudes is None else amplitudes)
        self._amplitudes, self._is_loaded = amplitudes, True
        self._opened().load(loop, self._settings.fade)
        if self._depth != 0.0 and self._clock.virtual:
            self._clock.sleep(self._settings.fade)
        self.radio.changed()

    def _ramp(self, depth: float, duration_s: float) -> None:
        link, self._depth = self._opened(), None
        link.ramp(depth, duration_s)
        self._depth = depth
        if self._clock.virtual:
            self._clock.sleep(duration_s)
        self.radio.changed()

    def _opened(self) -> Link:
        if self._link is None:
            raise DeviceError(self._name, "not open; call open() first")
        return self._link

    def _checked(self) -> Link:
        """The link, if its stream is alive, and undisturbed while the array was on since the last call."""
        link = self._opened()
        link.check()
        counts = link.status["lit"]
        new, self._seen = Counter(counts) - Counter(self._seen), counts
        if not new:
            return link
        did: Counter[str] = Counter()
        for key, count in new.items():
            did[DISTURBANCES[key]] += count
        text = " and ".join(f"{what} {count} time(s)" for what, count in did.items())
        text = f"the radio {text} while the array was on"
        limit, n_recent = self._settings.max_disturbances, self._n_recent(new.total())
        if n_recent > limit:
            text = f"{text}, and had {n_recent} disturbances within a minute"
            raise DeviceError(self._name, f"{text}; max_disturbances allows {limit}")
        raise TransientError(f"{text}, so atoms may be lost", self._name)

    def _n_recent(self, n_new: int) -> int:
        """Errors within the last minute, with new ones."""
        now_s = self._clock.now()
        self._recent.append((now_s, n_new))
        while self._recent[0][0] < now_s - MINUTE_S:
            self._recent.popleft()
        return sum(count for _, count in self._recent)

    def _disconnect(self) -> None:
        link, self._link, self._facts = self._link, None, None
        self._depth, self._seen, self._is_loaded, self._amplitudes = 0.0, {}, False, None
        self._recent.clear()
        try:
            if link is not None:
                link.close()
        finally:
            self.radio.disconnect()
