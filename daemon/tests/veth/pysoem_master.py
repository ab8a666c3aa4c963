"""Brings the segment on interface `near` into OP with SOEM, and reads it for two seconds.

Prints JSON with the devices and the cycles. A cycle has the reading of the bus clock, the host's monotonic time before and
after the frame [ns], the working counter, and status and counter of each terminal.
"""
import json
import sys
import time

import pysoem

PERIOD_NS = 10_000_000
SYNC1_NS = 25_000


def exchange(master):
    master.send_processdata()
    return master.receive_processdata(20_000)


def cycle(master):
    sent = time.monotonic_ns()
    working_counter = exchange(master)
    received = time.monotonic_ns()
    terminals = [
        [int.from_bytes(one.input[0:2], "little"), int.from_bytes(one.input[2:6], "little")]
        for one in master.slaves[1:]
    ]
    return {
        "dc_ns": master.dc_time,
        "sent_ns": sent,
        "received_ns": received,
        "working_counter": working_counter,
        "terminals": terminals,
    }


def sleep_to_phase(master):
    """Waits until the middle between two SYNC0 events."""
    time.sleep((PERIOD_NS + PERIOD_NS // 2 - master.dc_time % PERIOD_NS) % PERIOD_NS * 1e-9 + 1e-3)


def bring_up(master):
    assert master.config_init() == 6, "six devices"
    for terminal in master.slaves[1:]:
        terminal.sdo_write(0x8001, 0x11, bytes([12]))
        assert terminal.sdo_read(0x8001, 0x11) == bytes([12])
        try:
            terminal.sdo_read(0x5000, 0)
            raise AssertionError("object 0x5000 does not exist")
        except pysoem.SdoError as error:
            assert error.abort_code == 0x06020000, hex(error.abort_code)
    master.config_map()
    assert master.config_dc(), "distributed clocks"
    for terminal in master.slaves[1:]:
        terminal.dc_sync(True, PERIOD_NS, 0, SYNC1_NS)
    assert master.state_check(pysoem.SAFEOP_STATE, 2_000_000) == pysoem.SAFEOP_STATE, "SAFE-OP"
    # Gives the clocks time to synchronise and SYNC0 time to start.
    for _ in range(200):
        exchange(master)
        time.sleep(1e-3)
    master.state = pysoem.OP_STATE
    master.write_state()
    for _ in range(100):
        exchange(master)
        if master.state_check(pysoem.OP_STATE, 10_000) == pysoem.OP_STATE:
            return
    raise AssertionError("no OP")


def main():
    master = pysoem.Master()
    master.open(sys.argv[1])
    try:
        bring_up(master)
        devices = [{"name": one.name, "vendor": one.man, "product": one.id} for one in master.slaves]
        cycles = []
        for _ in range(200):
            sleep_to_phase(master)
            cycles.append(cycle(master))
        expected = master.expected_wkc
        master.state = pysoem.INIT_STATE
        master.write_state()
        print(json.dumps({"devices": devices, "expected_working_counter": expected, "cycles": cycles}))
    finally:
        master.close()


main()
