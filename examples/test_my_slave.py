"""Tests of a slave of your own: `pytest examples/test_my_slave.py`. See docs/own-tests.md."""

from hypothesis import given, settings

from ecatspec import api
from ecatspec.api import strategies

DEVICE = "reference"
DUT = "model"  # the virtual SubDevice; for a program of yours "exec:./my_slave"
MODEL = api.Model(api.load(DEVICE))

# Random runs over all that the device has, judged by the text.
machine = api.state_machine(DEVICE, DUT)
TestMySlave = machine.TestCase
TestMySlave.settings = settings(TestMySlave.settings, max_examples=15, stateful_step_count=8)


# Valid requests of the text for a parser of yours; here the one of ecatspec stands in its place.
@given(strategies.frames(MODEL))
def test_my_parser_knows_every_request(request: api.SendFrame) -> None:
    data = api.frame_bytes(MODEL, request, counter=1)
    message = MODEL.decode(data)
    assert message is not None
    assert message.frame == request.frame
