"""A real MainDevice (SOEM, by the package pysoem): a script, run by tests.

    python soem_client.py IFACE INDEX SUBINDEX HEXDATA [INDEX SUBINDEX HEXDATA ...]

It brings the SubDevice to OP, where it exchanges process data, and reads and writes objects. What
it saw goes to stdout as JSON.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import pysoem

CYCLES = 200

# Many tests at once make everything slower, so this MainDevice is patient; in microseconds.
pysoem.settings.timeouts.ret = 100_000
pysoem.settings.timeouts.safe = 200_000
pysoem.settings.timeouts.eeprom = 1_000_000
pysoem.settings.timeouts.tx_mailbox = 500_000


def main(interface: str, objects: list[tuple[int, int, bytes]]) -> dict[str, Any]:
    main_device = pysoem.Master()
    main_device.open(interface)
    try:
        found: dict[str, Any] = {"count": main_device.config_init()}
        device = main_device.slaves[0]
        found |= {"name": device.name, "preop": device.state_check(pysoem.PREOP_STATE, 100_000)}
        found["identity"] = [device.man, device.id, device.rev]
        found["vendor"] = int.from_bytes(device.sdo_read(0x1018, 1), "little")
        found["before"] = [device.sdo_read(index, sub).hex() for index, sub, _ in objects]
        for index, subindex, data in objects:
            device.sdo_write(index, subindex, data)
        found["after"] = [device.sdo_read(index, sub).hex() for index, sub, _ in objects]
        try:
            device.sdo_read(0x5FFF, 0)
        except pysoem.SdoError as error:
            found["abort"] = error.abort_code
        try:
            main_device.config_map()
        except pysoem.ConfigMapError as error:
            found["missing"] = sorted({each.index for each in error.error_list})
        found["sizes"] = [len(device.output), len(device.input)]
        found["safeop"] = device.state_check(pysoem.SAFEOP_STATE, 1_000_000)
        found["expected"] = main_device.expected_wkc
        main_device.state = pysoem.OP_STATE
        for cycle in range(CYCLES):
            main_device.send_processdata()
            found["counter"] = main_device.receive_processdata(100_000)
            if cycle == 0:
                main_device.write_state()
            if device.state_check(pysoem.OP_STATE, 5000) == pysoem.OP_STATE:
                break
        main_device.read_state()
        found |= {"op": device.state, "code": device.al_status}
        main_device.send_processdata()
        found["counter"] = main_device.receive_processdata(100_000)
        found["inputs"] = bytes(device.input).hex()
        found["type"] = device.sdo_read(0x1000, 0).hex()
        main_device.state = pysoem.INIT_STATE
        main_device.write_state()
        found["init"] = device.state_check(pysoem.INIT_STATE, 1_000_000)
    finally:
        main_device.close()
    return found


if __name__ == "__main__":
    words = sys.argv[2:]
    triples = [(words[n], words[n + 1], words[n + 2]) for n in range(0, len(words), 3)]
    rows = [(int(i, 16), int(s, 16), bytes.fromhex(d)) for i, s, d in triples]
    print(json.dumps(main(sys.argv[1], rows)))
