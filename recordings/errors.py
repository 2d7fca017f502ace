"""The one family of errors that a user may see: what was found, what was wanted, what to type next."""

from __future__ import annotations


class TosslabError(Exception):
    """Base of every error that tosslab raises on purpose. `exit_code` is what a command returns for it."""

    exit_code = 2


class BadInput(TosslabError):
    """An input file, folder or argument that cannot be used as it is."""


class DamagedFile(BadInput):
    """A file that was cut off or altered. `toss-session recover` may still read a part of it."""


class FrameMismatch(TosslabError):
    """Two transforms, or a transform and a camera, whose frames do not meet."""


class WriteFailed(TosslabError):
    """The disk refused a write; the file up to the last complete chunk can be recovered."""


class DeviceNotFound(TosslabError):
    """A device, or the vendor's library that speaks to it, is not there."""
