"""A run inside a namespace: a script, run by tests.

    python wire_run.py DEVICE DUT CASE...

It judges the cases and gives the verdicts as JSON on stdout.
"""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

from ecatspec.conformance.adapters import open_adapter
from ecatspec.conformance.base.devices import load
from ecatspec.conformance.run.case_executor import limits_of
from ecatspec.conformance.run.runner import Runner
from ecatspec.generators.suite import all_cases
from ecatspec.model.core.compilation import Model

if TYPE_CHECKING:
    from ecatspec.conformance.base.adapter import Adapter

Verdicts = dict[str, list[str]]


def verdicts(device: str, adapter: Adapter, names: list[str]) -> Verdicts:
    """Give outcome and cause of each case."""
    model = Model(load(device))
    runner = Runner(model, adapter, adapter.describe())
    cases = {case.name: case for case in all_cases(model, limits_of(adapter.describe()))}
    runner.run((cases[name] for name in names), None, len(names))
    return {v.case: [v.outcome.value, v.signature, v.reason] for v in runner.verdicts}


def main(device: str, dut: str, *names: str) -> None:
    adapter = open_adapter(dut, device)
    try:
        print(json.dumps(verdicts(device, adapter, list(names))))
    finally:
        adapter.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
