"""The only place for tests of results files: what is kept, what is resumed, what a death loses."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import TYPE_CHECKING

import pytest

from ecatspec.conformance import campaign, cli, results
from ecatspec.conformance import runner as runner_module
from ecatspec.conformance.campaign import Elsewhere, Job, Workers, crew, stands
from ecatspec.conformance.devices import UserError, load
from ecatspec.conformance.results import Run, SetUp, begin, read
from ecatspec.conformance.runner import run_device
from ecatspec.conformance.steps import Judged, Knowledge, Learned, Search, Trial
from ecatspec.conformance.verdict import Outcome, Verdict
from ecatspec.generators.case import NO_LIMITS, Case
from ecatspec.generators.finite_cover import complete_suites
from ecatspec.generators.suite import all_cases
from ecatspec.model.compiled import Model

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from ecatspec.conformance.verdict import Result

SMALL = "reference"
FAULT = "model:fault=mailbox_check_forgotten"


@cache
def cases(device: str) -> tuple[Case, ...]:
    """Some of all kinds, so that choices are found out in many places."""
    model = Model(load(device))
    every = list(all_cases(model, NO_LIMITS, "quick"))
    return tuple(every[::29])


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    def suites(*arguments: object) -> Iterator[object]:
        yield from complete_suites(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(runner_module, "all_cases", lambda model, *_: cases(model.protocol.name))
    monkeypatch.setitem(runner_module.EXAMPLES, "default", 3)
    monkeypatch.setitem(runner_module.WALKS, "default", 3)


def same(first: Result, second: Result) -> None:
    assert first.verdicts == second.verdicts
    assert replace(first, seconds=0) == replace(second, seconds=0)
