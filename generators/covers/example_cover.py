"""Cases from the worked examples that manuals print."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ecatspec.generators.cases.bringup import case_in
from ecatspec.generators.cases.case import Case, Limits, SendFrame

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ecatspec.model.core.compilation import Model


def example_cover(model: Model, _: Limits) -> Iterator[Case]:
    """Yield a case for each example: its request in PREOP. The answer is judged as any other."""
    for example in model.protocol.examples:
        message = model.decode(example.request)
        if message is not None:
            fields = {name: value for name, value in message.fields.items() if name != "counter"}
            sent = SendFrame(message.frame, fields)
            title = f"the worked example {example.name.replace('_', ' ')}"
            yield case_in(model, f"sdo/example/{example.name}", title, [sent])
