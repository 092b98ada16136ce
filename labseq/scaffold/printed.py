"""The words that commands print, for `labseq explain`, and the environment variables.

A test collects the words from the code that prints them. Those that are keys of files, quantities or kinds of
plugin are explained there.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

STAGES: Final[Mapping[str, str]] = {
    "arm": "making the camera ready for its exposures",
    "expose": "an exposure, from the trigger to its end",
    "read_out": "from the end of an exposure until the frame is in the computer",
    "detect": "finding the atoms on a frame",
    "plan": "planning the moves of a cycle",
    "check": "checking a plan by its rules, before it is played",
    "prepare": "making the tones of a plan, and loading them into the AWG",
    "play": "from the trigger of the moves until they have begun",
    "move": "the moves themselves, with pick-up and drop-off",
    "write": "writing a shot to the disk, between shots",
}
"""Stages of a shot -> what happens in them."""

OUTCOMES: Final[Mapping[str, str]] = {
    "defect-free": "the image that the shot is judged on shows an atom on each site of the target, and none "
    "where there must be none",
    "seen defect-free": "an image after a rearrangement showed the target without a defect; atoms may "
    "be lost after it, before the image that the shot is judged on",
    "defects": "empty sites of the target",
    "seen defects": "defects on a shot's last image, as the detector sees it",
    "true defects": "empty sites of the target at the end of a shot, which only a simulation knows",
    "surplus": "atoms on sites that must be empty",
    "outcome": "how the shot ended: defect-free, or its defects; in brackets after which cycle it was seen "
    "defect-free",
    "filled": "sites of the target that hold an atom after the plan",
    "met": "share of the plans that fill the target and empty what must be empty",
    "target met": "plans that fill the target and empty what must be empty",
    "left out": "batches that did not fit into the window of the cycle and were not played",
    "window": "cycles in which the window was too short for all batches",
    "skipped": "shots that are not taken, and why: a policy, or a point at which a device failed",
    "resumed": "where the run went on, and how it had ended before",
    "ended early": "why the run ended by itself before its last shot, without an error",
    "best shot": "a shot that met the target, else the fullest; of equal ones that with the fewest cycles",
    "best point": "the point of an adaptive scan with the best value so far",
    "suggested": "the maximum or minimum of a parabola through the points near the best one",
    "lost in a shot": "atoms lost, by cause, on average; only a simulation knows them",
    "lost": "atoms that the plan is expected to lose",
    "atoms lost": "atoms that the plans are expected to lose, on average",
    "vacuum": "atoms lost to collisions with the background gas",
    "imaging": "atoms lost during exposures",
    "light": "atoms lost to light outside of exposures",
    "release": "atoms that did not come back into their tweezers after a release",
    "heat": "atoms too hot for their tweezer",
    "hand over": "atoms lost between a static and a mobile tweezer, at pick-up and drop-off",
    "transport": "atoms that a moving tweezer lost on its way",
    "collision": "atoms lost where two met in a tweezer",
    "program": "atoms lost where a mobile tweezer switched off or jumped",
    "atoms": "atoms on the first image, and on the last",
    "atoms moved": "atoms that are moved at least once",
    "ejected": "atoms that the plan drops outside of the grid",
    "first": "the first cycle of a shot",
}
"""How shots, runs and plans end."""

COLUMNS: Final[Mapping[str, str]] = {
    "shot": "number of the shot, from 0",
    "shots": "number of shots that were taken",
    "cycle": "number of the rearrangement cycle, from 0",
    "cycles": "rearrangement cycles that were made",
    "batches": "sets of atom moves that are made at the same time",
    "atom moves": "moves of one atom each: an atom that is moved in two batches counts twice",
    "shot time": "duration of the steps of a shot; on simulated hardware that of the virtual lab",
    "simulated time": "duration of the run in the virtual lab",
    "computer time": "duration of the run on this computer's clock",
    "wall time": "duration of the run on this computer's clock, until the end of the last shot",
    "stage": "part of a shot: " + ", ".join(STAGES),
    "a shot": "how often the stage occurs in a shot, on average",
    "over budget": "number of times that the stage took longer than its budget",
    "share": "share of the shot's time",
    "p50": "median: half of the times are shorter",
    "p99": "99 % of the times are shorter",
    "99 %": "99 % of the times are shorter",
    "host": "median time on this computer's clock",
    "host p50": "median time on this computer's clock",
    "modelled": "time in the virtual lab, or that a model of the device predicts",
    "median": "half of the times are shorter",
    "over": "number of times that the stage took longer than its budget",
    "kept": "number of attempts at a shot that failed and were repeated; their files stay",
    "repeated": "attempts at shots that failed and were repeated",
    "best so far": "the best point of an adaptive scan until now",
    "run": "day and name of the run's folder",
    "started": "when the run began, on this computer's clock",
    "status": "complete, stopped (by a user), failed (by an error) or running",
    "size": "size on the disk",
    "hardware": "real or simulated",
    "warning": "what is allowed and probably not intended, or what went wrong without ending the run",
    "watchdog": "what the process that switches outputs off did",
    "device": "name of the device in the profile",
    "mobile tweezers": "largest number that is on at once, and its limit",
    "safe state": "how long making all devices safe may take",
    "kind": "kind of calibration: sites, thresholds, tweezers, frequencies, overlay, timing",
    "plugin": "name of the plugin: of its file, or of its package",
    "firmware": "version of the device's firmware",
    "latency": "time of a question and its answer",
    "serial number": "serial number that the device tells",
    "origin": "where the plugin comes from: an installed package, or a file",
    "offers": "what the plugin offers, kind:name",
    "state": "of a plugin: loaded, failed or not loaded; of an entry of the queue: waiting, running, "
    "stopped, failed or interrupted",
    "version": "version of the package",
    "id": "number of the entry, or name of the calibration",
    "began": "when the run began, on this computer's clock",
    "scanned": "the scanned value: its first, its last and their number",
    "measured": "what the sequence measures, with its error",
    "note": "what people wrote about the run; tags are in brackets",
    "name": "name of the sequence",
    "changed": "settings changed by --set and other options",
    "tags": "words to find the run by",
    "sequence": "name of the sequence, its hardware profile and its target",
    "begun": "when the run of the entry began",
    "ends": "when the run of the entry will have ended, as far as is known",
    "options": "options that the entry was added with",
    "taken": "when the calibration was measured",
    "age": "time since the calibration was measured",
    "quality": "figures of the measurement: its errors and losses",
    "from": "run or command that the calibration was measured with",
    "value": "the calibrated number",
    "greatest change": "greatest difference between two calibrations, over the sites or tones",
    "rms": "root mean square of the differences between two calibrations",
    "mean": "mean of the differences between two calibrations",
    "figure": "a figure of the quality of a calibration",
    "before": "in the earlier calibration",
    "after": "in the later calibration",
    "where": "the file, and the place in it",
    "what": "what is wrong with the file, or what was repaired",
    "DOP": "degree of parallelism: largest number of mobile tweezers on at once",
    "distance/mm": "sum of the distances that atoms are moved, in mm",
    "motion/ms": "time of all batches, with pick-up and drop-off, in ms",
    "moving/ms": "time in which tweezers move, in ms",
    "scans": "moves along one row or one column, with all of their tweezers",
    "scans/ms": "time of the scans, in ms",
    "planning": "time of planning on this computer",
    "plans": "number of plans",
    "/bound": "batches relative to the number of rows and columns that cover all vacancies",
    "duration": "time of the plan's batches",
    "tweezers": "mobile tweezers on at once",
    "two channels": "what is rendered, for both channels of the AWG",
    "Gsample/s": "samples rendered per second, in thousand millions",
    "playing/rendering": "time of playing the samples over that of rendering them",
    "attempts": "how often a shot is tried",
    "device call": "longest time that a call of a device may take",
    "not opened": "devices that the check has not opened",
    "algorithm": "which algorithm the settings of the planner choose, where its name does not say it",
    "chosen": "what a planner that chooses has chosen for the target",
    "losses": "losses by which planners are compared, and which the profile does not give",
    "better": "the planner `auto` is expected to leave clearly fewer defects than that of the sequence",
    "or": "the next best of each planner, and those that cannot be chosen",
    "measures": "what the run measures, with the model of its fit",
}
"""Heads of columns and names of rows -> their meaning."""

ENVIRONMENT: Final[Mapping[str, str]] = {
    "LABSEQ_DATA": "Folder for the data, if `--output` does not name one. If it is not set: `./data`.",
    "LABSEQ_CAMPAIGN_KEYS": "Folder of the certificates of a cluster, if `--keys` does not name one.",
    "LABSEQ_PLUGIN_PATH": "Folders with plugins, separated as in PATH.",
    "LABSEQ_KEYS": "Folder of the keys of this computer and of the computers that it knows. If it is not "
    "set: `keys` in the user's folder for configurations.",
    "LABSEQ_LOCKS": "Folder of the locks of devices and the markers of runs in progress, for all users of "
    "the computer. If it is not set: `/var/tmp/labseq`, on Windows `labseq` in `%PROGRAMDATA%`.",
    "LABSEQ_STATE": "Folder for the state that labseq keeps between commands. If it is not set: "
    "`$XDG_STATE_HOME/labseq` or `~/.local/state/labseq` on Linux, `~/Library/Application Support/labseq` on "
    "macOS, `%LOCALAPPDATA%/labseq/State` on Windows.",
    "LABSEQ_WEB_TOKEN": "Token that `labseq web` asks for, at least 16 characters. If it is not set: that in "
    "the file `web.token` in the folder for the state.",
    "LABSEQ_CACHE": "Folder for compiled kernels. If it is not set: a folder in the user's cache.",
}
"""Environment variables that labseq reads, and what they set."""
