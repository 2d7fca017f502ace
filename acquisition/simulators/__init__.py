"""Protocol-level devices on loopback: the real vendor clients talk to them, no hardware is needed.

They listen on 127.0.0.0/8 only. None is imported by a driver or a command; tests and the bench start them.
"""
