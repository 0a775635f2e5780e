"""Tests of a monitor that is stopped, and of captures in which nothing can be judged."""

from __future__ import annotations

from typing import TYPE_CHECKING

import dpkt

from ecatspec.conformance import cli
from ecatspec.conformance.base.verdict import Outcome
from ecatspec.conformance.capture.monitor import Follower, monitor_file
from ecatspec.conformance.cli.exit_status import INTERRUPTED

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

    from ecatspec.conformance.capture.segment import Transaction

POLL = bytes.fromhex("ffffffffffff 010101010101 88a4 0e10 0400 0110 3001 0200 0000 0000 0000")
"""A read of the AL status at a station address, with working counter 0."""
BACK = POLL[:6] + bytes([POLL[6] | 2]) + POLL[7:]
STOP = 50


def written(path: Path, frames: list[bytes]) -> Path:
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, nano=True)
        for moment, data in enumerate(frames):
            writer.writepkt(data, ts=moment / 1000)
    return path


def test_a_capture_in_which_nothing_answers_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = written(tmp_path / "silent.pcap", [POLL, BACK] * 4)
    (result,) = monitor_file(silent, "standard")
    assert [verdict.outcome for verdict in result.verdicts] == [Outcome.INCONCLUSIVE]
    status = cli.main(["monitor", str(silent)])
    out, error = capsys.readouterr()
    assert status == 2
    assert "no SubDevice answers" in " ".join(out.split())
    assert "nothing could be judged" in error


def test_what_was_found_before_an_interrupt_is_printed(
    shared: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = Follower.follow

    def stopped(self: Follower, transaction: Transaction) -> None:
        if self.exchanges == STOP:
            raise KeyboardInterrupt
        plain(self, transaction)

    monkeypatch.setattr(Follower, "follow", stopped)
    status = cli.main(["monitor", str(shared / "captures" / "soem-single-lan9252.pcapng")])
    out, _ = capsys.readouterr()
    assert status == INTERRUPTED
    assert f"{STOP} exchanges" in out
