"""Text files that are missing, too large, not UTF-8 or no files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from labseq.config.document import Document
from labseq.errors import ConfigError
from labseq.text_files import MAX_BYTES

SAVE = "expected a file in UTF-8; save the file as UTF-8"


def message_of(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        Document.read(path)
    return str(caught.value)


def message_on(data: bytes) -> str:
    with pytest.raises(ConfigError) as caught:
        Document.parse(data, "f.yaml")
    return str(caught.value)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_missing_file_names_the_one_that_was_meant() -> None:
    Path("compact_225.yaml").touch()
    Path("compact_224.txt").touch()
    message = message_of(Path("compact_22.yaml"))
    assert message.startswith("compact_22.yaml: ")
    assert "'compact_225.yaml'" in message


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")
def test_pipe_is_not_waited_for() -> None:
    os.mkfifo("f.yaml")
    assert "not an ordinary file" in message_of(Path("f.yaml"))


def test_unreadable_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object) -> None:
        raise PermissionError(13, "Permission denied")

    Path("f.yaml").touch()
    monkeypatch.setattr(Path, "open", refuse)
    assert message_of(Path("f.yaml")).endswith("permission denied")


def test_size_limit() -> None:
    head = b"a: b\n#"
    Path("f.yaml").write_bytes(head + b" " * (MAX_BYTES - len(head)))
    assert Document.read(Path("f.yaml")).data == {"a": "b"}
    with Path("f.yaml").open("ab") as file:
        file.write(b" ")
    assert "larger than 256 KiB" in message_of(Path("f.yaml"))


def test_path_is_kept_as_given() -> None:
    path = Path("sub") / ".." / "f.yaml"
    Path("sub").mkdir()
    Path("f.yaml").write_text("a: [", encoding="utf-8")
    assert message_of(path).startswith(f"{path}:1:4: the '[' that opens here is not closed")
    Path("f.yaml").write_text("a: b", encoding="utf-8")
    assert Document.read(path).path == path


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "f.yaml: the file is empty; expected a mapping that begins with 'labseq: 1'"),
        (b"\xef\xbb\xbf", "f.yaml: the file is empty; expected a mapping that begins with 'labseq: 1'"),
        (
            b"\n- 1",
            "f.yaml:2:1: the top level is a list; expected a mapping that begins with 'labseq: 1'",
        ),
        (
            b"hello",
            "f.yaml:1:1: the top level is 'hello'; expected a mapping that begins with 'labseq: 1'",
        ),
        (
            b"a: b\nspacing: 4.49 \xb5m\n",
            f"f.yaml:2:15: byte 0xB5 at offset 19 is not UTF-8 (in Latin-1 it is '\xb5'); {SAVE}",
        ),
        (b"\xef\xbb\xbfa: \x80", f"f.yaml:1:4: byte 0x80 at offset 6 is not UTF-8; {SAVE}"),
        (
            "\xb5: b\r\nc: ".encode() + b"\xe4",
            f"f.yaml:2:4: byte 0xE4 at offset 10 is not UTF-8 (in Latin-1 it is '\xe4'); {SAVE}",
        ),
        ("a: b".encode("utf-16"), "f.yaml:1:1: the file is UTF-16; expected UTF-8; save it as UTF-8"),
        (
            "a: b".encode("utf-16-le"),
            "f.yaml:1:2: a NUL character (U+0000); expected plain text; is this a YAML file, saved as UTF-8?",
        ),
        (
            b"a: b\rc: \x1b",
            "f.yaml:2:4: an invisible character (U+001B, control character); expected plain text; delete it",
        ),
    ],
)
def test_content(data: bytes, message: str) -> None:
    assert message_on(data) == message


def test_text_is_kept_exactly_but_for_the_mark() -> None:
    document = Document.parse("\ufeffa: b\r\nc: \xb5 # d\r\n".encode(), "f.yaml")
    assert document.text == "a: b\r\nc: \xb5 # d\r\n"
    assert document.data == {"a": "b", "c": "\xb5"}
