"""What all tests share."""

import itertools
import os

import pytest
from hypothesis import settings

# A busy computer is no failure, and what passed once passes again; ``poe fuzz`` looks for new examples.
settings.register_profile("labseq", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None)
settings.load_profile("labseq")

for _name in ("LABSEQ_DATA", "LABSEQ_PLUGIN_PATH"):  # the user's own must not reach the tests
    os.environ.pop(_name, None)
os.environ["LABSEQ_STATE"] = os.devnull  # for fixtures that outlive a test: leads nowhere

_NUMBERS = itertools.count()


@pytest.fixture(autouse=True)
def own_state(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A state folder for each test and its subprocesses, so that none sees another's runs."""
    folder = tmp_path_factory.getbasetemp() / "state" / str(next(_NUMBERS))
    monkeypatch.setenv("LABSEQ_STATE", str(folder))
