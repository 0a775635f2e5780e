"""Tests of what the monitor says of the states of a SubDevice."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.conformance.capture.monitor import monitor_file

if TYPE_CHECKING:
    from pathlib import Path

AKD = "soem-sdinfo-akd.pcapng"
LAN9252 = "soem-single-lan9252.pcapng"


def steps(capture: Path) -> list[str]:
    (result,) = monitor_file(capture, "standard")
    (path,) = [note for note in result.notes if note.startswith("AL: ")]
    return path.removeprefix("AL: ").split(" -> ")


def test_a_state_with_an_error_has_its_code_with_name_and_frame(shared: Path) -> None:
    *before, last = steps(shared / "captures" / AKD)
    assert "error yes" in last
    assert last.endswith(", AL status code 0x001D invalid_output_configuration (frame 6758)")
    assert not [step for step in before if "code" in step]


def test_a_state_without_error_has_no_code(shared: Path) -> None:
    assert not [step for step in steps(shared / "captures" / LAN9252) if "code" in step]
