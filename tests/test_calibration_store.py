from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path

import pytest

from labseq import calibration_store as store_module
from labseq.calibration.quality import use_if_not_worse
from labseq.calibration_store import Damaged, Store, Stored
from labseq.errors import ConfigError
from labseq.model import CalibrationEntry, SiteGrid
from labseq.testing.fakes import fake_calibration

GRID = SiteGrid(3, 4)


def overlay(offset_m: float = 0.0, error_m: float = 2e-8, minute: int = 0) -> CalibrationEntry:
    return fake_calibration(
        "overlay",
        GRID,
        values={"offset_m": [offset_m, 0.0]},
        quality={"error_m": error_m},
        taken_utc=f"2026-11-20T08:{minute:02}:00+00:00",
    )


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "calibrations" / "lab")


def test_a_store_that_does_not_exist_is_empty(store: Store) -> None:
    assert (store.entries(), store.active(), store.history()) == ([], {}, [])
    assert store.entry_in_use("sites") is None
    assert not store.folder.exists()


def test_an_entry_and_its_picture_are_kept(store: Store) -> None:
    entry = overlay()
    stored = store.add(entry, b"png")
    assert stored.path.name == f"overlay-20261120T080000Z-{entry.id}.json"
    assert stored.picture is not None
    assert stored.picture.read_bytes() == b"png"
    (read,) = store.entries()
    assert isinstance(read, Stored)
    assert read.entry.id == entry.id
    assert not store.active()


def test_nothing_is_ever_overwritten(store: Store) -> None:
    first, second, third = (store.add(overlay()) for _ in range(3))
    assert len({first.path, second.path, third.path}) == 3
    assert store.find(first.entry.id).path == third.path  # the newest is meant
    assert store.find(first.path.name).path == first.path
    again = store.add(overlay(minute=1))  # the same values, measured again
    assert again.entry.id != first.entry.id
    assert store.find(again.entry.id).path == again.path


def test_so_much_of_an_id_as_is_unique_is_enough(store: Store) -> None:
    stored = store.add(overlay())
    assert store.find(stored.entry.id[:3]).path == stored.path
    assert store.find(stored.entry.id.upper()).path == stored.path
    with pytest.raises(ConfigError, match=f"there is no calibration 'zzz' in .*; expected {stored.entry.id}"):
        store.find("zzz")
    with pytest.raises(ConfigError, match="there is no calibration ''"):
        store.find("")
    with pytest.raises(ConfigError, match="there is no calibration of sites"):
        store.find(stored.entry.id, "sites")


def test_an_id_that_is_not_unique_is_refused(store: Store) -> None:
    ids = sorted({store.add(overlay(k * 1e-9)).entry.id for k in range(40)})
    first = next(a for a, b in pairwise(ids) if a[0] == b[0])
    with pytest.raises(ConfigError, match=f"several calibrations begin with '{first[0]}'"):
        store.find(first[0])


def test_what_is_in_use_is_known_and_so_is_what_was(store: Store) -> None:
    old, new = store.add(overlay()), store.add(overlay(1e-7, minute=1))
    for stored in (old, old, new):
        store.use(stored, GRID)
    store.use_none("overlay")
    store.use_none("sites")
    store.use(old, GRID)
    assert [one.id for one in store.history()] == [old.entry.id, new.entry.id, "", old.entry.id]
    assert [*store.active()] == ["overlay"]
    in_use = store.entry_in_use("overlay")
    assert in_use is not None
    assert in_use.path == old.path


def test_one_of_another_grid_is_refused(store: Store) -> None:
    stored = store.add(overlay())
    with pytest.raises(ConfigError, match=r"another grid: 3 x 4 sites, .*; expected 3 x 5 sites, .*, as in"):
        store.use(stored, SiteGrid(3, 5))


def test_a_damaged_file_is_listed_and_refused(store: Store) -> None:
    good, bad = store.add(overlay()), store.add(overlay(1e-7, minute=1))
    store.use(bad, GRID)
    bad.path.write_bytes(bad.path.read_bytes()[:100])
    kinds = [type(one) for one in store.entries()]
    assert kinds == [Stored, Damaged]
    for use in (lambda: store.find(bad.entry.id), lambda: store.entry_in_use("overlay")):
        with pytest.raises(ConfigError, match="this file is damaged: it is not a JSON object"):
            use()
    use_if_not_worse(store, good, GRID)  # anything is better than what cannot be read


def test_a_renamed_or_exchanged_file_is_refused(store: Store) -> None:
    one, other = store.add(overlay()), store.add(overlay(1e-7, minute=1))
    store.use(one, GRID)
    other.path.replace(one.path)
    with pytest.raises(ConfigError, match="it was renamed"):
        store.find(one.entry.id)
    with pytest.raises(ConfigError, match="was put to use as 'overlay', but this is another"):
        store.entry_in_use("overlay")


@pytest.mark.parametrize(
    "content",
    ["{", "[]", '{"format": "labseq-active-calibrations", "format_version": "2.0", "history": [{}]}'],
)
def test_a_damaged_note_of_what_is_in_use_is_refused(store: Store, content: str) -> None:
    stored = store.add(overlay())
    (store.folder / "active.json").write_text(content, "utf-8")
    for act in (store.active, lambda: store.use(stored, GRID)):
        with pytest.raises(ConfigError, match="this file is damaged"):
            act()
    assert (store.folder / "active.json").read_text("utf-8") == content


def test_a_file_in_the_way_of_the_folder_is_reported(store: Store) -> None:
    store.folder.parent.parent.mkdir(parents=True, exist_ok=True)
    store.folder.parent.write_text("x", "utf-8")
    for act in (lambda: store.add(overlay()), lambda: store.use_none("sites")):
        with pytest.raises(ConfigError, match="calibrations cannot be stored there"):
            act()


def test_many_at_once_lose_nothing(store: Store) -> None:
    def work(number: int) -> None:
        entry = overlay(number * 1e-9)
        for one in (entry, overlay()):  # the second is the same for all, and so is its name
            store.use(store.add(one), GRID)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(1, 9)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(store.entries()) == 16
    assert {one.id for one in store.history()} == {
        one.entry.id for one in store.entries() if isinstance(one, Stored)
    }


def test_what_a_killed_process_left_is_reported(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = store.add(overlay())
    part = store.folder / "active.json.part"
    part.touch()
    monkeypatch.setattr(store_module, "MAX_WAIT_S", 0.0)
    with pytest.raises(ConfigError, match=r"active.json.part: another labseq is writing.*delete it"):
        store.use(stored, GRID)
    assert part.exists()


def test_a_note_that_leads_out_of_the_folder_is_refused(store: Store) -> None:
    stored = store.add(overlay())
    store.use(stored, GRID)
    note = store.folder / "active.json"
    note.write_text(note.read_text("utf-8").replace(stored.path.name, "../../else.json"), "utf-8")
    with pytest.raises(ConfigError, match="outside of its folder"):
        store.active()
