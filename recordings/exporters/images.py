"""Images of a session as files."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt16
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.mcap.codec import decode_image
from recordings.records import EncodedImage

SUFFIXES = {"jpeg": ".jpg", "png": ".png"}


def image_file(image: EncodedImage) -> tuple[str, bytes]:
    """Suffix and bytes: JPEG and PNG as they are, raw pixels as PNG (without loss)."""
    if image.encoding in SUFFIXES:
        return SUFFIXES[image.encoding], image.data
    pixels = decode_image(image)
    return ".png", _png(cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels)


def depth_png(raw: UInt16[Array, "h w"]) -> bytes:
    """A 16-bit grey PNG of the numbers as they are."""
    return _png(np.ascontiguousarray(raw))


def _png(pixels: Array) -> bytes:
    ok, png = cv2.imencode(".png", pixels)
    if not ok:
        raise BadInput(f"an image of shape {pixels.shape} and {pixels.dtype} cannot be written as PNG")
    return png.tobytes()
