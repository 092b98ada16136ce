"""Wrong sequences: text that is not strict YAML, wrong keys and wrong steps. Each line is the first message."""

# ruff: noqa: E501 - messages are quoted as they are printed

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.builtin.probes import CheckOverlaySettings, CheckSitesSettings, ProbeSettings
from labseq.builtin.rearrange import RearrangeSettings
from labseq.builtin.steps import DeviceSettings, ImageSettings, LoadSettings, RampSettings, WaitSettings
from labseq.config.sequence import load_sequence
from labseq.errors import ProblemCollector
from labseq.settings import Settings
from tests.config.wrong_files import wrong_files

GOOD = (Path(__file__).parent / "data" / "sequence.yaml").read_text(encoding="utf-8")
MODELS: dict[str, type[Settings]] = {
    "load": LoadSettings,
    "image": ImageSettings,
    "rearrange": RearrangeSettings,
    "probe": ProbeSettings,
    "ramp": RampSettings,
    "check_sites": CheckSitesSettings,
    "check_overlay": CheckOverlaySettings,
    "wait": WaitSettings,
    "device": DeviceSettings,
}
YAML = """
shots: 20 => shots 20
  5:1: this line has no ':'; expected 'key: value'
shots: 20 => shots:20
  5:1: there is no space after the ':' of this line; expected 'key: value'
  - image: { => ⇥- image: {
  16:1: there is a tab here; expected spaces
shots: 20 => shots:⇥20
  5:7: there is a tab here; expected spaces
target: {pattern: compact, rows: 15, cols: 15}⏎ => target: {pattern: compact, rows: 15⏎
  7:9: the '{' that opens here is not closed; expected ',' or '}'
rows: 15, cols => rows: 15 cols
  7:41: the {...} that opens in column 9 has an error here; expected ',' or '}'
- wait: {duration: 1 ms}⏎  - image:⏎ => - wait: {duration: 1 ms⏎
  26:11: the '{' that opens here is not closed; expected ',' or '}'
rows: 15, cols: 15 => rows: 15, rows: 15
  7:38: 'rows' is given twice (first in line 7, column 28); remove one of them
attempts: 2 => shots: 2
  12:1: 'shots' is given twice (first in line 5, column 1); remove one of them
  - image: { =>    - image: {
  16:4: the indentation of this line matches no line above; expected the indentation of the other list items
shots: 20 =>   shots: 20
  5:8: this line is indented further than line 4, which already has a value; expected 0 spaces as in line 4
      cycles =>        cycles
  20:7: the indentation of this line matches no line above; expected 7 spaces as in line 19 or 4 as in line 17
name: compact-225 => name: 'compact-225
  3:7: the quotation mark that opens here is closed only in line 24; expected a quotation mark at the end of the text
name: compact-225 => name: 'compact'-225
  3:16: this does not belong here; expected the end of the line; put text with special characters in single quotes
- image:⏎ => - image: {a: 'b}⏎
  27:16: the quotation mark that opens here is never closed
name: compact-225 => name: compact: 225
  3:14: a ':' is not allowed here; expected one 'key: value' on a line; put text that contains ': ' in quotes
name: compact-225 => name: "C:\\data"
  3:10: in double quotes a backslash begins an escape, and '\\d' is not a complete one; put a path into single quotes, or write '/' or two backslashes for each backslash
name: compact-225 => name: "C:\\Users\\lab"
  3:10: in double quotes a backslash begins an escape, and '\\U' is not a complete one; put a path into single quotes, or write '/' or two backslashes for each backslash
name: compact-225 => name: "C:\\new\\table"
  3:7: in double quotes '\\n' is a control character, not a part of a path; put a path into single quotes, or write '/' or two backslashes for each backslash
name: compact-225 => name: "\\\\server\\new"
  3:7: in double quotes '\\n' is a control character, not a part of a path; put a path into single quotes, or write '/' or two backslashes for each backslash
name: compact-225 => name: @home
  3:7: this is not valid YAML: found character '@' that cannot start any token; put text with special characters in single quotes
name: compact-225 => name: *best*
  3:12: this is not valid YAML: expected alphabetic or numeric character, but found '*'; put text with special characters in single quotes
[plugins, "more plugins"] => &a [*a]
  13:21: '*a' is inside '&a' itself
name: compact-225 => name: !mine x
  3:7: '!mine' is a YAML tag, which is not allowed; expected a plain value; put text that begins with '!' in quotes
name: compact-225 => name: !!python/object/apply:os.system [exit 1]
  3:7: '!!python/object/apply:os.system' is a YAML tag, which is not allowed; expected a plain value; put text that begins with '!' in quotes
name: compact-225 => <<: {name: x}
  3:1: merge keys ('<<') are not allowed; expected every setting written out
name: compact-225 => 225: compact
  3:1: a key is 225; expected text; write '225' in quotes
name: compact-225 => : compact
  3:1: this line does not continue the block above; expected '- ' in a list, 'key: value' otherwise
seed: 7 => - seed: 7
  6:1: this line does not continue the block above; expected '- ' in a list, 'key: value' otherwise
shot:⏎ => ---⏎shot:⏎
  14:1: this is not valid YAML: found another document; put text with special characters in single quotes
shots: 20 => shots: 2\x070
  5:9: an invisible character (U+0007, control character); expected plain text; delete it
shots: 20 => shots: 2\x000
  5:9: a NUL character (U+0000); expected plain text; is this a YAML file, saved as UTF-8?
shots: 20 => shots: 2\u20280
  5:9: an invisible character (U+2028, line separator); expected plain text; delete it
  - image: { => \xa0 - image: {
  16:1: a no-break space (U+00A0) is used for indentation; expected plain spaces
  - image: { =>   -\u3000image: {
  16:4: an ideographic space (U+3000) is used for indentation; expected plain spaces
cols: 15} => cols: 15, origin: 1,2}
  7:58: a key is 2; expected text; a ',' begins another key, so write 4.5 for 4,5 and [4, 5] for a list
name: compact-225 => name: "\\ud800"
  3:7: an escape in this text is half of a character; expected the character itself
name: compact-225 => name: "\\U00110000"
  3:10: this number or escape is out of range
shots: 20 => shots: [[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]
  5:39: lists and mappings are nested more than 32 deep
"""
KEYS = """
shots: 20 => shoots: 20
  5:1: 'shoots' is not a setting of a sequence; expected one of labseq, name, profile, shots, seed, target, planner, record_frames, attempts, policy, alarms, plugin_folders, scan, repeats, order, leader, measure, regions, variables, analysis, shot; did you mean 'shots'?
shots: 20 => shots: 0
  5:8: shots is 0; expected at least 1
shots: 20 => shots: "20"
  5:8: shots is '20'; expected a whole number; write 20 without quotes
shots: 20 => shots: 1_000
  5:8: shots is '1_000'; expected a whole number; did you mean 1000?
shots: 20 => shots: 1.5e0
  5:8: shots is 1.5e0; expected a whole number
shots: 20 => shots:
  5:7: shots is empty; expected a whole number
shots: 20⏎ => ∅
  2:1: 'shots' is missing (how many shots a run takes)
seed: 7 => seed: 9223372036854775808
  6:7: seed is 9223372036854775808; expected less than 9223372036854775808
seed: 7 => seed: 11111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111111
  6:7: a number of 101 characters is too long; expected a number of a few digits
labseq: 1 => labseq: 2
  2:9: this file is for a newer labseq (its format is 2, this labseq reads 1); update labseq
labseq: 1⏎ => ∅
  2:1: 'labseq' is missing (version of the file format: 1)
name: compact-225 => name: 225
  3:7: name is 225; expected text; put it in quotes
name: compact-225 => name: a/b
  3:7: name is 'a/b', with '/' in it; expected letters, digits, spaces, '-', '_' and '.'
name: compact-225 => name: ..
  3:7: name is '..'; expected at least one letter or digit
record_frames: last => record_frames: lst
  11:16: record_frames is 'lst'; expected 'all', 'last' or 'none'; did you mean 'last'?
[plugins, "more plugins"] => plugins
  13:17: plugin_folders is 'plugins'; expected a list ([a, b], or lines that begin with '- ')
[plugins, "more plugins"] => [plugins, 5]
  13:27: plugin_folders.1 is 5; expected text; put it in quotes
target: {pattern: compact, rows: 15, cols: 15} => target: compact
  7:9: there is only 'compact' here; expected a mapping; write '{pattern: compact}'
{pattern: compact => {patern: compact
  7:9: 'pattern' is missing from 'target' (the name of a target pattern); did you write 'patern' for it?
use: psca⏎ => uses: psca⏎
  9:3: 'use' is missing from 'planner' (the name of a plugin); did you write 'uses' for it?
"""
STEPS = """
shot:⏎ => shot: []⏎rest:⏎
  14:7: shot has 0 entries; expected at least 1
shot:⏎ => shot: {}⏎rest:⏎
  14:7: shot is a mapping; expected a list ([a, b], or lines that begin with '- ')
- image: {exposure: 45 ms} => - image
  16:5: a step is just 'image'; expected a mapping; write '- image: {}'
- image: {exposure: 45 ms} => - 5
  16:5: a step is 5; expected a mapping such as 'image: {exposure: 45 ms}'
- image: {exposure: 45 ms} => - name: look
  16:5: this step has no action; expected a mapping such as 'image: {exposure: 45 ms}'
  - image: {exposure: 45 ms} =>     image: {exposure: 45 ms}
  16:5: 'image' is in the same step as 'load'; expected one step in each item of the list; begin a new step with '- ', or indent settings of 'load' further
- image: {exposure: 45 ms} => - image:⏎    exposure: 45 ms
  17:5: 'exposure' is in the same step as 'image'; expected one step in each item of the list; begin a new step with '- ', or indent settings of 'image' further
- image: {exposure: 45 ms} => - image: 45 ms
  16:12: image is '45 ms'; expected a mapping of settings such as {key: value}
image: {exp => image:{exp
  16:22: image:{exposure is '45 ms}'; expected a mapping of settings such as {key: value}; put a space after the ':'
name: sort => name: 2
  17:11: the name of the step is 2; expected a word of letters, digits, '_' and '-' that begins with a letter
- wait: {duration: 1 ms} => - name: sort⏎    wait: {duration: 1 ms}
  26:11: the name 'sort' is taken by step 2 (counted from 0); expected another name
cycles: 3 => cylces: 3
  19:7: 'cylces' is not a setting of 'rearrange'; expected one of cycles, window, exposure, stop_when, window_mode; did you mean 'cycles'?
cycles: 3 => cycles: 101
  19:15: cycles is 101; expected at most 100
cycles: 3 => cycles: 3 ms
  19:15: cycles is '3 ms'; expected a whole number
exposure: 45 ms => exposure: 45 K
  16:23: exposure: '45 K' is a temperature, not a time; expected a time such as '45 ms' (s, ms, us, ns, min, h)
exposure: 45 ms => exposure: 45 msec
  16:23: exposure: 'msec' in '45 msec' is not a unit of time; expected a time such as '45 ms' (s, ms, us, ns, min, h)
exposure: 45 ms => exposure: 0,5 ms
  16:23: exposure is 0; expected more than 0
exposure: 45 ms => exposure: 0 ms
  16:23: exposure is '0 ms'; expected more than 0
exposure: 45 ms => exposure: -45 ms
  16:23: exposure is '-45 ms'; expected more than 0
exposure: 45 ms => exposure: 1e999
  16:23: exposure is 1e999; expected a finite number
- 50 ms => - 50 MHz
  22:11: window.1: '50 MHz' is a frequency, not a time; expected a time such as '45 ms' (s, ms, us, ns, min, h)
        - 50 ms⏎ =>         - 50 ms⏎        - 40 ms⏎
  21:9: the list has 4 entries, but cycles is 3; expected 3, one per cycle
stop_when: 'never' => stop_when: nevr
  24:18: stop_when is 'nevr'; expected 'defect_free' or 'never'; did you mean 'never'?
- image: {exposure: 45 ms} => - ramp: {depth: 150 %}
  16:19: depth is '150 %'; expected at most 1 (in SI units)
- image: {exposure: 45 ms} => - ramp: {duration: 5 ms}
  16:11: 'depth' is missing from 'ramp' (depth at the end, as a fraction of the nominal depth)
delay: 2 => delay: [2]
  25:58: delay is a list; expected text, a whole number, a number or true or false
do: open,  => ∅
  25:13: 'do' is missing from 'device' (command of the device)
wait: {duration: 1 ms} => wait:
  26:10: a wait needs a time or a signal; expected 'duration', or 'for' and 'timeout'
wait: {duration: 1 ms} => wait: {duration: 1 ms, for: go, timeout: 1 s}
  26:12: 'duration' is given with 'for'; expected one of them
wait: {duration: 1 ms} => wait: {for: go}
  26:12: a wait for 'go' has no 'timeout'; expected the longest wait
wait: {duration: 1 ms} => wait: {duration: 1 ms, timeout: 1 s}
  26:28: 'timeout' needs 'for'; expected 'for: go' next to it
"""


def check(folder: Path, text: str) -> list[str]:
    path = folder / "s.yaml"
    path.write_bytes(text.encode())
    found = ProblemCollector()
    with found:
        document, spec, _ = load_sequence(path)
        for step in spec.shot:
            with found:
                document.validate(MODELS[step.kind], step.loc)
    return [str(problem).removeprefix(f"{path}:") for problem in found.problems]


def test_the_right_file_is_right(tmp_path: Path) -> None:
    assert check(tmp_path, GOOD) == []


@pytest.mark.parametrize(("old", "new", "message"), wrong_files(YAML + KEYS[1:] + STEPS[1:]))
def test_the_first_message(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in GOOD
    assert check(tmp_path, GOOD.replace(old, new, 1))[0] == message
