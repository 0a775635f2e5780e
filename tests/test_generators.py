"""The only place for tests of generators/: how many cases there are and what they reach."""

from __future__ import annotations

import pytest

from ecatspec.conformance.session import Session
from ecatspec.generators.case import Case, SendFrame, WriteRegister
from ecatspec.generators.sdo_cover import probe_entry, sdo_cover
from ecatspec.generators.stimulus import frame_bytes, register_bytes
from ecatspec.generators.transition_cover import transition_cover
from ecatspec.model.compiled import Model
from ecatspec.model.oracle import Oracle
from ecatspec.spec.language.load import load_device

from .in_process import SHAPE, Plain

DEVICES = ("kollmorgen-akd", "standard")
GOLDEN = {"kollmorgen-akd": (620, 629), "standard": (544, 54)}
