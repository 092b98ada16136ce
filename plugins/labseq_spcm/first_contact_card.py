"""Steps of the first contact that ask the card about itself, its calls, and who may call it."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from labseq.plugin import DeviceError
from labseq_spcm.first_contact_bench import Bench
from labseq_spcm.limits import REFERENCE_HZ
from labseq_spcm.set_up import close_relays, switch_output, versions

REGISTERS: Final = {
    "card_type": "SPC_PCITYP",
    "memory_bytes": "SPC_PCIMEMSIZE",
    "features": "SPC_PCIFEATURES",
    "extended_features": "SPC_PCIEXTFEATURES",
    "modes": "SPC_AVAILCARDMODES",
    "channels_per_module": "SPC_MIINST_CHPERMODULE",
    "modules": "SPC_MIINST_MODULES",
    "lowest_rate_hz": "SPC_MIINST_MINADCLOCK",
    "highest_rate_hz": "SPC_MIINST_MAXADCLOCK",
    "lowest_amplitude_mv": "SPC_READAOGAINMIN",
    "highest_amplitude_mv": "SPC_READAOGAINMAX",
    "pcie_generation": "SPC_PCIEXPGENERATION",
    "pcie_lanes": "SPC_PCIEXPLANES",
    "pcie_payload_bytes": "SPC_PCIEXPPAYLOAD",
    "pcie_read_request_bytes": "SPC_PCIEXPREADREQUESTSIZE",
    "base_card_c": "SPC_MON_TC_BASE_CTRL",
    "front_end_c": "SPC_MON_TC_MODULE_1",
    "sequence_segments": "SPC_SEQMODE_AVAILMAXSEGMENT",
    "sequence_steps": "SPC_SEQMODE_AVAILMAXSTEPS",
}
"""Key -> register that is read from the card. The result is null if the card does not know it."""
MODES: Final = {
    "replay": "SPC_REP_STD_SINGLE",
    "fifo": "SPC_REP_FIFO_SINGLE",
    "sequence": "SPC_REP_STD_SEQUENCE",
}
DDS: Final = {
    "cores": "SPC_DDS_NUM_CORES",
    "cores_on_output_0": "SPC_DDS_CORES_ON_CH0",
    "cores_on_output_1": "SPC_DDS_CORES_ON_CH1",
    "queue_commands": "SPC_DDS_QUEUE_CMD_MAX",
}
DDS_REAL: Final = {
    "frequency_step_hz": "SPC_DDS_AVAIL_FREQ_STEP",
    "frequency_slope_step_hz_per_s": "SPC_DDS_AVAIL_FREQ_SLOPE_STEP",
    "frequency_slope_highest_hz_per_s": "SPC_DDS_AVAIL_FREQ_SLOPE_MAX",
    "amplitude_slope_step_per_s": "SPC_DDS_AVAIL_AMP_SLOPE_STEP",
    "amplitude_slope_highest_per_s": "SPC_DDS_AVAIL_AMP_SLOPE_MAX",
    "phase_step_deg": "SPC_DDS_AVAIL_PHASE_STEP",
}
RATES_HZ: Final = (500e6, 600e6, 620e6, 624e6, 625e6, 640e6, 1000e6, 1250e6)
"""Rates that are tried with an external reference. The profiles use 624 and 625 MHz."""

UNITS: Final = {
    **dict.fromkeys(("card_type", "features", "extended_features", "modes"), ("bits",)),
    "rates": ("hz", "hz", "s"),
}
"""Units that the names of the results leave out."""

N_READS: Final = 5000
"""Reads of the status in each of two threads."""


def identity(bench: Bench) -> dict[str, Any]:
    """Read what the card is and can do, and how warm it is."""
    spcm = bench.card.spcm
    facts: dict[str, Any] = {key: bench.read_if_known(getattr(spcm, name)) for key, name in REGISTERS.items()}
    facts["driver_modes"] = [
        key for key, name in MODES.items() if (facts["modes"] or 0) & getattr(spcm, name)
    ]
    facts["has_dds"] = bool((facts["extended_features"] or 0) & spcm.SPCM_FEAT_EXTFW_DDS20)
    facts["is_remote"] = bool((facts["features"] or 0) & spcm.SPCM_FEAT_NETBOX)
    facts["versions"] = {name: found for name, (found, _) in versions(bench.card).items()}
    facts["rate_read_back_hz"] = bench.fresh().read(spcm.SPC_SAMPLERATE)
    return facts


def times(bench: Bench) -> dict[str, Any]:
    """Time the driver's calls. The relays close once, at the lowest amplitude and without a tone.

    Returns:
        Seconds per call.
    """
    card, spcm = bench.card, bench.card.spcm
    reset_s = bench.timed(lambda: card.command(spcm.M2CMD_CARD_RESET, "reset"))
    set_up_s = bench.timed(bench.fresh)
    small, large = bench.silence(1 << 16), bench.silence(1 << 24)
    card.set(spcm.SPC_MEMSIZE, len(large), "memory size")
    small_s, large_s = (min(_pinned_s(bench, frames) for _ in range(5)) for frames in (small, large))
    card.set(spcm.SPC_LOOPS, 0, "loops")
    upload_s = bench.timed(lambda: card.upload(large, poll_s=20e-6))
    write_setup_s = bench.timed(card.write_setup)
    play = spcm.M2CMD_CARD_START | spcm.M2CMD_CARD_ENABLETRIGGER | spcm.M2CMD_CARD_FORCETRIGGER
    start_s = bench.timed(lambda: card.command(play, "start"))
    read_s = bench.timed(lambda: [card.status for _ in range(1000)]) / 1000
    stop_s = bench.timed(card.stop)
    close_s = bench.timed(lambda: close_relays(card))
    open_s = bench.timed(lambda: _open_relays(bench))
    return {
        "reset_s": reset_s,
        "set_up_s": set_up_s,
        "write_setup_s": write_setup_s,
        "start_s": start_s,
        "stop_s": stop_s,
        "relays_close_s": close_s,
        "relays_open_s": open_s,
        "register_read_s": read_s,
        "naming_64_kib_s": small_s,
        "naming_16_mib_s": large_s,
        "upload_16_mib_s": upload_s,
    }


def _pinned_s(bench: Bench, frames: Any) -> float:
    took_s = bench.timed(lambda: bench.card.define_transfer(frames))
    bench.card.stop()
    return took_s


def _open_relays(bench: Bench) -> None:
    for output in bench.card.outputs:
        switch_output(bench.card, output, on=False)
    bench.card.write_setup()


def threads(bench: Bench) -> dict[str, Any]:
    """Call the library from two threads, with an error in one, then reads in both at once.

    Returns:
        Whether an error in one thread makes calls of the other fail, and how many of the reads failed.
    """
    card, spcm, handle = bench.fresh(), bench.card.spcm, ctypes.c_void_p(bench.card.handle)

    def in_another_thread(call: Callable[[], object]) -> threading.Thread:
        thread = threading.Thread(target=call, daemon=True)
        thread.start()
        return thread

    in_another_thread(lambda: spcm.spcm_dwSetParam_i64(handle, spcm.SPC_AMP0, -1)).join(5.0)
    value = ctypes.c_int64()
    code = spcm.spcm_dwGetParam_i64(handle, spcm.SPC_M2STATUS, ctypes.byref(value))
    card.clear_error()
    failures = list[str]()

    def read() -> None:
        for _ in range(N_READS):
            try:
                _ = card.status
            except DeviceError as error:
                failures.append(error.message)

    other = in_another_thread(read)
    read()
    other.join(5.0)
    if other.is_alive():
        raise DeviceError(bench.name, f"a thread that reads the status {N_READS} times hangs")
    return {"error_is_shared": bool(code), "reads": 2 * N_READS, "failed_reads": len(failures)}


def reference(bench: Bench) -> dict[str, Any]:
    """Make several rates from the external 10 MHz reference.

    Returns:
        Triples of the rate that was asked for, the rate that the card made or 0 if it refused, both in Hz,
        and how long its clock took, in seconds.
    """
    card, spcm = bench.fresh(), bench.card.spcm
    card.set(spcm.SPC_CLOCKMODE, spcm.SPC_CM_EXTREFCLOCK, "clock mode")
    card.set(spcm.SPC_REFERENCECLOCK, round(REFERENCE_HZ[0]), "reference clock in Hz")
    highest_hz = card.read(spcm.SPC_MIINST_MAXADCLOCK)
    rates_hz = sorted({*RATES_HZ, bench.settings.sample_rate})
    made = [_made_from_reference(bench, round(hz)) for hz in rates_hz if hz <= highest_hz]
    return {"rates": made, "locks": any(actual_hz for _, actual_hz, _ in made)}


def _made_from_reference(bench: Bench, rate_hz: int) -> tuple[int, int, float]:
    card, spcm = bench.card, bench.card.spcm
    start_s = bench.now()
    try:
        card.write(spcm.SPC_SAMPLERATE, rate_hz, "sample rate in Hz")
        card.write_setup()
        return rate_hz, card.read(spcm.SPC_SAMPLERATE), bench.now() - start_s
    except DeviceError:
        return rate_hz, 0, bench.now() - start_s


def dds(bench: Bench) -> dict[str, Any]:
    """Read what the option DDS offers. Nothing is played with it, because labseq does not use it."""
    card, spcm = bench.fresh(), bench.card.spcm
    if not (bench.read_if_known(spcm.SPC_PCIEXTFEATURES) or 0) & spcm.SPCM_FEAT_EXTFW_DDS20:
        return {"skipped": "the card has no licence of the option DDS, which labseq does not need"}
    card.set(spcm.SPC_CARDMODE, spcm.SPC_REP_STD_DDS, "card mode")
    card.write_setup()
    facts: dict[str, Any] = {key: bench.read_if_known(getattr(spcm, name)) for key, name in DDS.items()}
    return facts | {key: bench.read_real_if_known(getattr(spcm, name)) for key, name in DDS_REAL.items()}


SCRIPT: Final = Path(__file__).with_name("first_contact_child.py")
RUN: Final = "import json, runpy, sys; runpy.run_path(sys.argv[1])[sys.argv[2]](**json.loads(sys.argv[3]))"
"""Runs a function of a script with arguments from JSON, in a process that imports nothing of labseq."""
ALONE_S: Final = 0.5
"""How long the card is left alone after its process was killed."""


def second_process(bench: Bench, *, with_tone: bool = False) -> dict[str, Any]:
    """Kill a process that plays, and switch the card off from another one.

    Args:
        with_tone: Leave the memory as it is, and close the relays, so that an oscilloscope shows the tone.

    Returns:
        Whether the card ran on after its process had died, how long it could not be opened again, what the
        emergency script did and how long it took, in seconds.
    """
    playing, emergency = bench.emergency(SCRIPT), bench.emergency(SCRIPT.with_name("emergency.py"))
    if playing is None or emergency is None:
        return {"skipped": "the simulated card lives in this process and dies with it"}
    found = {key: value for key, value in playing.arguments.items() if key != "n_outputs"}
    arguments = {**found, "rate_hz": round(bench.settings.sample_rate), "relays": with_tone}
    with bench.lent(), _running(bench, playing.script, "play", arguments) as child:
        bench.pause(ALONE_S if with_tone else 0.05)
        child.kill()
        child.wait(10.0)
    killed_s = bench.now()
    opened_s = bench.timed(bench.open_again)
    runs_on, relays = bench.card.running, bench.read_if_known(bench.card.spcm.SPC_ENABLEOUT0)
    with bench.lent():
        bench.pause(max(0.0, ALONE_S - (bench.now() - killed_s)))
        off_s = bench.timed(lambda: _call(bench, emergency.script, "off", dict(emergency.arguments)))
    bench.open_again()
    return {
        "runs_on_after_kill": runs_on,
        "relays_after_kill": relays,
        "opened_again_after_s": opened_s,
        "off_by_another_process_s": off_s,
        "runs_after_off": bench.card.running,
    }


@contextmanager
def _running(
    bench: Bench, script: Path, function: str, arguments: Mapping[str, Any]
) -> Generator[subprocess.Popen[str]]:
    """A process that runs a function until it is killed, and that has said that it plays."""
    command = [sys.executable, "-c", RUN, str(script), function, json.dumps(arguments)]
    pipe = subprocess.PIPE
    options: Any = {"stdin": pipe, "stdout": pipe, "stderr": subprocess.STDOUT, "text": True}
    with subprocess.Popen(command, **options) as child:  # noqa: S603 - our own script
        try:
            line = "" if child.stdout is None else child.stdout.readline()
            if line.strip() != "playing":
                rest = "" if child.stdout is None else child.stdout.read()
                reason = ([*(line + rest).strip().splitlines(), "it said nothing"])[-1]
                raise DeviceError(bench.name, f"a second process cannot play on the card: {reason}")
            yield child
        finally:
            child.kill()


def _call(bench: Bench, script: Path, function: str, arguments: Mapping[str, Any]) -> None:
    """Run a function of a script in a process of its own.

    Raises:
        DeviceError: It failed, with the last line of its message.
    """
    command = [sys.executable, "-c", RUN, str(script), function, json.dumps(arguments)]
    options: Any = {"capture_output": True, "text": True, "timeout": 20.0}
    ended = subprocess.run(command, check=False, **options)  # noqa: S603 - our own script
    if ended.returncode:
        reason = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1]
        raise DeviceError(bench.name, f"another process could not switch the card off: {reason}")
