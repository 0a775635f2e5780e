"""Test of the number of explanations that a monitor follows after a gap."""

from __future__ import annotations

from typing import TYPE_CHECKING

import dpkt

from ecatspec.conformance.base.verdict import BLAMING
from ecatspec.conformance.capture.monitor import Follower, monitor_file

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from ecatspec.conformance.capture.segment import Transaction

FIRST, LENGTH = 372, 58
MOST = 64


def test_few_explanations_are_followed_after_a_gap(
    shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (shared / "captures" / "soem-sdinfo-akd.pcapng").open("rb") as source:
        frames = [(moment, bytes(data)) for moment, data in dpkt.pcapng.Reader(source)]
    cut = tmp_path / "gap.pcap"
    with cut.open("wb") as file:
        writer = dpkt.pcap.Writer(file, nano=True)
        for moment, data in frames[: FIRST - 1] + frames[FIRST - 1 + LENGTH :]:
            writer.writepkt(data, ts=moment)
    counts: list[int] = []
    plain = Follower.follow

    def counted(self: Follower, transaction: Transaction) -> None:
        plain(self, transaction)
        counts.append(len(self.oracle.candidates))

    monkeypatch.setattr(Follower, "follow", counted)
    results = monitor_file(cut, "standard")
    assert 1 < max(counts) <= MOST
    assert not [v for result in results for v in result.verdicts if v.outcome in BLAMING]
