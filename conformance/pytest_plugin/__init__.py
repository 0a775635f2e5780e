"""The pytest plugin: its options, markers and fixtures.

    pytest --ecat-device kollmorgen-akd --ecat-dut exec:./slave

Every pytest of an environment loads this module, so it imports nothing of the project until a
device is named.
"""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Final

import pytest

from ecatspec.conformance.pytest_plugin.warned import EcatWarning
from ecatspec.generators.cases.depths import DEPTHS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.conformance.base.adapter import Adapter
    from ecatspec.conformance.pytest_plugin.session import EcatSession
    from ecatspec.conformance.pytest_plugin.suite import Suite

__all__ = ["EcatWarning"]

_NAME: Final = "ecatspec_suite"
"""What holds the suite is registered under this name, where a device is named."""
_NO_DEVICE: Final = "no device under test: give --ecat-device, and --ecat-dut where it is not model"


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of `ecatspec run`, in a group of their own."""
    group = parser.getgroup("ecatspec", "EtherCAT SubDevices (slaves), judged by their texts")
    option = group.addoption
    option("--ecat-device", metavar="DEVICE", help="Run the suite of this text, a name or a file.")
    option("--ecat-dut", metavar="DUT", help="How to reach the device. Default: model.")
    option("--ecat-depth", choices=DEPTHS, help="How much is tried. Default: default.")
    option("--ecat-only", metavar="LAYER,...", help="Only the tests of these layers.")
    option("--ecat-mailbox", metavar="SIZE", help="Bytes of both mailboxes, or OUT:IN.")
    option("--ecat-seed", type=_seed, metavar="N", help="Seed of the random part. Default: 0.")
    option("--ecat-known", metavar="FILE", help="Expect the deviations that this file accepts.")
    option(
        "--ecat-hang-timeout",
        type=_seconds,
        metavar="SECONDS",
        help="Without an answer for so long the device counts as hung.",
    )


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 0 on")
    return int(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of seconds above 0")
    return value


def pytest_configure(config: pytest.Config) -> None:
    """Reach the device, where one is named.

    Raises:
        UsageError: There is no such device, or it is not reached.

    """
    names = ("dut", "depth", "only", "mailbox", "seed", "known", "hang_timeout")
    given = {name: config.getoption(f"ecat_{name}") for name in names}
    given = {name: value for name, value in given.items() if value is not None}
    device = config.getoption("ecat_device")
    if device is None:
        if given:
            option = f"--ecat-{next(iter(given)).replace('_', '-')}"
            raise pytest.UsageError(f"{option} needs --ecat-device; name the text of the device")
        return
    from ecatspec.conformance.pytest_plugin.suite import suite_of

    config.pluginmanager.register(suite_of(config, device, given), _NAME)


def _suite(request: pytest.FixtureRequest) -> Suite:
    suite: Suite | None = request.config.pluginmanager.get_plugin(_NAME)
    if suite is None:
        pytest.skip(_NO_DEVICE)
    return suite


@pytest.fixture
def ecat_device(request: pytest.FixtureRequest) -> Iterator[Adapter]:
    """Give the device under test after a power cycle: bytes and time, judged by nobody."""
    with _suite(request).bench.powered() as adapter:
        yield adapter


@pytest.fixture
def ecat_session(request: pytest.FixtureRequest) -> Iterator[EcatSession]:
    """Give the device under test after a power cycle, watched by the texts at every step."""
    from ecatspec.conformance.pytest_plugin.session import EcatSession

    bench = _suite(request).bench
    with bench.powered():
        session = EcatSession(bench, request.node.nodeid)
        yield session
        session.end()
