"""Tests of the monitor: what captures of real devices show."""

from __future__ import annotations

import random
from io import BytesIO
from typing import TYPE_CHECKING

import dpkt
import pytest

from ecatspec.conformance.base.verdict import BLAMING, Outcome
from ecatspec.conformance.capture import monitor
from ecatspec.conformance.capture.monitor import monitor_file
from ecatspec.conformance.capture.transactions import CaptureError
from ecatspec.model.core.register_map import SYNC_MANAGERS
from ecatspec.model.oracle.oracle import Oracle

if TYPE_CHECKING:
    from pathlib import Path

    from ecatspec.conformance.base.verdict import Result
    from ecatspec.model.core.compilation import Model

AKD_CAPTURE = "soem-sdinfo-akd.pcapng"
OTHERS = (
    "replay-ek1914-el3004-mailbox.pcapng",
    "replay-ek1914-segmented-upload.pcapng",
    "soem-sdinfo-ek1100-el1004.pcapng",
    "soem-single-lan9252.pcapng",
)


@pytest.fixture(scope="module")
def captures(shared: Path) -> Path:
    return shared / "captures"


def blamed(results: tuple[Result, ...]) -> list[str]:
    return [
        f"{result.subject}: {verdict.case}: {verdict.observed}"
        for result in results
        for verdict in result.verdicts
        if verdict.outcome in BLAMING
    ]


@pytest.fixture(scope="module")
def drive(captures: Path) -> Result:
    (result,) = monitor_file(captures / AKD_CAPTURE, "kollmorgen-akd")
    return result


def test_the_drive_shows_a_code_that_its_manual_does_not_have(drive: Result) -> None:
    (finding,) = drive.findings()
    verdict = finding.verdict
    assert finding.also == ()
    assert verdict.outcome is Outcome.FAIL
    assert verdict.at == "frame 6758"
    assert "0x001D" in verdict.observed
    assert "AKD-C35" in verdict.clauses
    assert "AKD-109" in verdict.claims
    assert not drive.conforms


def test_the_finding_says_what_led_to_it(drive: Result) -> None:
    words = [line.what for line in drive.findings()[0].verdict.trace]
    assert any("4 SAFEOP" in line and "al_control" in line for line in words)
    assert "0x001D" in words[-1]


def test_the_path_of_the_drive(drive: Result) -> None:
    (path,) = [note for note in drive.notes if note.startswith("AL: ")]
    steps = path.removeprefix("AL: ").split(" -> ")
    assert [step.split("state ")[1].split(", ident")[0] for step in steps] == [
        "1 INIT, error no",
        "2 PREOP, error no",
        "2 PREOP, error yes",
    ]


def test_the_uploads_of_the_drive(drive: Result) -> None:
    (mailbox,) = [note for note in drive.notes if note.startswith("mailbox: ")]
    assert mailbox == "mailbox: 35 sdo_upload_expedited, 35 sdo_upload_request"


@pytest.mark.parametrize("name", [AKD_CAPTURE, *OTHERS])
def test_the_standard_blames_no_real_device(captures: Path, name: str) -> None:
    results = monitor_file(captures / name, "standard")
    assert results
    assert blamed(results) == []


SIZES = (0, 1, 27, 28, 100, 1_000, 10_007, 100_003, 300_001, 499_999)


@pytest.mark.parametrize("size", SIZES)
def test_a_cut_capture_blames_nobody(captures: Path, tmp_path: Path, size: int) -> None:
    data = (captures / AKD_CAPTURE).read_bytes()
    cut = tmp_path / "cut.pcapng"
    cut.write_bytes(data[:size])
    try:
        results = monitor_file(cut, "standard")
    except CaptureError as error:
        assert "\n" not in str(error)  # noqa: PT017  either way is right
        return
    assert blamed(results) == []


@pytest.mark.parametrize("back", [1, 2, 3, 4, 17, 60, 61, 127])
def test_a_capture_cut_near_its_end_blames_nobody(
    captures: Path, tmp_path: Path, back: int
) -> None:
    data = (captures / AKD_CAPTURE).read_bytes()
    cut = tmp_path / "cut.pcapng"
    cut.write_bytes(data[:-back])
    (result,) = monitor_file(cut, "standard")
    assert blamed((result,)) == []
    assert "the file ends in the middle" in result.notes[-1]


LOSS = 0.02


def thinned(path: Path, seed: int) -> bytes:
    """The packets of a capture as pcap, a share of them left out, but never two in a row.

    A read of a mailbox of which neither the frame nor its return is captured leaves no sign.
    """
    chooser = random.Random(seed)
    lost = False
    out = BytesIO()
    with path.open("rb") as file:
        reader = dpkt.pcapng.Reader(file)
        writer = dpkt.pcap.Writer(out, nano=True, linktype=reader.datalink())
        for moment, data in reader:
            lost = not lost and chooser.random() < LOSS
            if not lost:
                writer.writepkt(bytes(data), ts=moment)
    return out.getvalue()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", [AKD_CAPTURE, *OTHERS])
def test_lost_frames_blame_nobody(captures: Path, tmp_path: Path, name: str, seed: int) -> None:
    lossy = tmp_path / "lossy.pcap"
    lossy.write_bytes(thinned(captures / name, seed))
    try:
        results = monitor_file(lossy, "standard")
    except CaptureError:
        return
    assert blamed(results) == []


def repeated(path: Path, times: int, copy: Path) -> Path:
    """A capture in which the same happens several times, one after the other."""
    with path.open("rb") as file:
        packets = list(dpkt.pcapng.Reader(file))
    span = packets[-1][0] - packets[0][0] + 1
    with copy.open("wb") as file:
        writer = dpkt.pcap.Writer(file)
        for number in range(times):
            for time, frame in packets:
                writer.writepkt(frame, ts=time + number * span)
    return copy


@pytest.mark.parametrize("device", ["standard", "kollmorgen-akd"])
def test_a_main_device_that_starts_again_is_followed(
    captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str
) -> None:
    """It begins with broadcasts, and sets mailboxes of another length than the text has them."""
    oracles: list[Oracle] = []

    class Kept(Oracle):
        def __init__(self, model: Model) -> None:
            super().__init__(model)
            oracles.append(self)

    monkeypatch.setattr(monitor, "Oracle", Kept)
    capture = repeated(captures / AKD_CAPTURE, 2, tmp_path / "twice.pcap")
    (result,) = monitor_file(capture, device)
    (oracle,) = oracles
    assert not oracle.lost
    assert len(oracle.candidates) < 16
    areas = [oracle.known.area(name) for name in SYNC_MANAGERS]
    assert areas == [(0x1800, 1024), (0x1C00, 1024)]
    assert len(blamed((result,))) == (2 if device == "kollmorgen-akd" else 0)
