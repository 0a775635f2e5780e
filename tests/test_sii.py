"""Tests of model/esc/sii_data.py, of `ecatspec show FILE.bin` and of the images of our devices."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ecatspec.conformance.cli import main
from ecatspec.model.core.compilation import Model
from ecatspec.model.esc.data_link import linked
from ecatspec.model.esc.sii import sii_image
from ecatspec.model.esc.sii_data import Record, Sii, SiiError, read_sii, right_checksum, write_sii
from ecatspec.spec.language.load import load_device, load_link

if TYPE_CHECKING:
    from pathlib import Path

MODEL = Model(linked(load_device("reference-drive"), load_link()))
IMAGE = sii_image(MODEL)
HEAD = 128


def _records(sii: Sii, name: str) -> tuple[Record, ...]:
    return next(each.records for each in sii.categories if each.name == name)


@pytest.mark.parametrize(
    ("name", "mailbox", "ports"), [("akd", 1024, [1, 1, 0, 0]), ("ek1100", 0, [1, 3, 1, 0])]
)
def test_an_image_of_a_real_device_comes_back_byte_for_byte(
    shared: Path, name: str, mailbox: int, ports: list[int]
) -> None:
    data = (shared / "captures" / "sii" / f"{name}.hex").read_bytes()
    sii = read_sii(MODEL, data)
    assert write_sii(MODEL, sii) == data
    assert sii.ended
    assert sii.information.number("checksum") == right_checksum(MODEL, sii)
    assert sii.information.number("mailbox_out_length") == mailbox
    general = _records(sii, "general")[0]
    if name == "akd":
        assert [general.number(f"port_{n}") for n in range(4)] == ports


def test_the_drive_has_its_clocks_and_fixed_pdos(shared: Path) -> None:
    sii = read_sii(MODEL, (shared / "captures" / "sii" / "akd.hex").read_bytes())
    clocks = _records(sii, "clocks")
    assert [each.number("activation") for each in clocks] == [0x300, 0]
    strings = sii.strings()
    assert [strings[each.number("name") - 1] for each in clocks] == [b"DcSync", b"DcOff"]
    pdos = {r.number("index"): r for r in _records(sii, "rx_pdos") if r.frame == "sii_pdo"}
    assert pdos[0x1701].fields["fixed"]
    assert not pdos[0x1600].fields["fixed"]
    outer = [each for each in sii.categories if not each.name]
    assert [each.kind for each in outer][:2] == [2048, 2049]
    assert outer[0].rest.startswith(b"AKD-P00606")


@given(st.data())
def test_whatever_follows_the_head_comes_back_byte_for_byte(data: st.DataObject) -> None:
    kinds = st.sampled_from([0, 10, 30, 40, 41, 50, 51, 60, 2048, 0xFFFE])
    content = st.binary(max_size=70)
    parts = [data.draw(st.binary(min_size=HEAD, max_size=HEAD))]
    for kind, body in data.draw(st.lists(st.tuples(kinds, content), max_size=5)):
        whole = body + bytes(len(body) % 2)
        parts.append(kind.to_bytes(2, "little") + (len(whole) // 2).to_bytes(2, "little") + whole)
    parts.append(data.draw(st.sampled_from([b"", b"\xff\xff"])) + data.draw(content))
    image = b"".join(parts)
    assert write_sii(MODEL, read_sii(MODEL, image)) == image


@given(st.integers(HEAD, len(IMAGE)))
def test_an_image_that_was_cut_comes_back_too(size: int) -> None:
    assert write_sii(MODEL, read_sii(MODEL, IMAGE[:size])) == IMAGE[:size]


def test_data_that_was_changed_gives_other_bytes() -> None:
    sii = read_sii(MODEL, IMAGE)
    changed = Record("sii_information", {**sii.information.fields, "serial": 7})
    image = write_sii(MODEL, replace(sii, information=changed))
    assert image[0x1C:0x20] == b"\x07\0\0\0"
    assert image[0x20:] == IMAGE[0x20:]


@pytest.mark.parametrize("size", [0, 13, HEAD - 1])
def test_a_head_that_is_not_whole_is_refused(size: int) -> None:
    with pytest.raises(SiiError, match=f"at least 128 bytes, and here are {size}"):
        read_sii(MODEL, IMAGE[:size])


def test_our_image_has_four_bits_for_a_port_names_and_fixed_pdos() -> None:
    sii = read_sii(MODEL, IMAGE)
    general = _records(sii, "general")[0]
    assert [general.number(f"port_{n}") for n in range(4)] == [1, 1, 0, 0]
    at = next(each.kind for each in sii.categories if each.name == "general")
    start = IMAGE.index(at.to_bytes(2, "little") + b"\x10\0", HEAD) + 4
    assert IMAGE[start + 16 : start + 18] == b"\x11\0"
    strings = sii.strings()
    rx = _records(sii, "rx_pdos")
    assert strings[rx[1].number("name") - 1] == b"control_word"
    fixed = {r.number("index"): r.fields["fixed"] for r in rx if r.frame == "sii_pdo"}
    assert fixed == {0x1600: False, 0x1601: False, 0x1700: True}


def test_an_empty_assignment_leaves_the_managers_of_process_data_enabled() -> None:
    device = load_device("reference-drive")
    empty = tuple(
        replace(entry, default=0) if (entry.index, entry.subindex) == (0x1C12, 0) else entry
        for entry in device.objects
    )
    model = Model(linked(replace(device, objects=empty), load_link()))
    managers = _records(read_sii(model, sii_image(model)), "sync_managers")
    assert managers[2].number("length") == 0
    assert [each.fields["enabled"] for each in managers] == [True] * 4


def test_an_image_is_shown_as_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "drive.bin"
    file.write_bytes(IMAGE)
    assert main(["show", str(file)]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"checksum of the configuration +right", shown)
    assert re.search(r"port_0 +1 \(mii\)", shown)
    assert "reference-drive" in shown
    assert main(["show", "--json", str(file)]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["schema"] == "ecatspec.show_sii"
    assert {"head", "strings", "end"} <= {table["name"] for table in data["tables"]}


def test_a_wrong_checksum_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "wrong.bin"
    file.write_bytes(b"\x01" + IMAGE[1:])
    assert main(["show", str(file)]) == 0
    assert "wrong: 0x" in capsys.readouterr().out


@pytest.mark.parametrize("content", [None, b"", b"\xff" * 127, bytes((1 << 23) + 1)])
def test_what_is_no_image_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None
) -> None:
    file = tmp_path / "none.bin"
    if content is not None:
        file.write_bytes(content)
    assert main(["show", str(file)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "none.bin" in said.err


def test_an_image_has_no_machines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(tmp_path / "drive.bin"), "al"]) == 2
    assert "leave MACHINE and --format out" in capsys.readouterr().err
