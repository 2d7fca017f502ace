"""Masks of the object that a toss's file carries, decoded one by one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from jaxtyping import Bool, Int64
from numpy import ndarray as Array

from recordings.mcap.codec import decode_mask
from recordings.mcap.file import McapFile


class GivenMasks(Mapping):  # not Mapping[int, Bool[Array, "h w"]]: type checks in tests would decode one at every call
    """Masks (h w, bool) by position of the colour frame in the toss, decoded when asked for."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._names = {
            int(name[6:-4]): name
            for name in file.attachments()
            if name.startswith("masks/") and name.endswith(".png") and name[6:-4].isdigit()
        }

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[int]:
        return iter(self._names)

    def __getitem__(self, position: int) -> Bool[Array, "h w"]:
        return decode_mask(self.png(position), self._names[position])

    def relabelled(self, to: Sequence[int] | Int64[Array, " n"]) -> GivenMasks:
        """The same masks where frame i is called to[i]; those of frames beyond are left out."""
        found = GivenMasks(self._file)
        found._names = {int(to[i]): name for i, name in self._names.items() if i < len(to)}
        return found

    def png(self, position: int) -> bytes:
        """A mask's bytes as they were attached."""
        return self._file.attachment(self._names[position]) or b""
