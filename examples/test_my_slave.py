"""Tests of a slave of your own: `pytest examples/test_my_slave.py`. See docs/own-tests.md."""

from hypothesis import given, settings

from ecatspec.conformance.devices import load
from ecatspec.conformance.stateful import state_machine
from ecatspec.generators import strategies
from ecatspec.generators.case import SendFrame
from ecatspec.generators.stimulus import frame_bytes
from ecatspec.model.compiled import Model

DEVICE = "reference"
DUT = "model"  # the virtual SubDevice; for a program of yours "exec:./my_slave"
MODEL = Model(load(DEVICE))

# Random runs over all that the device has, judged by the text.
machine = state_machine(DEVICE, DUT)
TestMySlave = machine.TestCase
TestMySlave.settings = settings(TestMySlave.settings, max_examples=15, stateful_step_count=8)


# Valid requests of the text for a parser of yours; here the one of ecatspec stands in its place.
@given(strategies.frames(MODEL))
def test_my_parser_knows_every_request(request: SendFrame) -> None:
    data = frame_bytes(MODEL, request, counter=1)
    message = MODEL.decode(data)
    assert message is not None
    assert message.frame == request.frame
