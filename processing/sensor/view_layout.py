"""How the views of a toss lie in memory: the channels of a view's pixels, the columns of its samples and of the table.

A view is a crop of the rectified (pinhole) image with CHANNELS values a pixel, stored in one flat array for all views
of a toss, and a few hundred sampled surface points. The view table holds where each view's pixels and samples lie.
"""

from __future__ import annotations

Z, NX, NY, NZ, OUTSIDE = range(5)
APPEARANCE = 3
"""Brightness levelled against shading, and two differences of colour that shading leaves alone."""
SHARP, SMOOTH, CHANNELS = 5, 5 + APPEARANCE, 5 + 2 * APPEARANCE
"""First channel of the sharp appearance and of the smooth one; channels in all."""
HIDDEN = -1.0
"""OUTSIDE holds the distance to the mask in pixels (0 inside), or HIDDEN where something nearer may be in the way."""
NO_APPEARANCE = 100.0
"""Appearance of a pixel whose colour is not the object's (its depth comes from elsewhere); far beyond any real
value."""

OFFSET, U0, V0, WIDTH, HEIGHT, FIRST, COUNT = range(7)
"""Columns of the view table: first pixel, crop corner and size, first sample and number of samples."""

PX, PY, PZ, SNX, SNY, SNZ, SSHARP = range(7)
SAMPLE = 6 + 2 * APPEARANCE
"""Columns of a sample: point and normal in its camera's frame (m), then its appearance: APPEARANCE sharp values,
APPEARANCE smooth ones."""
