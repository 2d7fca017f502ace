"""Pictures in time as files: MP4 by PyAV (which brings FFmpeg's libraries), animated GIF and WebP by Pillow."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

CODECS = ("libx264", "mpeg4")
"""H.264 where FFmpeg has it, for every player knows it; MPEG-4 part 2 is always there."""
QUALITY = {"libx264": {"crf": "20", "preset": "medium"}, "mpeg4": {"qmin": "2", "qmax": "4"}}
TICKS = 60_000
"""Per second; MPEG-4 counts at most 65,535."""
GIF_COLORS = 128


def movie_codec() -> str | None:
    """The encoder for MP4 that is installed; None where there is no PyAV: then a film is a GIF."""
    if find_spec("av") is None:
        return None
    import av

    return next((name for name in CODECS if name in av.codecs_available), None)


def write_mp4(path: Path, images: Iterable[UInt8[Array, "h w 3"]], times_s: Float[Array, " n"], codec: str) -> int:
    """Write an MP4 whose frames are shown at these times; returns how many. Sizes are even and all the same."""
    import av

    count = 0
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream: Any = container.add_stream(codec, options=QUALITY[codec])
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, TICKS)
        stream.codec_context.time_base = Fraction(1, TICKS)
        for image, time_s in zip(images, times_s, strict=True):
            if count == 0:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = round(time_s * TICKS), Fraction(1, TICKS)
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode())
    return count


def write_gif(path: Path, images: Iterable[UInt8[Array, "h w 3"]], times_s: Float[Array, " n"]) -> int:
    """Write an endless GIF; returns how many frames. GIF counts hundredths of a second and has few colours."""
    from PIL import Image

    frames = [Image.fromarray(image).quantize(GIF_COLORS) for image in images]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=durations_ms(times_s, 10), loop=0)
    return len(frames)


def looping_webp(images: Sequence[UInt8[Array, "h w 3"]], times_s: Float[Array, " n"], quality: int) -> bytes:
    """An endless animated WebP, as a page shows it."""
    from PIL import Image

    out = io.BytesIO()
    frames = [Image.fromarray(image) for image in images]
    frames[0].save(
        out, "webp", save_all=True, append_images=frames[1:], duration=durations_ms(times_s), loop=0, quality=quality
    )
    return out.getvalue()


def durations_ms(times_s: Float[Array, " n"], step_ms: int = 1) -> list[int]:
    """How long each frame is shown, in whole steps whose sums follow the times; the last as long as the one before."""
    edges = np.round(1e3 * (times_s - times_s[0]) / step_ms).astype(int)
    steps = np.maximum(np.diff(edges), 1) if len(edges) > 1 else np.array([100 // step_ms])
    return [int(s) * step_ms for s in (*steps, *(steps[-1:] if len(edges) > 1 else ()))]
