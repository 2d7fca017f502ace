"""Protocol-level devices on loopback: the real vendor clients talk to them, no hardware is needed.

They listen on 127.0.0.0/8 only; tests and the bench start them. `faults.py` is the fault interface of all, and of
the simulated lab of `acquisition.drivers.synthetic`. docs/devices.md lists what each simulates, and what not.
"""
