"""A dask cluster that cannot be used, and why."""

from __future__ import annotations

from pathlib import Path

import pytest

from labseq.cluster import ClusterWorkers
from labseq.errors import ConfigError


@pytest.mark.parametrize(
    ("address", "keys", "message"),
    [
        ("tcp://10.0.0.1:8786", None, "run code on the workers; expected tls"),
        (
            "tls://lab:8786",
            None,
            "needs certificates; 'labseq campaign keys FOLDER' makes them",
        ),
        ("tls://lab:8786", Path("nowhere"), "there is no ca.pem in nowhere"),
        ("lab:8786", None, "this is not the address of a scheduler; expected tls://HOST:PORT"),
        ("tcp://127.0.0.1:9", None, "no scheduler answers"),
    ],
)
def test_a_cluster_that_cannot_be_used(
    address: str, keys: Path | None, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("labseq.cluster._ANSWER_S", 0.5)
    with pytest.raises(ConfigError, match=message):
        ClusterWorkers(address, keys, "shot")
