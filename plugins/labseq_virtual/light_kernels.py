"""Kernels that compute the mobile tweezers' light from a tone program.

An AOD deflects light by the sound that is inside the beam, so the light follows a tone only as a mean over
the time that the sound takes to cross the beam. The weight of this mean is the beam's intensity,
``exp(-8 (u / transit)^2)``, a normal distribution with a standard deviation of a quarter of the transit time.

A *batch* here is a part of a program in which tweezers are on without a pause. A *track* is a tone that is
followed from segment to segment. The results have a column for each *frame*, a quarter of the transit time.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from labseq.plugin import const, helper_kernel, kernel
from labseq.plugin.motion import FrequencyCourse
from labseq_virtual.formulas import MIN_TONE_DEPTH

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Records = Any
"""An array of records. numpy has no type with the columns."""

FRAMES_PER_TRANSIT: Final = 8
HALF: Final = 6
"""Frames from the middle of the beam to its edge, three standard deviations, where the sound is left out."""
BEAM: Final = np.exp(-0.5 * (np.arange(-HALF, HALF + 1) * 4 / FRAMES_PER_TRANSIT) ** 2)
WEIGHT: Final = BEAM / BEAM.sum()
SAME: Final = 0.25
"""Greatest distance, in sites, at which a tone continues a tone of the last segment (ours, about a waist)."""
MIXING: Final = 0.45
"""Distance of two tones, in sites, below which their tweezers lose their atoms (ours). They beat so slowly
that atoms heat."""
EVEN: Final = 1e-6
"""Bend of a tone's course from frame to frame, in sites, that is neglected."""
NEVER: Final = 1 << 30
"""Frame number of an event that does not happen."""
ON: Final = 1e-6
"""Power relative to the intended one above which a tone is on (ours)."""
PLACE, WAY, DEPTH, CHANGE = range(4)
"""Columns of a track from one frame to the next. Its position in sites (nan where it is off), the
displacement, the factor that it contributes to the depth of its tweezers, and the factor's change."""
CUT, MIXED = range(2)
"""Faults of a track. The last frame before it ended although its tone was on, and the first in which it was
too close to another track. ``NEVER`` without a fault."""
MINIMUM_JERK, CONSTANT_JERK = int(FrequencyCourse.MINIMUM_JERK), int(FrequencyCourse.CONSTANT_JERK)


@helper_kernel()
def is_on(tones: Records, offsets: NDArray[np.int32], k: int, at_end: bool) -> bool:
    """Whether any tone of an axis is on at the start, or at the end, of segment k."""
    for tone in tones[offsets[k] : offsets[k + 1]]:
        if (tone.power_end if at_end else tone.power_start) > ON:
            return True
    return False


@helper_kernel()
def find_batches(
    rows: Records,
    row_offsets: NDArray[np.int32],
    cols: Records,
    col_offsets: NDArray[np.int32],
    n_segments: int,
) -> Ints:
    """The batches among the first segments, as first segment and segment after the last (n_batches, 2).

    They are divided where no tweezer is on, at the end of a segment and at the start of the next.
    """
    batches, n, first, is_lit, was_on = np.empty((n_segments, 2), np.int64), 0, 0, False, False
    for k in range(n_segments):
        starts_on = is_on(rows, row_offsets, k, False) and is_on(cols, col_offsets, k, False)
        ends_on = is_on(rows, row_offsets, k, True) and is_on(cols, col_offsets, k, True)
        if not (was_on or starts_on):
            if is_lit:
                batches[n, 0], batches[n, 1] = first, k
                n += 1
            first, is_lit = k, False
        is_lit, was_on = is_lit or starts_on or ends_on, ends_on
    if is_lit:
        batches[n, 0], batches[n, 1] = first, n_segments
        n += 1
    return batches[:n]


@helper_kernel()
def fraction_done(course: int, u: float) -> float:
    """Fraction of the way after the fraction u of a segment, see :class:`FrequencyCourse`."""
    if course == MINIMUM_JERK:
        return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    if course == CONSTANT_JERK:
        return u**2 * (3.0 - 2.0 * u)
    return u


@helper_kernel()
def track_of(before: Records, tracks: Ints, faults: Ints, k: int, place: float) -> int:
    """The track that a tone at a place continues in segment k, the nearest that no other continues, or -1."""
    best, least = -1, SAME
    for j in range(len(before)):
        away = abs(before[j].end - place)
        if before[j].power_end > ON and away <= least and faults[tracks[j], CUT] == k:
            best, least = tracks[j], away
    return best


@helper_kernel()
def find_mixed(tones: Records, tracks: Ints, k: int, faults: Ints) -> None:
    """Mark the tracks that come too close in segment k. Their distance changes from its start to its end."""
    for i in range(len(tones)):
        for j in range(i):
            before, after = tones[i].start - tones[j].start, tones[i].end - tones[j].end
            near = abs(before) < MIXING or abs(after) < MIXING or before * after < 0.0
            if near and tracks[i] >= 0 and tracks[j] >= 0:
                for track in (tracks[i], tracks[j]):
                    faults[track, MIXED] = min(faults[track, MIXED], k)


@helper_kernel()
def follow_tones(tones: Records, offsets: NDArray[np.int32], first: int, last: int) -> tuple[Ints, Ints]:
    """Follow the tones of the segments from ``first`` to before ``last``.

    Returns:
        Track of each tone, counted from the first of the batch, or -1 for tones that are off (n_tones,),
        and for each track the segments, counted likewise, before which it is cut and in which it is mixed
        (n_tracks, 2).
    """
    begin, n = offsets[first], 0
    low, most = begin, offsets[last] - begin
    tracks, faults = np.full(most, -1), np.full((most, 2), NEVER)
    for k in range(last - first):
        before, tracks_before = (
            tones[low : offsets[first + k]],
            tracks[low - begin : offsets[first + k] - begin],
        )
        low, high = offsets[first + k], offsets[first + k + 1]
        now, tracks_now = tones[low:high], tracks[low - begin : high - begin]
        for i in range(len(now)):
            starts_on, ends_on = now[i].power_start > ON, now[i].power_end > ON
            if starts_on:
                tracks_now[i] = track_of(before, tracks_before, faults, k, now[i].start)
            if tracks_now[i] < 0 and (starts_on or ends_on):
                tracks_now[i] = n
                n += 1
            if tracks_now[i] >= 0:
                faults[tracks_now[i], CUT] = k + 1 if ends_on else NEVER
        find_mixed(now, tracks_now, k, faults)
    return tracks, faults[:n]


@helper_kernel()
def played_tones(
    tones: Records, offsets: NDArray[np.int32], durations_s: Floats, courses: NDArray[np.int8],
    first: int, last: int, tracks: Ints, place: Floats, power: Floats, frame_s: float,
) -> None:  # fmt: skip
    """Fill in positions and powers as played (n_tracks, n_frames + 2 ``HALF``), 0 where off."""
    begin, start = offsets[first], 2.0 * HALF  # in frames
    for k in range(first, last):
        length = durations_s[k] / frame_s
        for i in range(offsets[k], offsets[k + 1]):
            j, tone = tracks[i - begin], tones[i]
            if j < 0:
                continue
            way, rise = tone.end - tone.start, tone.power_end - tone.power_start
            for frame in range(math.ceil(start), min(math.ceil(start + length), place.shape[1])):
                u = (frame - start) / length
                place[j, frame] = tone.start + way * fraction_done(courses[k], u)
                power[j, frame] = tone.power_start + rise * u
        start += length


@helper_kernel()
def smooth(played: Floats, power: Floats, hz: float, place: Floats, depth: Floats) -> None:
    """Compute the light of a track whose sound crosses the beam.

    The position is the mean of the tone's frequency, weighted with its power. The light is the overlap of the
    sound with a tone of the mean frequency and the mean chirp. Where a chirp starts or stops, the phases
    differ by some angle, so the light is fainter by ``exp(-variance)`` of it. This is the second cumulant,
    because there are too few frames to add up the oscillations of a fast chirp.

    Args:
        played: Place as played, in sites, from ``HALF`` frames before to ``HALF`` frames after the others
            (n_frames + 2 ``HALF``,).
        power: Power as played, 0 where off, likewise.
        hz: Turns of the phase in a frame for a difference of one site.
        place: The mean position (n_frames,). Changed in place.
        depth: The light (n_frames,). Changed in place.
    """
    n, volts = len(place), np.sqrt(power)
    for k in range(n):
        total = moment = field = 0.0
        for m in range(2 * HALF + 1):
            weighted = WEIGHT[m] * power[k + m]
            total += weighted
            moment += weighted * played[k + m]
            field += WEIGHT[m] * volts[k + m]
        depth[k] = field**2
        place[k] = moment / total if depth[k] > MIN_TONE_DEPTH else np.nan
    for k in range(1, n - 1):
        chirp = 0.5 * (place[k + 1] - place[k - 1])
        if abs(place[k + 1] - place[k] - chirp) > EVEN:  # never for nan
            depth[k] *= math.exp(-variance(played, power, hz, k + HALF, place[k], chirp))


@helper_kernel()
def variance(played: Floats, power: Floats, hz: float, k: int, mean: float, chirp: float) -> float:
    """Variance of the phase in the beam, relative to a tone at ``mean`` with a ``chirp`` per frame."""
    total = first = second = 0.0
    for direction in (-1, 1):
        angle, before = 0.0, played[k] - mean
        for m in range(HALF + 1):
            at = k + direction * m
            if power[at] == 0.0:
                break
            beside = played[at] - mean - chirp * direction * m
            if m > 0:
                angle += math.pi * hz * direction * (before + beside)  # trapezium rule
            before = beside
            weight = WEIGHT[m + HALF] * (0.5 if m == 0 else 1.0)
            total += weight
            first += weight * angle
            second += weight * angle * angle
    return second / total - (first / total) ** 2 if total > 0.0 else 0.0


@kernel(f"float64[:, :, ::1]({const('float64', 2)}, {const('float64', 2)})")
def course_of(place: Floats, depth: Floats) -> Floats:
    """Tracks from frame to frame, each with ``PLACE``, ``WAY``, ``DEPTH`` and ``CHANGE``.

    Args:
        place: Place of each track in sites, nan where it is off (n_tracks, n_frames).
        depth: Depth factor of each track (n_tracks, n_frames).

    Returns:
        The tracks (n_tracks, n_frames, 4). A track that is off in one of two successive frames has depth 0 in
        this frame, and does not move between the two.
    """
    n_frames = place.shape[1]
    course = np.zeros((len(place), n_frames, 4))
    for j in range(len(place)):
        for k in range(n_frames):
            here, there = place[j, k], place[j, min(k + 1, n_frames - 1)]
            first, last = depth[j, k], depth[j, min(k + 1, n_frames - 1)]
            if math.isnan(here):
                here, first = there, 0.0
            if math.isnan(there):
                there, last = here, 0.0
            course[j, k, PLACE] = here
            if not math.isnan(here):
                course[j, k, WAY], course[j, k, DEPTH], course[j, k, CHANGE] = (
                    there - here,
                    first,
                    last - first,
                )
    return course


@helper_kernel()
def light_of_axis(
    tones: Records, offsets: NDArray[np.int32], durations_s: Floats, courses: NDArray[np.int8],
    first: int, last: int, frame_s: float, step_hz: float,
) -> tuple[Floats, Ints]:  # fmt: skip
    """The light of the tones of an axis in a batch, for the segments from ``first`` to before ``last``.

    It begins ``HALF`` frames before the batch and ends as many after it.

    Args:
        tones: The tones of the axis (n_tones,), see :class:`labseq_virtual.records.Tone`.
        offsets: Start of each segment in ``tones`` (n_segments + 1,).
        durations_s: Durations of the segments.
        courses: Courses of their frequencies.
        first: First segment.
        last: Segment after the last.
        frame_s: Time from frame to frame.
        step_hz: Difference of the frequencies of neighbouring sites.

    Returns:
        The tracks, see :func:`course_of`, and their faults, ``CUT`` and ``MIXED`` (n_tracks, 2).
    """
    tracks, faults = follow_tones(tones, offsets, first, last)
    start = np.full(last - first + 1, HALF)
    start[1:] += np.ceil(np.cumsum(durations_s[first:last]) / frame_s).astype(np.int64)
    shape = len(faults), start[-1] + HALF + 1
    padded = shape[0], shape[1] + 2 * HALF
    played, power = np.zeros(padded), np.zeros(padded)
    played_tones(tones, offsets, durations_s, courses, first, last, tracks, played, power, frame_s)
    place, depth = np.empty(shape), np.empty(shape)
    for j in range(len(played)):
        smooth(played[j], power[j], step_hz * frame_s, place[j], depth[j])
        for fault in (CUT, MIXED):
            if faults[j, fault] < NEVER:
                faults[j, fault] = start[faults[j, fault]] - (fault == CUT)
    return course_of(place, depth), faults
