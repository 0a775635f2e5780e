"""The stable interface of ecatspec for programs: `from ecatspec import api`.

Other modules may change their names and places from version to version; what is here keeps both
until the next major version. A device is named as on the command line: by the name of a text that
is installed (`device_names`), or by the path of an `.ecs` file. A device under test is named as for
`ecatspec run --dut`.
"""

from __future__ import annotations

from pathlib import Path
from typing import IO, TYPE_CHECKING

from ecatspec.conformance.adapters import HANG_TIMEOUT, open_adapter
from ecatspec.conformance.adapters.contract_test import check_adapter
from ecatspec.conformance.base.adapter import (
    Adapter,
    AdapterError,
    Description,
    DeviceCrash,
    DeviceFault,
    DeviceHang,
    DeviceRubbish,
)
from ecatspec.conformance.base.devices import UserError, load, nearest
from ecatspec.conformance.base.verdict import Outcome, Result, TraceLine, Verdict
from ecatspec.conformance.capture.monitor import monitor_file
from ecatspec.conformance.capture.transactions import CaptureError
from ecatspec.conformance.reports import REPORTS
from ecatspec.conformance.results.known_deviations import of
from ecatspec.conformance.run.runner import run_device
from ecatspec.conformance.run.state_machine import state_machine
from ecatspec.conformance.vectors.command import replay
from ecatspec.conformance.vectors.export import Wanted, export
from ecatspec.generators.cases.case import (
    NO_LIMITS,
    Case,
    Happen,
    Hurry,
    Limits,
    Probe,
    ReadConfiguration,
    ReadInitial,
    ReadRegister,
    Repeat,
    SendFrame,
    SendSegments,
    SetUpProcessData,
    Stimulus,
    StopOutputs,
    Wait,
    WriteOutputs,
    WriteRegister,
    WriteRegisters,
    WriteUntilTaken,
)
from ecatspec.generators.cases.case_codec import case_of, token_of
from ecatspec.generators.cases.client import played
from ecatspec.generators.cases.depths import DEPTHS
from ecatspec.generators.cases.stimulus import frame_bytes
from ecatspec.generators.formats import FORMATS
from ecatspec.generators.random import strategies
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model
from ecatspec.spec.language.load import device_names

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from ecatspec.spec.language.ir import Protocol

    Progress = Callable[[int, int, str], None]
    """Called with the number of cases done, of all cases (0: not known), and the name of one."""

__all__ = [
    "NO_LIMITS",
    "Adapter",
    "AdapterError",
    "Case",
    "Description",
    "DeviceCrash",
    "DeviceFault",
    "DeviceHang",
    "DeviceRubbish",
    "Happen",
    "Hurry",
    "Limits",
    "Model",
    "Outcome",
    "Probe",
    "ReadConfiguration",
    "ReadInitial",
    "ReadRegister",
    "Repeat",
    "Result",
    "SendFrame",
    "SendSegments",
    "SetUpProcessData",
    "Stimulus",
    "StopOutputs",
    "TraceLine",
    "UserError",
    "Verdict",
    "Wait",
    "WriteOutputs",
    "WriteRegister",
    "WriteRegisters",
    "WriteUntilTaken",
    "case_of",
    "cases",
    "check_adapter",
    "device_names",
    "export_vectors",
    "frame_bytes",
    "load",
    "monitor",
    "open_adapter",
    "played",
    "replay_vectors",
    "report",
    "run",
    "state_machine",
    "strategies",
    "token_of",
]


def _check(what: str, name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise nearest(what, name, known)


def cases(model: Model, limits: Limits = NO_LIMITS, depth: str = "default") -> Iterator[Case]:
    """Yield the fixed cases of a device in the order in which `run` judges them.

    Args:
        model: the compiled text, `Model(load("kollmorgen-akd"))`.
        limits: what the way to the device cannot carry; cases that need it are left out.
        depth: "quick", "default" or "exhaustive", as for `ecatspec run`.

    Raises:
        UserError: There is no such depth.
        MissingSolverError: "exhaustive" needs the package z3-solver (`ecatspec[prove]`).

    """
    _check("depth", depth, DEPTHS)
    return all_cases(model, limits, depth)


def run(
    device: str,
    dut: str = "model",
    *,
    depth: str = "default",
    seed: int = 0,
    mailbox: str = "",
    only: Sequence[str] = (),
    replay: str = "",
    known: str = "",
    choices: Mapping[str, str] | None = None,
    hang_timeout: float = HANG_TIMEOUT,
    progress: Progress | None = None,
) -> Result:
    """Judge a device under test by its text, as `ecatspec run` does.

    Args:
        device: name or path of the text.
        dut: how to reach the device; "model" is the virtual SubDevice of the text.
        depth: "quick", "default" or "exhaustive".
        seed: seed of random walks and requests.
        mailbox: bytes of both mailboxes, or "OUT:IN"; empty: as the text says.
        only: layers to try; empty: all.
        replay: name or token of one case; empty: all cases.
        known: path of a file of known deviations; empty: none.
        choices: ways that the device is known to go, alternative by choice.
        hang_timeout: seconds without an answer after which the device counts as hung.
        progress: called before each case.

    Raises:
        UserError: There is no such device, depth, layer, case or choice, or the set-up is wrong.
        AdapterError: The device cannot be reached.

    """
    _check("depth", depth, DEPTHS)
    return run_device(
        device,
        dut,
        depth=depth,
        seed=seed,
        mailbox=mailbox,
        only=tuple(only),
        hang_timeout=hang_timeout,
        replay=replay,
        known=of(known, load(device, mailbox).name),
        choices=tuple(f"{name}={way}" for name, way in (choices or {}).items()),
        progress=progress,
    )


def monitor(
    path: str | Path, device: str = "standard", progress: Progress | None = None
) -> tuple[Result, ...]:
    """Judge each SubDevice of a capture (pcap, pcapng) by a text, as `ecatspec monitor` does.

    Raises:
        UserError: The file cannot be read or is no capture, or there is no such device.

    """
    try:
        return monitor_file(Path(path), device, progress)
    except CaptureError as error:
        raise UserError(str(error)) from None


def report(results: Sequence[Result], protocol: Protocol, form: str = "text") -> str:
    """Give results as one of the reports: text, json, junit, html, github or sarif.

    Raises:
        UserError: There is no such form.

    """
    _check("form of report", form, tuple(REPORTS))
    return REPORTS[form](results, protocol)


def export_vectors(
    device: str,
    out: IO[bytes],
    *,
    form: str = "json",
    depth: str = "default",
    seed: int = 0,
    mailbox: str = "",
    only: Sequence[str] = (),
    choices: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> None:
    """Write the test vectors of a device to `out`, as `ecatspec export` does.

    Raises:
        UserError: There is no such device, form, depth, layer or choice.
        OSError: `out` cannot be written.

    """
    _check("depth", depth, DEPTHS)
    _check("form of vectors", form, tuple(FORMATS))
    wanted = Wanted(device, depth, tuple(only), mailbox, seed, dict(choices or {}))
    export(wanted, form, out, progress)


def replay_vectors(
    path: str | Path,
    dut: str = "model",
    *,
    hang_timeout: float = HANG_TIMEOUT,
    progress: Progress | None = None,
) -> Result:
    """Play a file of test vectors on a device under test, as `ecatspec replay` does.

    Raises:
        UserError: The file cannot be read or is wrong, or the set-up is wrong.
        AdapterError: The device cannot be reached.

    """
    return replay(Path(path), dut, hang_timeout=hang_timeout, progress=progress)[0]
